"""Steps that turn elements: rigid motions stay rigid, and small steps are straight."""

import numpy as np
import pytest
from bars import bar, two_patches
from scipy.sparse import csr_array
from scipy.spatial.transform import Rotation

from fab4d.design.problem import Problem
from fab4d.design.turning import Turning

NOBODY = np.zeros(0, np.int64)


@pytest.fixture(scope="module", params=["linear", "quadratic"])
def problem(request: pytest.FixtureRequest) -> Problem:
    return bar((4, 2, 1), degrees=60.0, element=request.param)


def free(problem: Problem) -> Turning:
    return Turning(problem.body, NOBODY, csr_array((0, problem.n_nodes)))


def about(x: np.ndarray, rotation: Rotation, center: np.ndarray) -> np.ndarray:
    return rotation.apply(x - center) + center


def gradients(problem: Problem, x: np.ndarray) -> np.ndarray:
    return np.einsum("mai,mqaj->mqij", x[problem.body.elements], problem.body.dN)


@pytest.mark.parametrize("degrees", [1e-3, 0.5, 40.0, 170.0])
def test_a_step_along_a_rotation_is_the_rotation(problem: Problem, degrees: float) -> None:
    """The straight step would stretch the part by 1 / cos."""
    x = problem.X_temp
    vector = np.radians(degrees) * np.array([2.0, -1.0, 2.0]) / 3
    turned = free(problem).step(x, np.cross(vector, x - x[0]))
    np.testing.assert_allclose(turned, about(x, Rotation.from_rotvec(vector), x[0]), atol=1e-11)


def test_a_uniform_stretch_is_a_straight_step(problem: Problem) -> None:
    x = problem.X_temp
    dx = (x - x[0]) @ np.diag([0.2, -0.1, 0.05])
    np.testing.assert_allclose(free(problem).step(x, dx), x + dx, atol=1e-12)


def test_steps_differ_from_straight_ones_in_second_order(problem: Problem) -> None:
    x, rng = problem.X_temp, np.random.default_rng(0)
    turning, A = free(problem), rng.standard_normal((3, 3))
    dx = np.sin(4 * x @ A)
    size = [np.abs(turning.step(x, t * dx) - x - t * dx).max() for t in (1e-3, 5e-4, 2.5e-4)]
    assert size[0] > 1e-8
    np.testing.assert_allclose(np.divide(size[:2], size[1:]), 4.0, rtol=0.02)


@pytest.mark.parametrize("clamped", [True, False])
def test_clamp_and_patches_move_as_in_the_straight_step(problem: Problem, clamped: bool) -> None:
    x, W = problem.X_temp, two_patches(problem).operator
    nodes = np.flatnonzero(problem.clamp) if clamped else NOBODY
    dx = 0.1 * np.sin(9 * x[:, [1, 2, 0]])
    ahead = Turning(problem.body, nodes, W).step(x, dx)
    np.testing.assert_allclose(W @ ahead, W @ (x + dx), atol=1e-13)
    np.testing.assert_array_equal(ahead[nodes], (x + dx)[nodes])
    assert np.abs(ahead - x - dx).max() > 1e-3


def test_without_a_clamp_a_rotation_of_the_patches_is_a_rotation(problem: Problem) -> None:
    """Its patches cannot follow a straight step and a rotation at once: about their mean they come nearest."""
    x, W = problem.X_temp, two_patches(problem).operator
    vector = np.array([0.0, 0.0, 0.3])
    rotation = Rotation.from_rotvec(vector)
    turned = about(x, rotation, x[0])
    gap = W @ turned - W @ x
    np.testing.assert_allclose(Turning(problem.body, NOBODY, W).repeat(x, turned, x, 1.0, gap), turned, atol=1e-11)


@pytest.mark.parametrize("ratio", [0.5, 1.0, 2.0])
def test_a_motion_is_repeated(problem: Problem, ratio: float) -> None:
    """A turn with a stretch along the axis, made twice, is twice the angle and the stretch squared."""
    X, axis = problem.body.X, np.array([1.0, 0.0, 0.0])

    def moved(x: np.ndarray, times: float) -> np.ndarray:
        return Rotation.from_rotvec(0.7 * times * axis).apply(x * [1.1**times, 0.95**times, 0.95**times])

    once = moved(X, 1.0)
    further = free(problem).repeat(X, once, once, ratio)
    np.testing.assert_allclose(gradients(problem, further), gradients(problem, moved(once, ratio)), atol=1e-10)


def test_a_motion_is_carried_over_to_another_shape(problem: Problem) -> None:
    X, x = problem.body.X, problem.X_temp
    rotation = Rotation.from_rotvec([0.3, -0.2, 0.5])
    carried = free(problem).repeat(X, rotation.apply(X), x)
    np.testing.assert_allclose(gradients(problem, carried), gradients(problem, rotation.apply(x)), atol=1e-10)
