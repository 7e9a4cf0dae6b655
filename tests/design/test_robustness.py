"""What a bit of error in rig and material does, against equilibria solved anew, and stability against the tangents."""

from dataclasses import replace
from itertools import product
from typing import Any

import numpy as np
import pytest
from bars import CARD, SIZE, TIGHT, bar, corner, held_design, mixed_density, two_patches
from hypothesis import given, settings
from hypothesis import strategies as st

from fab4d.design import robustness
from fab4d.design.equilibria import Equilibria, Median
from fab4d.design.forward import balance
from fab4d.design.gauss_newton import Design, equilibrate, held_positions
from fab4d.design.objective import shape_error
from fab4d.design.patches import build_patches, patches_from_faces
from fab4d.design.problem import Problem, build_problem
from fab4d.design.robustness import (
    PHASES,
    Response,
    instability_of,
    with_moved_points,
    with_scaled_forces,
    with_scaled_modulus,
)
from fab4d.design.sensitivity import Linearisation, linearise
from fab4d.materials.cards import Moduli

STEPS = 10.0 ** -np.arange(2.0, 5.0, 0.5)


def maps(equilibria: Equilibria, design: Design) -> Linearisation:
    return linearise(equilibria, design.rho, design.median, design.final)


def response_of(equilibria: Equilibria, design: Design) -> Response:
    return robustness.response_of(equilibria, design, maps(equilibria, design))


def scaled_forces(equilibria: Equilibria, design: Design, factor: float) -> Design | None:
    return with_scaled_forces(equilibria, design, maps(equilibria, design), response_of(equilibria, design), factor)


@pytest.fixture(scope="module", params=["linear", "quadratic"])
def bent(request: pytest.FixtureRequest) -> tuple[Equilibria, Design]:
    """A bar of mixed material bent at two points, whose final shape is not quite the wanted one."""
    problem = bar((3, 2, 1), element=request.param)
    equilibria = two_patches(problem)
    return equilibria, held_design(equilibria, mixed_density(problem), problem.X_temp)


def rms(equilibria: Equilibria, design: Design) -> float:
    return shape_error(equilibria.problem, design.final.y).rms


def direction(equilibria: Equilibria, seed: int = 1) -> np.ndarray:
    return 0.1 * np.random.default_rng(seed).standard_normal((equilibria.patches.count, 3))


def squared_error(equilibria: Equilibria, design: Design, dc: np.ndarray) -> float:
    """Of the design with moved points, solved anew to rounding."""
    held, at = held_positions(equilibria, design.median) + dc, design
    moved = equilibrate(equilibria, at.rho, held, at.median.x, at.median.forces, at.final.y, TIGHT, 30)
    assert moved is not None
    return rms(equilibria, moved) ** 2


# -- the model of the error


def test_gradient_is_the_derivative_of_the_squared_error(bent: tuple[Equilibria, Design]) -> None:
    equilibria, design = bent
    dc = direction(equilibria)
    slope = 2 * response_of(equilibria, design).gradient @ dc.ravel()
    found = [
        (squared_error(equilibria, design, t * dc) - squared_error(equilibria, design, -t * dc)) / (2 * t)
        for t in STEPS
    ]
    assert min(abs(f / slope - 1) for f in found) < 1e-6


def test_curvature_is_the_second_derivative_where_the_wanted_shape_is_met(bent: tuple[Equilibria, Design]) -> None:
    equilibria, design = bent
    met = Equilibria(replace(equilibria.problem, X_temp=design.final.y), equilibria.patches)
    response, dc = response_of(met, design), direction(equilibria)
    assert response.rms < 1e-12
    assert np.abs(response.gradient).max() < 1e-12
    bend = 2 * dc.ravel() @ response.curvature @ dc.ravel()
    found = [(squared_error(met, design, t * dc) + squared_error(met, design, -t * dc)) / t**2 for t in STEPS]
    assert min(abs(f / bend - 1) for f in found) < 1e-4


def test_the_model_tells_the_simulated_error(bent: tuple[Equilibria, Design]) -> None:
    equilibria, design = bent
    response = response_of(equilibria, design)
    dc = 0.01 * direction(equilibria)
    moved = with_moved_points(equilibria, design, maps(equilibria, design), response, dc)
    assert moved is not None
    change = rms(equilibria, moved) - response.rms
    assert abs(change) > 0.002 * response.rms
    assert response.rms_after(dc) - response.rms == pytest.approx(change, rel=0.15)


def made_up(H: np.ndarray, g: np.ndarray, error: float = 0.01) -> Response:
    none = np.zeros((0, len(g)))
    return Response(error, none, np.zeros((len(g), len(g))), none, none, g, H, 0, 0)


@settings(max_examples=30, deadline=None)
@given(
    st.lists(st.floats(0, 10), min_size=3, max_size=3), st.sampled_from([0.0, 1e-3, 1.0, 30.0]), st.integers(0, 2**31)
)
def test_the_worst_move_is_the_worst_of_all(eigenvalues: list[float], slope: float, seed: int) -> None:
    rng = np.random.default_rng(seed)
    axes = np.linalg.qr(rng.standard_normal((3, 3)))[0]
    response = made_up(axes @ np.diag(eigenvalues) @ axes.T, slope * rng.standard_normal(3), error=100.0)
    worst = response.worst_move(0, 0.5)
    others = rng.standard_normal((500, 3))
    others *= 0.5 / np.linalg.norm(others, axis=1)[:, None]
    largest = max(response.rms_after(d) for d in [*others, *(0.5 * axes.T), *(-0.5 * axes.T)])
    assert np.linalg.norm(worst) == pytest.approx(0.5)
    assert response.rms_after(worst) >= largest - 1e-3 * (largest - 100.0) - 1e-12


def test_expected_error_is_the_mean_over_independent_random_moves() -> None:
    """Over the corners of a cube, whose covariance is that of random directions and of uniform coordinates."""
    rng = np.random.default_rng(0)
    root = rng.standard_normal((6, 6))
    response = made_up(root @ root.T, rng.standard_normal(6), error=5.0)
    moves = 0.3 / np.sqrt(3) * np.array(list(product((-1, 1), repeat=6)))
    mean = np.mean([response.rms_after(d) ** 2 for d in moves])
    assert response.expected_rms(0.3) == pytest.approx(np.sqrt(mean), rel=1e-12)


def test_moving_all_points_alike_costs_a_free_part_nothing() -> None:
    problem = bar((3, 2, 1))
    problem = replace(problem, clamp=np.zeros_like(problem.clamp))
    equilibria = three_patches(problem)
    response = response_of(equilibria, held_design(equilibria, mixed_density(problem), problem.X_temp))
    for axis in np.eye(3):
        assert response.rms_after(np.tile(axis, (3, 1))) == pytest.approx(response.rms, rel=1e-9)


def test_turning_everything_changes_nothing() -> None:
    upright = two_patches(bar((3, 2, 1)))
    R = np.linalg.qr(np.random.default_rng(4).standard_normal((3, 3)))[0]
    found = [errors_in_mm(upright, turn) for turn in (np.eye(3), R * np.sign(np.linalg.det(R)))]
    # The rig's compliance, 1e-4 in units of the diagonal of the bounding box, is all that differs.
    np.testing.assert_allclose(*found, rtol=2e-5)


def errors_in_mm(upright: Equilibria, R: np.ndarray) -> list[float]:
    """Of the turned bar: as it is, with both points off by 1 mm, and with each alone."""
    old, p = upright.problem, upright.patches
    X, X_temp = (old.length * shape @ R.T for shape in (old.body.X, old.X_temp))
    problem = build_problem(X, X_temp, old.body.elements, old.clamp, CARD)
    equilibria = Equilibria(problem, patches_from_faces(problem, p.centers, p.faces, p.offsets))
    response = response_of(equilibria, held_design(equilibria, mixed_density(problem), problem.X_temp))
    mm = 1 / problem.length
    alone = [response.rms_after(mm * np.outer(np.eye(2)[k], response.worst_move(k, mm) / mm)) for k in range(2)]
    return [error / mm for error in (response.rms, response.expected_rms(mm), *alone)]


# -- stability


def three_patches(problem: Problem) -> Equilibria:
    places = ((0.0, 0.5, 0.5), (1.0, 0.5, 1.0), (0.6, 1.0, 0.5))
    return Equilibria(
        problem, build_patches(problem, np.array([corner(problem, p) for p in places]), 5 / problem.length)
    )


def pushed(problem: Problem, share: float, tolerance: float = TIGHT) -> tuple[Equilibria, Design]:
    """The straight bar with its end face moved along it by a share of its length."""
    face = problem.body.X[:, 0] > SIZE[0] / problem.length - 1e-9
    assert face.sum() > 4
    end = corner(problem, (1.0, 0.5, 0.5))
    equilibria = Equilibria(problem, build_patches(problem, np.array([end]), 20 / problem.length))
    x = problem.body.X.copy()
    x[:, 0] += share * np.maximum(x[:, 0] - 8 / problem.length, 0)
    return equilibria, held_design(equilibria, np.zeros(problem.n_tets), x, tolerance)


def free_tangent_negatives(equilibria: Equilibria, design: Design) -> int:
    """Negative eigenvalues of the median's tangent without any rig, from all of its eigenvalues."""
    none = Equilibria(equilibria.problem, build_patches(equilibria.problem, np.zeros(0, np.int64), 0.0))
    pattern, data = none.held_pattern, none.median_tangent(design.rho, design.median.x)
    K = np.zeros((pattern.n_dofs, pattern.n_dofs))
    K[pattern.indices, pattern.column_of_entry()] = data
    eigenvalues = np.linalg.eigvalsh(K, UPLO="L")
    return int(np.sum(eigenvalues < -1e-8 * eigenvalues[-1]))


@pytest.mark.parametrize(("share", "ways"), [(0.03, 0), (-0.004, 0), (-0.08, 2)])
def test_a_pushed_column_gives_way_under_a_dead_load_but_not_when_locked(share: float, ways: int) -> None:
    """Euler: clamped with a free end at 1.3 to 2 % of compression, sideways in two directions, pinned at 10 %."""
    equilibria, design = pushed(bar((5, 2, 2), 0.0), share)
    unstable = instability_of(response_of(equilibria, design))
    assert (unstable.held, unstable.final, unstable.dead_loads) == (0, 0, ways)
    assert unstable.points.tolist() == [ways > 0]
    assert free_tangent_negatives(equilibria, design) == ways


@pytest.mark.parametrize("degrees", [10.0, 60.0, 110.0])
def test_dead_loads_are_judged_as_by_the_tangent_without_a_rig(degrees: float) -> None:
    problem = bar((5, 2, 2), degrees)
    equilibria = two_patches(problem)
    design = held_design(equilibria, mixed_density(problem), problem.X_temp)
    found = instability_of(response_of(equilibria, design))
    assert found.dead_loads == free_tangent_negatives(equilibria, design)


@pytest.mark.parametrize(("share", "stable"), [(0.05, True), (-0.01, False)])
def test_a_free_part_may_be_carried_along_but_turns_round_when_pushed(share: float, stable: bool) -> None:
    problem = bar((5, 2, 2), 0.0)
    problem = replace(problem, clamp=np.zeros_like(problem.clamp))
    equilibria = three_patches(problem)
    x = problem.body.X * np.array([1 + share, 1, 1])
    unstable = instability_of(response_of(equilibria, held_design(equilibria, np.zeros(problem.n_tets), x)))
    assert (unstable.held, unstable.dead_loads == 0) == (0, stable)


# -- changed designs


def test_no_change_gives_the_same_error(bent: tuple[Equilibria, Design]) -> None:
    equilibria, design = bent
    response = response_of(equilibria, design)
    none = np.zeros((equilibria.patches.count, 3))
    same = [
        with_moved_points(equilibria, design, maps(equilibria, design), response, none),
        with_scaled_forces(equilibria, design, maps(equilibria, design), response, 1.0),
        *(with_scaled_modulus(equilibria, design, maps(equilibria, design), phase, 1.0) for phase in PHASES),
    ]
    assert response.rms_after(none) == response.rms == rms(equilibria, design)
    for changed in same:
        assert changed is not None
        assert rms(equilibria, changed) == pytest.approx(response.rms, rel=1e-9)


def test_stiffening_all_phases_alike_scales_the_forces_alone(bent: tuple[Equilibria, Design]) -> None:
    equilibria, design = bent
    for phase in PHASES:
        changed = with_scaled_modulus(equilibria, design, maps(equilibria, design), phase, 2.0)
        assert changed is not None
        moduli = getattr(equilibria.problem, phase)
        equilibria = equilibria.with_moduli(**{phase: Moduli(2 * moduli.mu, 2 * moduli.kappa)})
        design = changed
    _, before = bent
    assert equilibria.problem.tpe.mu == 2.0
    np.testing.assert_allclose(
        design.median.forces, 2 * before.median.forces, atol=2e-4 * np.abs(design.median.forces).max()
    )
    assert shape_error(replace(equilibria.problem, X_temp=before.final.y), design.final.y).rms < 1e-5
    np.testing.assert_allclose(design.median.x, before.median.x, atol=1e-5)


def test_a_glassy_modulus_moves_the_final_shape_alone(bent: tuple[Equilibria, Design]) -> None:
    equilibria, design = bent
    changed = with_scaled_modulus(equilibria, design, maps(equilibria, design), "glassy", 1.3)
    assert changed is not None
    np.testing.assert_array_equal(changed.median.x, design.median.x)
    assert rms(equilibria, changed) != pytest.approx(rms(equilibria, design), rel=1e-4)


@pytest.mark.parametrize("factor", [0.95, 1.05])
@pytest.mark.parametrize("element", ["linear", "quadratic"])
def test_scaled_forces_hold_the_shape_that_is_told(element: str, factor: float) -> None:
    problem = bar((3, 2, 1), 10.0, element)
    equilibria = two_patches(problem)
    design = held_design(equilibria, mixed_density(problem), problem.X_temp)
    scaled = scaled_forces(equilibria, design, factor)
    assert scaled is not None
    missing = scaled.median.forces - factor * design.median.forces
    assert np.linalg.norm(missing) < 1e-4 * np.linalg.norm(design.median.forces)
    found = balance(equilibria, design.rho, scaled.median, scaled.final)
    assert max(found.median, found.final) < 1e-4
    moves = held_positions(equilibria, scaled.median) - held_positions(equilibria, design.median)
    told = response_of(equilibria, design).moves_for_forces((factor - 1) * design.median.forces)
    assert np.linalg.norm(moves - told) < 0.02 * np.linalg.norm(told)
    assert np.linalg.norm(moves) > 1e-4


def test_a_hardly_stretched_bar_obeys_hooke() -> None:
    problem = bar((5, 2, 2), 0.0)
    equilibria, design = pushed(problem, 1e-4, 1e-8)
    scaled = scaled_forces(equilibria, design, 1.5)
    assert scaled is not None
    rest = equilibria.patches.mean(problem.body.X)
    before, after = (equilibria.patches.mean(d.median.x) - rest for d in (design, scaled))
    np.testing.assert_allclose(after, 1.5 * before, atol=1e-3 * np.abs(before).max())
    assert rms(equilibria, scaled) < 1e-8


def test_moved_points_lead_past_unstable_states_from_the_state_before_alone(
    bent: tuple[Equilibria, Design], monkeypatch: pytest.MonkeyPatch
) -> None:
    equilibria, design = bent
    moves, tries = np.full((equilibria.patches.count, 3), 1e-3), list[tuple[np.ndarray, bool]]()

    def none(
        _: Equilibria, __: np.ndarray, ___: np.ndarray, x: np.ndarray, *____: object, stay: bool, **_____: object
    ) -> None:
        tries.append((x, stay))

    monkeypatch.setattr(robustness, "equilibrate", none)
    response = response_of(equilibria, design)
    assert with_moved_points(equilibria, design, maps(equilibria, design), response, moves) is None
    (ahead, first), (before, second) = tries
    assert (first, second) == (True, False)
    np.testing.assert_array_equal(before, design.median.x)
    assert np.abs(ahead - before).max() > 1e-4


def test_at_rest_no_mode_is_soft() -> None:
    """There elements have no negative curvature to cut off; a pushed column has."""
    rest, pressed = (response_of(*pushed(bar((5, 2, 2), 0.0), share)) for share in (0.0, -0.06))
    np.testing.assert_allclose(rest.stiffened, np.vstack([rest.dx_dc, rest.df_dc]), atol=1e-9)
    differ = pressed.stiffened - np.vstack([pressed.dx_dc, pressed.df_dc])
    assert np.abs(differ[: len(pressed.dx_dc)]).max() > 0.01


@pytest.mark.parametrize("softer", [1.0, 30.0])
def test_moved_points_are_followed_without_soft_modes_where_these_are_told_to_move_too_far(
    bent: tuple[Equilibria, Design], monkeypatch: pytest.MonkeyPatch, softer: float
) -> None:
    """softer : how many times too far the tangent tells that the shape moves"""
    equilibria, design = bent
    near, dc, guesses = maps(equilibria, design), 0.02 * direction(equilibria), list[np.ndarray]()
    true = response_of(equilibria, design)
    told = replace(true, dx_dc=softer * true.dx_dc)

    def watched(*args: Any, **options: Any) -> Design | None:
        guesses.append(args[3])
        return equilibrate(*args, **options)

    monkeypatch.setattr(robustness, "equilibrate", watched)
    found, other = (with_moved_points(equilibria, design, near, response, dc) for response in (told, true))
    assert found is not None
    assert other is not None
    np.testing.assert_allclose(found.median.x, other.median.x, atol=1e-6)
    x = design.median.x
    followed = true.dx_dc if softer == 1.0 else true.stiffened[: x.size]
    ahead = equilibria.held_turning.step(x, (followed @ dc.ravel()).reshape(x.shape))
    np.testing.assert_allclose(guesses[0], ahead, atol=1e-12)


@pytest.mark.parametrize(("factor", "first"), [(1.01, 1.0), (100.0, 0.25)])
def test_forces_that_move_points_far_are_changed_in_parts_at_once(
    bent: tuple[Equilibria, Design], monkeypatch: pytest.MonkeyPatch, factor: float, first: float
) -> None:
    """first : the share of the change that is tried first"""
    asked = list[np.ndarray]()

    def none(_: Equilibria, __: object, ___: np.ndarray, ____: Median, wanted: np.ndarray) -> None:
        asked.append(wanted)

    monkeypatch.setattr(robustness, "_median_of_forces", none)
    equilibria, design = bent
    assert scaled_forces(equilibria, design, factor) is None
    np.testing.assert_allclose(asked[0], (1 + first * (factor - 1)) * design.median.forces)
    assert len(asked) == (2 if first == 1 else 1)


def test_forces_that_nothing_can_balance_are_not_claimed() -> None:
    equilibria, design = pushed(bar((5, 2, 2), 0.0), -0.05)
    assert scaled_forces(equilibria, design, 1e3) is None
