"""The reduced solver on scenes whose answer is known, because they were made by simulating a design."""

import itertools
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest
from bars import CARD, CLAMPED, bar, corner, held_design, two_patches

from fab4d.design import gauss_newton, reduced
from fab4d.design.equilibria import Equilibria
from fab4d.design.forward import balance, program
from fab4d.design.gauss_newton import Design
from fab4d.design.objective import PULL_MARGIN, ObjectiveWeights, shape_error, smoothness_matrix
from fab4d.design.patches import Patches, build_patches, outward_normals, patches_from_faces, spread_centers
from fab4d.design.paths import change_density
from fab4d.design.problem import Problem, build_problem
from fab4d.design.reduced import (
    Phase,
    ReducedSettings,
    Search,
    at_rest,
    decided,
    decided_by_and_by,
    fewest_points,
    first_search,
    largest_traction,
    polished,
    refit,
    relax_step,
    relaxed,
    round_step,
    solve_reduced,
    undecided_fraction,
)
from fab4d.design.sensitivity import Linearisation
from fab4d.errors import EquilibriumError
from fab4d.mesh.measures import deformation_gradients
from fab4d.mesh.rigid import best_rigid_motion
from fab4d.solvers import threads
from fab4d.solvers.newton import Solution, Status

WEIGHTS = ObjectiveWeights(error_scale=1e-3, lam_SMP=0.05, lam_smooth=0.3)


@dataclass(frozen=True, eq=False)
class Truth:
    """A scene and the design that it was made from."""

    problem: Problem
    equilibria: Equilibria
    design: Design


@pytest.fixture(scope="module")
def truth() -> Truth:
    """SMP in the upper half and at the clamp, pulled at two points; what it becomes is what is wanted."""
    made = bar(degrees=45.0)
    equilibria, X, clamp = two_patches(made), made.body.X, made.clamp
    centroids = X[made.body.elements].mean(axis=1)
    smp = (centroids[:, 2] > 0.5 * X[:, 2].max()) | (centroids[:, 0] < CLAMPED / made.length)
    design = held_design(equilibria, smp.astype(np.float64), made.X_temp)
    R, t = best_rigid_motion(design.final.y[clamp], X[clamp])
    wanted = design.final.y @ R.T + t
    problem = build_problem(X * made.length, wanted * made.length, made.body.elements, clamp, CARD)
    return Truth(problem, Equilibria(problem, equilibria.patches), design)


def settings_for(problem: Problem, **changes: object) -> ReducedSettings:
    settings = ReducedSettings(n_points=4, patch_radii=(6.0 / problem.length,), weights=WEIGHTS)
    return replace(settings, **changes)  # type: ignore[arg-type]


@pytest.fixture(scope="module")
def searched(truth: Truth) -> list[Search]:
    """Every state that the solver shows on its way."""
    states: list[Search] = []
    solve_reduced(truth.problem, settings_for(truth.problem), states.append)
    return states


def rms(problem: Problem, design: Design) -> float:
    return shape_error(problem, design.final.y).rms


def printed(found: Search, weights: ObjectiveWeights = WEIGHTS) -> Design:
    """The found design with densities rounded and held positions fitted again."""
    labels = np.round(found.design.rho)
    design = change_density(found.equilibria, found.design, labels)
    return polished(found.equilibria, refit(found.equilibria, design, weights, lambda at: None))  # noqa: ARG005


def test_a_scene_made_from_a_design_is_solved(truth: Truth, searched: list[Search]) -> None:
    """Not with the same tets, for many designs have one final shape, but with the same shape."""
    problem, found = truth.problem, searched[-1]
    moved = float(np.sqrt(problem.area_weights @ ((problem.X_temp - problem.body.X) ** 2).sum(axis=1)))
    assert moved > 0.1
    design = printed(found)
    assert set(np.unique(design.rho)) == {0.0, 1.0}
    assert rms(problem, design) < 3e-3
    assert found.equilibria.patches.count == 4


def test_the_solved_scene_is_reached_from_the_permanent_shape(truth: Truth, searched: list[Search]) -> None:
    found = searched[-1]
    design = printed(found)
    done = program(found.equilibria, design.rho, design.median.x, design.median.forces)
    assert (done.loaded, done.unloaded) == (1.0, 1.0)
    assert balance(found.equilibria, design.rho, done.median, done.final).final < 1e-9
    assert shape_error(truth.problem, done.final.y).rms < 3e-3


def test_points_begin_where_they_are_asked_for(truth: Truth) -> None:
    centers = spread_centers(truth.problem, 7)[3:]
    found = first_search(truth.problem, settings_for(truth.problem, centers=centers))
    np.testing.assert_array_equal(found.equilibria.patches.centers, centers)


def test_loading_finds_the_first_shape_where_newton_does_not(truth: Truth, monkeypatch: pytest.MonkeyPatch) -> None:
    """It is the same one, here where both do."""
    expected = first_search(truth.problem, settings_for(truth.problem)).design.median.x
    lost = Solution(np.zeros(0), Status.NO_STEP, 1.0, 0, 0)
    direct = reduced._relaxed
    monkeypatch.setattr(reduced, "_relaxed", lambda *given: replace(direct(*given), solution=lost))
    found = first_search(truth.problem, settings_for(truth.problem)).design.median.x
    np.testing.assert_allclose(found, expected, atol=1e-6)
    monkeypatch.setattr(reduced, "load", lambda equilibria, rho, x, f: (direct(equilibria, rho, x), 1, 0.5))  # noqa: ARG005
    with pytest.raises(EquilibriumError, match="no equilibrium near the temporary shape with 4 points"):
        first_search(truth.problem, settings_for(truth.problem))


def test_larger_patches_are_taken_where_small_ones_stretch_too_far(truth: Truth) -> None:
    """With one point: several large patches on this bar share what they cover, and then none grows with the radius."""
    problem, radii = truth.problem, tuple(radius / truth.problem.length for radius in (3.0, 9.0))
    small, large = (first_search(problem, settings_for(problem, n_points=1, patch_radii=(radius,))) for radius in radii)
    stretches = [largest_stretch(problem, found.design.median.x) for found in (small, large)]
    assert stretches[1] < stretches[0]
    between = 0.5 * sum(stretches)
    for limit, expected in ((2 * stretches[0], radii[0]), (between, radii[1]), (1.01, radii[1])):
        weights = WEIGHTS.replace(smp_max_stretch=limit, tpe_max_stretch=limit)
        found = first_search(problem, settings_for(problem, n_points=1, patch_radii=radii, weights=weights))
        assert found.patch_radius == expected
        assert np.isclose(largest_stretch(problem, found.design.median.x), stretches[radii.index(expected)])


def test_larger_patches_are_taken_where_small_ones_pull_too_hard(truth: Truth, monkeypatch: pytest.MonkeyPatch) -> None:
    """The limit lies between the tractions of the smallest and the largest; what is surely too small is not tried."""
    problem, radii = truth.problem, tuple(radius / truth.problem.length for radius in (3.0, 3.1, 9.0))
    tried: list[int] = []

    def kept(_: Problem, centers: np.ndarray, radius: float) -> Patches:
        tried.append(radii.index(radius))
        return build_patches(problem, centers, radius)

    def with_limit(limit: float) -> Search:
        tried.clear()
        monkeypatch.setattr(reduced, "LARGEST_TRACTION", limit)
        return first_search(problem, settings_for(problem, n_points=1, patch_radii=radii))

    monkeypatch.setattr(reduced, "build_patches", kept)
    tractions = {}
    for radius in (radii[0], radii[2]):
        found = first_search(problem, settings_for(problem, n_points=1, patch_radii=(radius,)))
        tractions[radius] = largest_traction(found.equilibria.patches, problem, found.design.median)
    small, large = tractions[radii[0]], tractions[radii[2]]
    assert large < 0.9 * small
    for limit, expected, seen in (
        (1.01 * small, 0, [0]),
        (0.5 * (small + large), 2, [0, 2]),
        (0.01 * large, 2, [0, 2]),
    ):
        assert with_limit(limit).patch_radius == radii[expected]
        assert tried == seen


def test_the_traction_of_a_patch_is_its_force_over_its_area(truth: Truth) -> None:
    """On the flat end of the bar that a large patch covers."""
    problem = truth.problem
    tip = int(np.argmax(problem.body.X[:, 0]))
    patches = build_patches(problem, np.array([tip]), 1.0)
    flat = problem.body.X[patches.faces][:, :, 0].min(axis=1) == problem.body.X[:, 0].max()
    area = np.ptp(problem.body.X[:, 1]) * np.ptp(problem.body.X[:, 2])
    end = patches_from_faces(problem, np.array([tip]), patches.faces[flat], np.array([0, flat.sum()]))
    median = replace(truth.design.median, forces=np.array([[0.3, 0.0, -0.4]]))
    assert largest_traction(end, problem, median) == pytest.approx(0.5 / area)
    assert largest_traction(build_patches(problem, np.zeros(0, np.int64), 0.1), problem, median) == 0


@pytest.mark.parametrize(("share", "goes_on"), [(0.9, False), (1.2, True), (3.0, False)])
def test_steps_past_unstable_states_are_taken_where_the_tolerance_is_nearly_met(
    truth: Truth, monkeypatch: pytest.MonkeyPatch, share: float, goes_on: bool
) -> None:
    """Once, at the end of relaxing: then the same state is about to be rounded."""
    problem, stays = truth.problem, list[bool]()
    start = first_search(problem, settings_for(problem))
    weights = WEIGHTS.replace(error_scale=rms(problem, start.design) / share)
    settings, L = settings_for(problem, weights=weights), smoothness_matrix(problem)

    def refuse(*_: object, stay: bool = True) -> gauss_newton.Step:
        stays.append(stay)
        return gauss_newton.Step(start.design, np.inf, 1e5, False)

    monkeypatch.setattr(reduced, "gauss_newton_step", refuse)
    after = relax_step(replace(start, exchanges=reduced.EXCHANGED), settings, L)
    assert after.phase is (Phase.RELAX if goes_on else Phase.ROUND)
    assert after.damping <= reduced.LARGEST_DAMPING
    if goes_on:
        last = relax_step(replace(after, exchanges=reduced.EXCHANGED), settings, L)
        assert last.phase is Phase.ROUND
        assert last.relaxed_rms == rms(problem, start.design)
    assert stays == [True, False][: 1 + goes_on]


@pytest.mark.parametrize("stay", [True, False])
def test_a_step_may_lead_past_unstable_states(monkeypatch: pytest.MonkeyPatch, stay: bool) -> None:
    """A strut, pushed along its axis by a fifth of its length in one step, buckles on its way to equilibrium."""
    problem = bar(cells=(10, 2, 2), degrees=0.0)
    X, rho = problem.body.X, np.full(problem.n_tets, 0.6)
    equilibria = Equilibria(
        problem, build_patches(problem, np.array([corner(problem, (1.0, 0.5, 0.5))]), 6 / problem.length)
    )
    straight = held_design(equilibria, rho, X)
    L = smoothness_matrix(problem)
    model = gauss_newton.build_model(equilibria, WEIGHTS, L, straight)
    monkeypatch.setattr(gauss_newton, "LARGEST_MOVE", 10.0)
    # Which way it buckles is chance, and with that the length of the way.
    monkeypatch.setattr(gauss_newton, "ASTRAY_ITERATIONS", 60)
    found = gauss_newton._trial(
        equilibria, model, straight, np.zeros(problem.n_tets), np.array([[-0.2, 0.0, 0.0]]), stay
    )
    assert (found is None) == stay
    if found is not None:
        tangent = equilibria.held_analysis.factor(equilibria.median_tangent(rho, found.median.x))
        assert tangent.n_negative == 3
        assert np.abs(found.median.x - X)[:, 1:].max() > 0.1


def largest_stretch(problem: Problem, x: np.ndarray) -> float:
    body = problem.body
    F = np.einsum("mai,maj->mij", x[body.elements], body.dN.mean(axis=1))
    return float(np.linalg.svd(F, compute_uv=False).max())


def test_states_are_in_equilibrium_and_within_bounds(searched: list[Search]) -> None:
    for at in searched:
        assert at.design.rho.min() >= 0
        assert at.design.rho.max() <= 1
        found = balance(at.equilibria, at.design.rho, at.design.median, at.design.final)
        assert max(found.median, found.final) < 1e-2
        assert found.min_det_F > 0
    assert undecided_fraction(searched[-1].design.rho) <= 2e-4


def test_phases_follow_each_other(searched: list[Search]) -> None:
    phases = [at.phase for at in searched if at.phase is not Phase.EXCHANGE]
    assert phases == sorted(phases, key=list(Phase).index)
    assert phases[-1] is Phase.DONE
    errors = [rms(at.equilibria.problem, at.design) for at in searched if at.phase is Phase.RELAX]
    assert errors[-1] < 0.5 * errors[0]


@pytest.mark.parametrize("pull_only", [False, True])
def test_a_rig_that_only_pulls_is_asked_to_pull_only(pull_only: bool) -> None:
    """Where it may, the same scene is pushed at two of its points. The penalty gives way by about its margin."""
    problem = bar(cells=(6, 2, 2), degrees=45.0)
    weights = ObjectiveWeights(error_scale=5e-3, lam_SMP=0.05, lam_smooth=0.3, pull_only=pull_only)
    found = solve_reduced(problem, settings_for(problem, n_points=6, weights=weights), lambda at: None)  # noqa: ARG005
    median = found.design.median
    outward = (median.forces * outward_normals(found.equilibria.patches, median.x)).sum(axis=1)
    usual = np.sqrt((median.forces**2).sum(axis=1).mean())
    assert (outward > -PULL_MARGIN * usual).all() == pull_only
    assert rms(problem, found.design) < 5e-3


def test_the_fewest_points_meet_the_error_and_one_less_does_not() -> None:
    problem = bar(cells=(6, 2, 2), degrees=60.0)
    settings, seen = settings_for(problem, n_points=8), []

    def error_with(count: int) -> float:
        return relaxed(problem, replace(settings, n_points=count), lambda at: None).relaxed_rms  # noqa: ARG005

    enough = 1.001 * error_with(3)
    count = fewest_points(problem, settings, enough, seen.append)
    assert error_with(count) <= enough
    assert count == 1 or error_with(count - 1) > enough
    assert {at.equilibria.patches.count for at in seen} >= {count, 4}
    assert fewest_points(problem, replace(settings, n_points=2), 0.0, seen.append) == 2


def test_going_on_from_any_state_ends_with_the_same_bits(truth: Truth, searched: list[Search]) -> None:
    problem = truth.problem
    for at in (searched[1], searched[len(searched) // 2], searched[-2]):
        again = solve_reduced(problem, settings_for(problem), lambda state: None, at)  # noqa: ARG005
        np.testing.assert_array_equal(again.design.rho, searched[-1].design.rho)
        np.testing.assert_array_equal(again.design.final.y, searched[-1].design.final.y)


def test_rounding_ends_where_no_step_is_taken(
    truth: Truth, searched: list[Search], monkeypatch: pytest.MonkeyPatch
) -> None:
    """One step that is refused is followed by others; three in a row end it, and the best state is rounded."""
    before = next(at for at in searched if at.phase is Phase.ROUND and at.iteration == 2)
    states: list[Search] = []

    def refuse(*given: Any, **_: object) -> gauss_newton.Step:
        return gauss_newton.Step(given[3], np.inf, given[4], False)

    monkeypatch.setattr(reduced, "gauss_newton_step", refuse)
    found = solve_reduced(truth.problem, settings_for(truth.problem), states.append, before)
    assert [at.accepted for at in states[:4]] == [False, False, False, True]
    assert found is states[-1]
    assert found.phase is Phase.DONE
    np.testing.assert_array_equal(found.design.rho, np.round(before.design.rho))


@pytest.mark.parametrize(("decided_each", "steps"), [(1, 3), (3, 40)])
def test_rounding_ends_where_steps_decide_nothing(
    truth: Truth, searched: list[Search], monkeypatch: pytest.MonkeyPatch, decided_each: int, steps: int
) -> None:
    """Steps held back by the largest damping go on as long as each decides a few per cent of the 120 tets."""
    before = next(at for at in searched if at.phase is Phase.ROUND)
    taken: list[int] = []

    def decide(_: object, __: object, ___: object, design: Design, *____: object, **_____: object) -> gauss_newton.Step:
        taken.append(1)
        rho = np.where(np.arange(truth.problem.n_tets) < decided_each * len(taken), 1.0, 0.5)
        return gauss_newton.Step(replace(design, rho=rho), 0.0, reduced.LARGEST_DAMPING, True)

    monkeypatch.setattr(reduced, "gauss_newton_step", decide)
    open_design = replace(before.design, rho=np.full(truth.problem.n_tets, 0.5))
    at, L = replace(before, design=open_design, iteration=0, slow=0), smoothness_matrix(truth.problem)
    while at.phase is Phase.ROUND:
        at = round_step(at, settings_for(truth.problem), L)
    assert len(taken) == steps


@pytest.mark.parametrize(("relaxed", "scale"), [(0.01, 0.25), (0.3, 0.45), (0.9, 1.0), (np.inf, 1.0)])
def test_rounding_spends_little_more_than_the_relaxed_error_but_asks_for_no_tiny_one(
    searched: list[Search], relaxed: float, scale: float
) -> None:
    """In shares of the tolerance."""
    settings = settings_for(searched[-1].equilibria.problem)
    tolerance = settings.weights.error_scale
    weights = reduced._rounding_weights(replace(searched[-1], relaxed_rms=relaxed * tolerance), settings)
    assert weights.error_scale == pytest.approx(scale * tolerance)


def test_densities_left_undecided_are_rounded(truth: Truth, searched: list[Search]) -> None:
    """Where the steps have come to nothing."""
    last, problem = searched[-1], truth.problem
    rho = np.round(last.design.rho)
    rho[:12] = np.abs(rho[:12] - 0.3)
    ended = replace(last, design=change_density(last.equilibria, last.design, rho), phase=Phase.DONE)
    settings = settings_for(problem)
    found = solve_reduced(problem, settings, lambda at: None, ended)  # noqa: ARG005
    assert set(np.unique(found.design.rho)) == {0.0, 1.0}
    np.testing.assert_array_equal(found.design.rho[12:], rho[12:])
    assert balance(found.equilibria, found.design.rho, found.design.median, found.design.final).final < 1e-5


def test_rounded_by_and_by_the_rest_makes_up_for_it(truth: Truth, searched: list[Search]) -> None:
    """The surest first: each of the others, and the held positions, may still follow."""
    last, problem = searched[-1], truth.problem
    rho = np.round(last.design.rho)
    rho[::5] = np.abs(rho[::5] - np.linspace(0.4, 0.49, len(rho[::5])))
    ended = replace(last, design=change_density(last.equilibria, last.design, rho), phase=Phase.DONE)
    shown: list[Search] = []
    at_once, by_and_by = (
        change_density(last.equilibria, ended.design, np.round(rho)),
        decided(ended, settings_for(problem), shown.append),
    )
    assert len(shown) > 2
    assert by_and_by is shown[-1]
    assert by_and_by is not None
    assert set(np.unique(by_and_by.design.rho)) == {0.0, 1.0}
    assert (
        balance(by_and_by.equilibria, by_and_by.design.rho, by_and_by.design.median, by_and_by.design.final).final
        < 1e-5
    )
    assert rms(problem, by_and_by.design) < rms(problem, at_once)


def lost_at(call: int, monkeypatch: pytest.MonkeyPatch, last: int, share: float = 0.0) -> None:
    """Makes calls of toward_density, from this one to the last, end at a share of the way; steps change nothing."""
    calls = itertools.count(1)

    def follow(_: Equilibria, design: Design, rho: np.ndarray, *__: float, **___: bool) -> tuple[Design, float]:
        done = share if call <= next(calls) <= last else 1.0
        return replace(design, rho=design.rho + done * (rho - design.rho)), done

    monkeypatch.setattr(reduced, "toward_density", follow)
    monkeypatch.setattr(reduced, "gauss_newton_step", lambda *given, **_: gauss_newton.Step(given[3], 0.0, 1.0, True))


@pytest.mark.parametrize(
    ("lost", "times", "ends"), [(1, 3, True), (2, 3, True), (1, 2, False), (2, 2, False), (3, 9, True)]
)
@pytest.mark.parametrize("share", [0.0, 0.4])
def test_nothing_is_decided_by_and_by_where_the_way_ends_too_often(
    truth: Truth,
    searched: list[Search],
    monkeypatch: pytest.MonkeyPatch,
    lost: int,
    times: int,
    ends: bool,
    share: float,
) -> None:
    """Three times in a row; before that, what the steps have changed may lead on."""
    last = searched[-1]
    undecided = replace(last, design=replace(last.design, rho=np.abs(np.round(last.design.rho) - 0.3)))
    lost_at(lost, monkeypatch, lost + times - 1, share)
    shown: list[Search] = []
    found = decided_by_and_by(undecided, settings_for(truth.problem), shown.append)
    assert (found is None) == ends
    assert all(at.iteration > undecided.iteration for at in shown)
    if found is not None:
        assert found is shown[-1]
        assert found.phase is Phase.DONE
        np.testing.assert_allclose(found.design.rho, np.round(last.design.rho))


@pytest.mark.parametrize("lam_stable", [0.0, 1.0])
def test_ways_to_decided_densities_stay_on_stable_states_where_the_median_shape_keeps_clear_of_others(
    truth: Truth, searched: list[Search], monkeypatch: pytest.MonkeyPatch, lam_stable: float
) -> None:
    last, stays = searched[-1], list[bool]()
    undecided = replace(last, design=replace(last.design, rho=np.abs(np.round(last.design.rho) - 0.3)))
    real = reduced.toward_density

    def watched(*given: Any, stay: bool = False) -> tuple[Design, float]:
        stays.append(stay)
        return real(*given, stay=stay)

    monkeypatch.setattr(reduced, "toward_density", watched)
    weights = settings_for(truth.problem).weights.replace(lam_stable=lam_stable, least_stable=0.1)
    assert decided_by_and_by(undecided, settings_for(truth.problem, weights=weights), lambda _: None) is not None
    assert len(stays) > 2
    assert set(stays[:-1]) == {lam_stable > 0}


@pytest.mark.parametrize(("share", "kept"), [(0.05, True), (0.0, False)])
def test_the_last_few_stay_undecided_where_no_equilibrium_leads_on(
    truth: Truth, searched: list[Search], monkeypatch: pytest.MonkeyPatch, share: float, kept: bool
) -> None:
    """Twelve tets are undecided; half of them are decided, then the rest finds no equilibrium, nor do all at once."""
    last = searched[-1]
    rho = np.round(last.design.rho)
    rho[:12] = np.abs(rho[:12] - np.linspace(0.3, 0.4, 12))
    lost_at(2, monkeypatch, last=9)
    monkeypatch.setattr(reduced, "LEFT_UNDECIDED", share)
    found = decided_by_and_by(
        replace(last, design=replace(last.design, rho=rho)), settings_for(truth.problem), lambda _: None
    )
    assert (found is not None) is kept
    if found is not None:
        assert undecided_fraction(found.design.rho) == 6 / truth.problem.n_tets


def test_what_is_nearly_decided_stays_so_where_it_cannot_all_be(
    truth: Truth, searched: list[Search], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Two tets are undecided, so that one half is decided at once, and then all that is nearly 0 or 1."""
    last = searched[-1]
    rho = np.abs(np.round(last.design.rho) - 1e-3)
    rho[:2] = 0.3
    lost_at(2, monkeypatch, last=2)
    found = decided_by_and_by(
        replace(last, design=replace(last.design, rho=rho)), settings_for(truth.problem), lambda _: None
    )
    assert found is not None
    np.testing.assert_array_equal(found.design.rho, np.r_[0.0, 0.0, rho[2:]])


def test_refit_recovers_the_held_positions_of_the_truth(truth: Truth) -> None:
    """With the true labels and points there is one answer, and the error goes to rounding."""
    problem, equilibria, true = truth.problem, truth.equilibria, truth.design
    rng = np.random.default_rng(0)
    wrong = true.median.x + 0.02 * rng.standard_normal(3)
    wrong[problem.clamp] = true.median.x[problem.clamp]
    start = held_design(equilibria, true.rho, wrong, 1e-9)
    assert rms(problem, start) > 2e-3
    found = refit(equilibria, start, WEIGHTS, lambda at: None, 30)  # noqa: ARG005
    assert rms(problem, found) < 1e-6
    np.testing.assert_allclose(
        equilibria.patches.mean(found.median.x), equilibria.patches.mean(true.median.x), atol=1e-5
    )


def test_a_fit_at_its_best_tries_nothing(truth: Truth, monkeypatch: pytest.MonkeyPatch) -> None:
    found = refit(truth.equilibria, truth.design, WEIGHTS, lambda at: None, 30)  # noqa: ARG005
    monkeypatch.setattr(gauss_newton, "_trial", lambda *_: pytest.fail("a trial"))
    weights = WEIGHTS.replace(error_scale=1e3 * rms(truth.problem, found) + 1e-9)
    L, fixed = smoothness_matrix(truth.problem), np.zeros(truth.problem.n_tets, bool)
    step = gauss_newton.gauss_newton_step(truth.equilibria, weights, L, found, 0.3, fixed, 12, 1e-3)
    assert not step.accepted
    assert step.design is found


@pytest.mark.parametrize("damping", [1e-6, 1.0, 1e4])
def test_no_step_gains_more_than_it_promises(truth: Truth, damping: float) -> None:
    """The promise bounds what the quadratic model gains: a step that has to gain that much is not tried."""
    equilibria, design = truth.equilibria, truth.design
    L, weights = smoothness_matrix(truth.problem), WEIGHTS.replace(error_scale=0.1)
    step = gauss_newton.gauss_newton_step(equilibria, weights, L, design, damping, tries=1)
    value = gauss_newton.evaluate(equilibria, weights, L, design)
    assert step.accepted
    assert step.damping == pytest.approx(damping / gauss_newton.SOFTER)
    share = (value - step.value) / value
    again = gauss_newton.gauss_newton_step(equilibria, weights, L, design, damping, None, 1, 0.4 * share)
    never = gauss_newton.gauss_newton_step(equilibria, weights, L, design, damping, None, 1, 2.5 * share)
    assert again.accepted
    assert not never.accepted


@pytest.mark.parametrize("failing", [0, 1, 2, 6])
def test_a_step_is_the_same_on_one_core_and_on_two(truth: Truth, monkeypatch: pytest.MonkeyPatch, failing: int) -> None:
    """Where tries fail, here those that move held positions far, the next counts and tells the later damping."""
    weights, L = WEIGHTS.replace(error_scale=0.1), smoothness_matrix(truth.problem)
    trial, moved = gauss_newton._trial, list[float]()

    def step(cores: int, farthest: float) -> gauss_newton.Step:
        def near(*given: Any, **named: Any) -> Design | None:
            moved.append(float(np.linalg.norm(given[4])))
            return trial(*given, **named) if moved[-1] <= farthest else None

        monkeypatch.setattr(threads, "usable_cores", lambda: cores)
        monkeypatch.setattr(gauss_newton, "_trial", near)
        return gauss_newton.gauss_newton_step(truth.equilibria, weights, L, truth.design, 1.0, tries=6)

    assert not step(1, 0.0).accepted
    farthest = np.append(moved, 0.0)[failing]
    assert (np.diff(moved) < 0).all()
    one, two = step(1, farthest), step(2, farthest)
    assert one.accepted == two.accepted == (failing < 6)
    assert one.damping == two.damping
    assert one.damping == pytest.approx(gauss_newton.STIFFER**failing if failing else 1 / gauss_newton.SOFTER)
    np.testing.assert_allclose(one.design.median.x, two.design.median.x, atol=1e-12)
    np.testing.assert_allclose(one.design.rho, two.design.rho, atol=1e-12)


def test_a_step_is_taken_though_it_is_predicted_to_turn_tets_over(
    truth: Truth, monkeypatch: pytest.MonkeyPatch
) -> None:
    """One soft node is predicted to move through its tets, in both shapes, where the equilibria are near."""
    equilibria, design = truth.equilibria, truth.design
    soft, predicted, asked = corner(truth.problem, (0.6, 0.5, 1.0)), Linearisation.forward, []

    def through_its_tets(lin: Linearisation, drho: np.ndarray, dc: np.ndarray) -> tuple[np.ndarray, ...]:
        dx, df, dy = predicted(lin, drho, dc)
        dx[soft, 2] -= 2.0
        dy[soft, 2] -= 2.0
        body = truth.problem.body
        asked.append(deformation_gradients(body.X, design.final.y + dy, body.elements))
        return dx, df, dy

    monkeypatch.setattr(Linearisation, "forward", through_its_tets)
    monkeypatch.setattr(gauss_newton, "LARGEST_MOVE", 10.0)
    weights = WEIGHTS.replace(error_scale=0.1)
    step = gauss_newton.gauss_newton_step(equilibria, weights, smoothness_matrix(truth.problem), design, 1.0, tries=1)
    assert np.linalg.det(asked[0]).min() < 0
    assert step.accepted


def test_fewer_smp_is_used_when_the_goal_says_so(truth: Truth, searched: list[Search]) -> None:
    problem = truth.problem
    usual = float(problem.volume_fractions @ searched[-1].design.rho)
    limit = 0.7 * usual
    few = solve_reduced(problem, settings_for(problem, max_smp_fraction=limit), lambda at: None)  # noqa: ARG005
    assert float(problem.volume_fractions @ few.design.rho) < 1.1 * limit


def test_smp_becomes_dearer_above_the_limit_and_cheaper_again_below(
    truth: Truth, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Down to the price before rounding, be that higher than the usual one."""
    problem, prices = truth.problem, list[float]()
    start = first_search(problem, settings_for(problem))
    shares = [0.6, 0.6, 0.49, 0.4, 0.6, 0.4, 0.4, 0.4]

    def step(
        _: object, weights: ObjectiveWeights, __: object, design: Design, *___: object, **____: object
    ) -> gauss_newton.Step:
        prices.append(weights.lam_SMP)
        after = replace(design, rho=np.full(problem.n_tets, shares[len(prices) % len(shares)]))
        return gauss_newton.Step(after, 0.0, 0.1, True)

    monkeypatch.setattr(reduced, "gauss_newton_step", step)
    settings, L = settings_for(problem, max_smp_fraction=0.5), smoothness_matrix(problem)
    before = 3 * settings.weights.lam_SMP
    at = replace(start, phase=Phase.ROUND, lam_SMP=before, lam_round=1.0)
    at = replace(at, design=replace(at.design, rho=np.full(problem.n_tets, shares[0])))
    for _ in shares:
        at = round_step(at, settings, L)
    factor = settings.round_growth**reduced.DEARER
    np.testing.assert_allclose(np.log(np.array(prices) / before) / np.log(factor), [1, 2, 1, 0, 1, 0, 0, 0], atol=1e-9)
    assert at.lam_SMP == before


def test_forces_keep_below_the_largest_one(truth: Truth, searched: list[Search]) -> None:
    problem = truth.problem
    largest = 0.5 * float(np.linalg.norm(printed(searched[-1]).median.forces, axis=1).max())
    weights = WEIGHTS.replace(max_force=largest)
    weak = solve_reduced(problem, settings_for(problem, weights=weights), lambda at: None)  # noqa: ARG005
    assert np.linalg.norm(printed(weak, weights).median.forces, axis=1).max() < 1.05 * largest


def test_at_rest_nothing_is_held_and_nothing_moves(truth: Truth) -> None:
    rest = at_rest(truth.problem)
    assert rest.equilibria.patches.count == 0
    np.testing.assert_array_equal(rest.design.final.y, truth.problem.body.X)
