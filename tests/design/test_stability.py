"""How near the median shape is to buckling: struts, whose ratio falls in proportion to their load."""

from dataclasses import replace

import numpy as np
import pytest
from bars import CARD, CLAMPED, held_design, mixed_density
from scipy.spatial.transform import Rotation
from shapes.boxes import box

from fab4d.design import finish, stability
from fab4d.design.equilibria import Equilibria, Median
from fab4d.design.finish import kept_clear
from fab4d.design.gauss_newton import build_model, equilibrate, evaluate, held_positions
from fab4d.design.objective import ObjectiveWeights, shape_error, smoothness_matrix
from fab4d.design.patches import build_patches
from fab4d.design.problem import Problem, build_problem
from fab4d.design.reduced import refit
from fab4d.design.sensitivity import Change
from fab4d.design.stability import soft_modes, softening, softening_penalty
from fab4d.solvers.linear import Factor, SingularMatrixError, product

SIZE = (60.0, 6.0, 8.0)
SOFT = ObjectiveWeights(error_scale=1e-3, least_stable=0.97, lam_stable=2.0)


def strut(shortened: float = 0.0, element: str = "quadratic", turn: Rotation | None = None) -> Problem:
    """A strut, clamped at its left end, that wants to be shorter by this share of its free length."""
    X, tets = box(SIZE, (8, 2, 2), "six")
    clamp = X[:, 0] <= CLAMPED
    x = X.copy()
    x[:, 0] -= shortened * np.maximum(X[:, 0] - CLAMPED, 0.0)
    if turn is not None:
        X, x = turn.apply(X), turn.apply(x)
    return build_problem(X, x, tets, clamp, CARD, element)


def pushed(problem: Problem, rho: np.ndarray, by: float, turn: Rotation | None = None) -> tuple[Equilibria, Median]:
    """The strut pushed along its axis at its free end, by the share `by` of its length."""
    surface = np.unique(problem.faces)
    center = surface[np.argmin(np.linalg.norm(problem.body.X[surface] - tip(problem, turn), axis=1))]
    equilibria = Equilibria(problem, build_patches(problem, np.array([center]), 3.7 / problem.length))
    axis = np.array([-by * SIZE[0] / problem.length, 0.0, 0.0])
    axis = axis if turn is None else turn.apply(axis)
    X = problem.body.X
    held = equilibria.patches.mean(X) + axis
    return equilibria, equilibria.solve_median(rho, held, X, np.zeros((1, 3)), 1e-10, 60)


def tip(problem: Problem, turn: Rotation | None) -> np.ndarray:
    place = np.array([SIZE[0], SIZE[1] / 2, SIZE[2] / 2])
    return (place if turn is None else turn.apply(place)) / problem.length


def even(problem: Problem) -> np.ndarray:
    return np.full(problem.n_tets, 0.6)


def test_at_rest_every_mode_keeps_its_stiffness() -> None:
    problem = strut()
    equilibria, median = pushed(problem, even(problem), by=0.0)
    np.testing.assert_allclose(soft_modes(equilibria, even(problem), median).ratios, 1.0, atol=1e-9)


def test_the_ratio_falls_in_proportion_to_the_load_and_the_strut_buckles_where_it_is_zero() -> None:
    """Euler: 1 - P / P_critical."""
    problem = strut()
    loads, ratios = [], []
    for by in (0.002, 0.004, 0.006, 0.008):
        equilibria, median = pushed(problem, even(problem), by)
        loads.append(np.linalg.norm(median.forces))
        ratios.append(soft_modes(equilibria, even(problem), median).ratios[0])
    critical = loads[0] / (1 - ratios[0])
    np.testing.assert_allclose(ratios, 1 - np.array(loads) / critical, atol=0.03)
    X = problem.body.X
    straight = [replace(median, x=X + share / (1 - ratios[-1]) * (median.x - X)) for share in (0.85, 1.2)]
    assert [unstable(equilibria, each) for each in straight] == [0, 1]


def unstable(equilibria: Equilibria, median: Median) -> int:
    """Negative eigenvalues of the tangent, of an even strut held at one point."""
    tangent = equilibria.held_analysis.factor(equilibria.median_tangent(even(equilibria.problem), median.x))
    return tangent.n_negative - 3


@pytest.mark.parametrize("shortened", [0.0003, 0.01, 0.06])
def test_as_many_ratios_are_negative_as_the_tangent_has_negative_eigenvalues(shortened: float) -> None:
    problem = strut(shortened)
    rho = even(problem)
    equilibria, median = pushed(problem, rho, by=0.0)
    straight = replace(median, x=problem.X_temp.copy())
    count = unstable(equilibria, straight)
    assert np.sum(soft_modes(equilibria, rho, straight).ratios < 0) == min(count, stability.MODES)
    assert (count > 0) == (shortened > 0.0003)


def test_ratios_do_not_depend_on_how_the_part_lies() -> None:
    turn = Rotation.from_rotvec([0.3, -1.1, 0.7])
    found = []
    for each in (None, turn):
        problem = strut(turn=each)
        equilibria, median = pushed(problem, even(problem), 0.006, each)
        found.append(soft_modes(equilibria, even(problem), median).ratios)
    np.testing.assert_allclose(*found, rtol=1e-3)


@pytest.mark.parametrize("element", ["linear", "quadratic"])
def test_derivatives_of_the_curvature_along_a_mode(element: str) -> None:
    """By central differences of phi . K phi, modes held."""
    problem = strut(element=element)
    rho, rng = mixed_density(problem), np.random.default_rng(1)
    equilibria, median = pushed(problem, rho, 0.006)
    modes, soft = soft_modes(equilibria, rho, median), softening(equilibria, SOFT, rho, median)
    count, h = len(soft.values), 1e-5
    assert count >= 2
    slope = -np.sqrt(2 * SOFT.lam_stable) / SOFT.least_stable
    dx, drho = 0.1 * rng.standard_normal(median.x.shape), rng.standard_normal(problem.n_tets)
    for k, mode in enumerate(modes.shapes[:count]):
        shapes = [curvature(equilibria, rho, median.x + t * dx, mode) for t in (-h, h)]
        densities = [curvature(equilibria, rho + t * drho, median.x, mode) for t in (-h, h)]
        by_shape, by_density = (slope * np.diff(each)[0] / (2 * h) for each in (shapes, densities))
        assert (soft.rows @ dx.ravel())[k] == pytest.approx(by_shape, rel=1e-4)
        assert soft.by_density[k] @ drho == pytest.approx(by_density, rel=1e-4)


def curvature(equilibria: Equilibria, rho: np.ndarray, x: np.ndarray, mode: np.ndarray) -> float:
    """phi . K phi, but for what the rig adds."""
    pattern, u = equilibria.held_pattern, np.concatenate([mode.ravel(), np.zeros(3)])
    return float(u @ product(pattern.indptr, pattern.indices, equilibria.median_tangent(rho, x), u))


def test_modes_are_scaled_by_their_positive_stiffness() -> None:
    """Then the ratio is the curvature along the mode, but for what the rig adds to it: nothing at a held point."""
    problem = strut()
    rho = even(problem)
    equilibria, median = pushed(problem, rho, 0.006)
    modes = soft_modes(equilibria, rho, median)
    along = [curvature(equilibria, rho, median.x, mode) for mode in modes.shapes]
    np.testing.assert_allclose(along, modes.ratios, atol=1e-3)
    assert np.abs(modes.shapes[:, problem.clamp]).max() == 0


def test_the_gradient_of_the_objective_counts_soft_modes() -> None:
    """By central differences in the held position, near instability, where what K+ changes counts little.

    A density acts both by itself and by the shape.
    """
    problem, weights = strut(), SOFT.replace(error_scale=1e3, least_stable=0.3)
    rho, L = even(problem), smoothness_matrix(problem)
    equilibria, median = pushed(problem, rho, 0.017)
    design = held_design(equilibria, rho, median.x, 1e-9)
    model, careless = (build_model(equilibria, each, L, design) for each in (weights, weights.replace(lam_stable=0.0)))
    held, step, values = held_positions(equilibria, design.median), np.array([[1e-4, 0.0, 0.0]]), []
    for sign in (-1, 1):
        at = equilibrate(equilibria, rho, held + sign * step, median.x, median.forces, design.final.y, 1e-9, 60)
        assert at is not None
        values.append(evaluate(equilibria, weights, L, at))
    assert model.gradient_c @ step.ravel() == pytest.approx((values[1] - values[0]) / 2, rel=0.1)
    soft = softening(equilibria, weights, rho, design.median)
    by_shape = model.lin.adjoint_rho(Change(soft.rows.T @ soft.values, np.zeros(3), np.zeros(median.x.size)))
    np.testing.assert_allclose(
        model.gradient_rho, careless.gradient_rho + soft.density_gradient() + by_shape, rtol=1e-6, atol=1e-12
    )


@pytest.mark.parametrize("by", [0.006, 0.017])
def test_the_least_ratio_is_that_of_the_softest_mode(by: float) -> None:
    problem = strut()
    equilibria, median = pushed(problem, even(problem), by)
    design = held_design(equilibria, even(problem), median.x, 1e-9)
    softest = soft_modes(equilibria, even(problem), median).ratios[0]
    assert finish.least_ratio(equilibria, design) == pytest.approx(softest, rel=1e-3)


def test_half_the_squares_of_the_values_are_the_penalty() -> None:
    problem = strut()
    equilibria, median = pushed(problem, even(problem), 0.006)
    values = softening(equilibria, SOFT, even(problem), median).values
    assert softening_penalty(equilibria, SOFT, even(problem), median) == pytest.approx(0.5 * values @ values)
    assert values @ values > 0


def test_nothing_is_worked_out_without_a_price(monkeypatch: pytest.MonkeyPatch) -> None:
    problem = strut()
    equilibria, median = pushed(problem, even(problem), 0.006)
    monkeypatch.setattr(stability, "_found", None)
    none = softening(equilibria, SOFT.replace(lam_stable=0.0), even(problem), median)
    assert none.rows.shape == (0, median.x.size)
    assert not none.density_gradient().any()
    assert softening_penalty(equilibria, SOFT.replace(lam_stable=0.0), even(problem), median) == 0


def test_a_fit_that_keeps_clear_stops_before_the_strut_buckles() -> None:
    """And errs by more, where the temporary shape asks for more than a strut can be pushed."""
    problem = strut(shortened=0.03)
    rho = even(problem)
    equilibria, median = pushed(problem, rho, 0.002)
    start = held_design(equilibria, rho, median.x, 1e-9)
    weights = ObjectiveWeights(error_scale=0.5 * shape_error(problem, start.final.y).rms)
    careless, careful = (refit(equilibria, start, each, [].append) for each in (weights, kept_clear(weights)))
    ratios = [soft_modes(equilibria, rho, each.median).ratios[0] for each in (start, careless, careful)]
    errors = [shape_error(problem, each.final.y).rms for each in (start, careless, careful)]
    assert ratios[0] > 0.5
    assert ratios[1] < 0.05
    assert 0.1 < ratios[2] < finish.LEAST_STABLE
    assert errors[1] < errors[2] < 0.5 * errors[0]


def test_a_singular_tangent_is_never_better(monkeypatch: pytest.MonkeyPatch) -> None:
    problem = strut()
    equilibria, median = pushed(problem, even(problem), 0.006)

    def refuse(*_: object) -> Factor:
        raise SingularMatrixError

    monkeypatch.setattr(equilibria.held_analysis, "factor", refuse)
    assert softening_penalty(equilibria, SOFT, even(problem), median) == np.inf


def test_modes_are_sought_once_for_a_median_shape(monkeypatch: pytest.MonkeyPatch) -> None:
    """A step asks for those of a design that the step before it has judged."""
    problem = strut()
    equilibria, median = pushed(problem, even(problem), 0.006)
    first = soft_modes(equilibria, even(problem), median)
    monkeypatch.setattr(stability, "_found", None)
    assert soft_modes(equilibria, even(problem), median) is first


def test_modes_that_are_not_found_in_time_are_left_out(monkeypatch: pytest.MonkeyPatch) -> None:
    problem = strut()
    equilibria, median = pushed(problem, even(problem), 0.006)
    every = soft_modes(equilibria, even(problem), median)
    monkeypatch.setattr(stability, "MOST_BLOCKS", 2)
    few = soft_modes(equilibria, even(problem), replace(median))
    assert 0 < len(few.ratios) < len(every.ratios) == stability.MODES
    np.testing.assert_allclose(few.ratios, every.ratios[: len(few.ratios)], rtol=1e-2)
