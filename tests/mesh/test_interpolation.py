"""Paths between two shapes: their ends, turns beyond 180 degrees, and no inverted tets on the way."""

from itertools import permutations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from fab4d.mesh.interpolation import ShapePath, shape_path
from fab4d.mesh.measures import deformation_gradients, tet_volumes
from fab4d.mesh.topology import TET_EDGES

LENGTH, CELLS = 12.0, (12, 2, 2)


@pytest.fixture(scope="module")
def bar() -> tuple[np.ndarray, np.ndarray]:
    """A bar along x of 12 x 1 x 1: X (n, 3), tets (m, 4)."""
    corners = np.array([[k & 1, k >> 1 & 1, k >> 2] for k in range(8)])
    kuhn = np.array([[0, 1 << a, (1 << a) + (1 << b), 7] for a, b, _ in permutations(range(3))])
    places = np.indices(CELLS).reshape(3, -1).T[:, None] + corners
    X, number = np.unique(places.reshape(-1, 3), axis=0, return_inverse=True)
    X = X * [1.0, 0.5, 0.5]
    tets = number.reshape(-1, 8)[:, kuhn].reshape(-1, 4)
    negative = tet_volumes(X, tets) < 0
    tets[negative] = tets[negative][:, [0, 1, 3, 2]]
    return X, tets


def bent(X: np.ndarray, degrees: float) -> np.ndarray:
    """The bar bent to an arc in the x-y plane, its first section fixed."""
    radius = LENGTH / np.radians(degrees)
    turn = X[:, 0] / radius
    arm = radius - (X[:, 1] - 0.5)
    return np.column_stack([arm * np.sin(turn), 0.5 + radius - arm * np.cos(turn), X[:, 2]])


def twisted(X: np.ndarray, degrees: float) -> np.ndarray:
    """The bar twisted about its middle line, its first section fixed."""
    middle = np.array([0.0, 0.5, 0.5])
    return Rotation.from_rotvec(np.outer(np.radians(degrees) * X[:, 0] / LENGTH, [1, 0, 0])).apply(X - middle) + middle


def path_to(x: np.ndarray, bar: tuple[np.ndarray, np.ndarray]) -> ShapePath:
    X, tets = bar
    return shape_path(X, x, tets, X[:, 0] == 0.0)


def tip_turn(path: ShapePath, t: float, bar: tuple[np.ndarray, np.ndarray]) -> np.ndarray:
    """Rotation vector between 0 and 180 degrees of the last section of the bar."""
    X, tets = bar
    last = (X[tets][:, :, 0] >= LENGTH - 1).all(axis=1)
    F = deformation_gradients(X, path.at(t), tets[last]).mean(axis=0)
    U, _, Vt = np.linalg.svd(F)
    return Rotation.from_matrix(U @ Vt).as_rotvec(degrees=True)


@pytest.mark.parametrize("degrees", [40.0, 170.0, 250.0, 350.0])
def test_the_path_begins_and_ends_at_the_two_shapes(bar, degrees: float) -> None:
    X, _ = bar
    x = bent(X, degrees)
    path = path_to(x, bar)
    np.testing.assert_allclose(path.at(0.0), X, atol=1e-12)
    np.testing.assert_allclose(path.at(1.0), x, atol=1e-12)


def test_any_shape_is_reached_exactly(bar) -> None:
    X, tets = bar
    x = bent(X, 100.0) * [1.0, 1.2, 0.9] + 0.03 * np.random.default_rng(0).standard_normal(X.shape)
    np.testing.assert_allclose(path_to(x, bar).at(1.0), x, atol=1e-12)
    assert np.linalg.det(deformation_gradients(X, x, tets)).min() > 0


@pytest.mark.parametrize("degrees", [170.0, 250.0, 350.0, -250.0, 500.0])
def test_long_turns_are_followed_the_long_way(bar, degrees: float) -> None:
    """At t the tip has turned t times the whole angle, though only the angle within half a turn can be seen in F."""
    X, tets = bar
    path = path_to(bent(X, degrees), bar)
    # The tets of the last section, on the mean, lie half a cell before the tip.
    whole = degrees * (LENGTH - 0.5) / LENGTH
    for t in (0.1, 0.25, 0.5, 0.75, 0.9):
        expected = Rotation.from_euler("z", t * whole, degrees=True)
        seen = Rotation.from_rotvec(tip_turn(path, t, bar), degrees=True)
        assert np.degrees((seen * expected.inv()).magnitude()) < 3.0
        assert np.linalg.det(deformation_gradients(X, path.at(t), tets)).min() > 0.5


def test_the_halfway_shape_of_a_bend_is_half_the_bend(bar) -> None:
    X, _ = bar
    np.testing.assert_allclose(path_to(bent(X, 250.0), bar).at(0.5), bent(X, 125.0), atol=0.06)


@pytest.mark.parametrize("degrees", [180.0, 270.0])
def test_a_twist_inverts_no_tet_on_the_way(bar, degrees: float) -> None:
    X, tets = bar
    path = path_to(twisted(X, degrees), bar)
    for t in np.linspace(0, 1, 9):
        x = path.at(t)
        assert np.linalg.det(deformation_gradients(X, x, tets)).min() > 0.6
    np.testing.assert_allclose(path.at(0.5), twisted(X, degrees / 2), atol=0.1)
    # Straight lines between the two shapes would crush the tip of the half turn.
    straight = 0.5 * (X + twisted(X, 180.0))
    assert np.linalg.det(deformation_gradients(X, straight, tets)).min() < 0.05


@pytest.mark.parametrize("degrees", [400.0, 540.0, -720.0])
def test_a_twist_of_more_than_a_turn_is_followed_the_long_way(bar, degrees: float) -> None:
    """Past a whole turn, tets that are tilted a little have no rotation vector near that of their neighbours."""
    X, tets = bar
    path = path_to(twisted(X, degrees), bar)
    np.testing.assert_allclose(path.at(1.0), twisted(X, degrees), atol=1e-12)
    for t in np.linspace(0, 1, 9)[1:-1]:
        assert np.linalg.det(deformation_gradients(X, path.at(t), tets)).min() > 0.5
        expected = Rotation.from_euler("x", t * degrees * (LENGTH - 0.5) / LENGTH, degrees=True)
        seen = Rotation.from_rotvec(tip_turn(path, t, bar), degrees=True)
        assert np.degrees((seen * expected.inv()).magnitude()) < 6.0


def test_a_bend_with_a_twist_of_more_than_a_turn_is_followed(bar) -> None:
    X, tets = bar
    x = bent(twisted(X, 500.0), 200.0)
    path = path_to(x, bar)
    for t in np.linspace(0, 1, 9):
        assert np.linalg.det(deformation_gradients(X, path.at(t), tets)).min() > 0.4


def test_a_rigid_motion_is_followed_rigidly(bar) -> None:
    """Also of the anchor, which goes straight: then only the tets that touch it deform."""
    X, tets = bar
    middle = np.array([0, 0.5, 0.5])
    x = Rotation.from_euler("x", 90, degrees=True).apply(X - middle) + middle
    one = np.zeros(len(X), bool)
    one[np.argmin(np.linalg.norm(X - middle, axis=1))] = True
    half = shape_path(X, x, tets, one).at(0.5)
    edges = np.unique(np.sort(tets[:, TET_EDGES].reshape(-1, 2), axis=1), axis=0)
    lengths = [np.linalg.norm(p[edges[:, 0]] - p[edges[:, 1]], axis=1) for p in (X, half)]
    np.testing.assert_allclose(lengths[1], lengths[0], rtol=1e-10)


def test_fixed_vertices_stay(bar) -> None:
    X, _ = bar
    path = path_to(bent(X, 250.0), bar)
    fixed = X[:, 0] == 0.0
    for t in (0.3, 0.7):
        np.testing.assert_array_equal(path.at(t)[fixed], (1 - t) * X[fixed] + t * bent(X, 250.0)[fixed])


def test_separate_pieces_are_followed_each(bar) -> None:
    X, tets = bar
    aside = np.array([0, 5, 0])
    both = np.vstack([X, X + aside])
    wanted = np.vstack([bent(X, 250.0), bent(X, -250.0) + aside])
    path = shape_path(both, wanted, np.vstack([tets, tets + len(X)]), both[:, 0] == 0.0)
    np.testing.assert_allclose(path.at(0.5)[: len(X)], path_to(bent(X, 250.0), bar).at(0.5), atol=1e-9)
    np.testing.assert_allclose(path.at(0.5)[len(X) :] - aside, path_to(bent(X, -250.0), bar).at(0.5), atol=1e-9)


def test_a_tet_that_is_turned_inside_out_is_followed(bar: tuple[np.ndarray, np.ndarray]) -> None:
    """As the corners of a curved quadratic tet may be; the path still ends in the shape."""
    X, tets = bar
    x = bent(X, 90.0)
    x[np.argmax(X @ [1.0, 1.0, 1.0])] -= [0.9, 0.9, 0.9]
    assert np.linalg.det(deformation_gradients(X, x, tets)).min() < 0
    np.testing.assert_allclose(path_to(x, bar).at(1.0), x, atol=1e-9)
