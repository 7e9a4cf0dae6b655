"""The stage solve: how many points it takes, and what it says where a goal is out of reach."""

import re
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from bent_bar import PROFILE, bent_bar
from shapes.boxes import box

from fab4d.design import reduced
from fab4d.design.finish import Relaxed, carried_in
from fab4d.design.objective import shape_error
from fab4d.design.problem import Problem
from fab4d.design.reduced import ReducedSettings, Search, at_rest, undecided_fraction
from fab4d.fabrication.labels import ambiguous_fraction
from fab4d.io.scene import Acceptance, Goal, SolverSettings
from fab4d.report.metrics import shapes_of
from fab4d.stages import _attempts, _bring_up, _coarse, _finish, _limits, _settings, solve
from fab4d.stages._design import Trace, problem_of
from fab4d.stages._figures import limits_of
from fab4d.stages._printed import Printed
from fab4d.stages._search import search_from
from fab4d.stages._settings import search_settings
from fab4d.stages.monitor import SilentMonitor
from fab4d.stages.solve import run

QUADRATIC = SolverSettings(element="quadratic")


@pytest.fixture(scope="module")
def fine_bar() -> dict[str, np.ndarray]:
    """The same, of many tets."""
    return bent_bar((24, 5, 4), 50.0)


@pytest.fixture(scope="module")
def bar() -> dict[str, np.ndarray]:
    """Clamped at its left end, to be bent by 50 degrees."""
    return bent_bar((7, 1, 1), 50.0)


def solved(mesh: dict[str, np.ndarray], goal: Goal, **profile: Any) -> dict[str, Any]:
    inputs = {"mesh": mesh, "check_report": {"nothing_to_program": False}, "picked": None}
    return run(inputs, PROFILE | {"goal": goal} | profile, SilentMonitor())


def test_without_a_number_the_fewest_points_are_taken(bar: dict[str, np.ndarray]) -> None:
    found = solved(bar, Goal(tolerance=0.6))
    assert 1 <= len(found["relaxed"]["patch_center"]) < 5
    assert found["relaxed"]["relaxed_rms"] <= _attempts.RELAXED_SHARE * 0.6
    assert b"points" in found["solve_trace"]
    assert found["solve_report"]["limited_by"] is None


def test_a_number_is_met_exactly(bar: dict[str, np.ndarray]) -> None:
    found = solved(bar, Goal(tolerance=0.6, max_forces=3))
    assert len(found["relaxed"]["patch_center"]) == 3
    assert b"points" not in found["solve_trace"]


def test_a_goal_out_of_reach_says_what_limits_it(bar: dict[str, np.ndarray]) -> None:
    """One try is enough, for other weights cannot help."""
    report = solved(bar, Goal(tolerance=0.02, max_forces=1))["solve_report"]
    assert report["attempts"] == 1
    assert report["limited_by"].startswith("the number of points, 1: with any mixture")
    weak = replace(PROFILE["rig"], max_force=20.0)
    report = solved(bar, Goal(tolerance=0.02, max_forces=1), rig=weak)["solve_report"]
    assert report["limited_by"].startswith("the largest force of the rig")


def test_what_more_points_would_leave_is_told_where_the_goal_is_far_off(bar: dict[str, np.ndarray]) -> None:
    said = solved(bar, Goal(tolerance=0.02, max_forces=1))["solve_report"]["limited_by"]
    found = re.search(r"stays at ([\d.]+) mm, .*; (even )?4 points would leave ([\d.]+) mm", said)
    assert found is not None
    assert float(found[3]) < float(found[1])
    assert (found[2] is not None) == (float(found[3]) > 0.02) == ("change it or the tolerance" in said)
    near = solved(bar, Goal(tolerance=float(found[1]) / 1.2, max_forces=1))["solve_report"]["limited_by"]
    assert near is None or "would leave" not in near


@pytest.mark.parametrize(("reached", "enough"), [(0.9, True), (1.1, False)])
def test_more_points_are_advised_only_where_they_are_enough(
    bar: dict[str, np.ndarray], reached: float, enough: bool
) -> None:
    problem = problem_of(bar, PROFILE["materials"], "linear")
    said = _limits._outlook(problem, 0.01, _limits.MorePoints(8, 0.01 * reached))
    assert "8 points would leave" in said
    assert ("change it or the tolerance" not in said) == enough


def test_a_rig_that_only_pulls_is_named_where_that_limits(bar: dict[str, np.ndarray]) -> None:
    """The bar is to become shorter: its end has to be pushed."""
    shorter = bar | {"X_temp": bar["X"] * [0.8, 1.0, 1.0]}
    goal = Goal(tolerance=0.02, max_forces=2)
    pulling = replace(PROFILE["rig"], pull_only=True)
    assert "that the rig only pulls" in solved(shorter, goal, rig=pulling)["solve_report"]["limited_by"]
    assert "pulls" not in solved(shorter, goal)["solve_report"]["limited_by"]


@pytest.mark.parametrize(("moved", "relaxed_rms", "limited"), [(0.0, 1.0, False), (1.0, 0.0, False), (1.0, 1.0, True)])
def test_a_design_is_limited_where_it_misses_the_tolerance_relaxed_and_rounded(
    bar: dict[str, np.ndarray], moved: float, relaxed_rms: float, limited: bool
) -> None:
    """Rounding may go on to lower the error. The part at rest is off by what it has to move."""
    mesh = bar | {"X_temp": bar["X"] + moved * (bar["X_temp"] - bar["X"])}
    problem, profile = problem_of(mesh, PROFILE["materials"], "linear"), PROFILE | {"goal": Goal(0.6, 3)}
    found = replace(at_rest(problem), relaxed_rms=relaxed_rms)
    assert _attempts._hopeless(profile, search_settings(problem, profile), found) == limited
    assert (_limits.limited_by(problem, profile, found) is not None) == limited


@pytest.mark.parametrize("share", [1.0, 0.1])
def test_solver_and_verdict_mean_the_same_by_a_goal_without_a_tolerance(
    bar: dict[str, np.ndarray], share: float
) -> None:
    mesh = bar | {"X_temp": bar["X"] + share * (bar["X_temp"] - bar["X"])}
    problem, profile = problem_of(mesh, PROFILE["materials"], "linear"), PROFILE | {"goal": Goal()}
    allowed = limits_of(Goal(), Acceptance(), PROFILE["rig"], shapes_of(mesh, None)).tolerance
    assert search_settings(problem, profile).weights.error_scale == pytest.approx(allowed / problem.length, rel=1e-12)


def test_very_fine_meshes_are_rounded_in_fewer_steps(
    bar: dict[str, np.ndarray], monkeypatch: pytest.MonkeyPatch
) -> None:
    problem, profile = problem_of(bar, PROFILE["materials"], "linear"), PROFILE | {"goal": Goal(max_forces=3)}
    usual = search_settings(problem, profile)
    monkeypatch.setattr(_settings, "MANY_TETS", problem.n_tets - 1)
    fast = search_settings(problem, profile)
    assert fast.round_growth > 2 > usual.round_growth
    assert usual.nearly > fast.nearly == 1.0
    assert vars(replace(fast, round_growth=usual.round_growth, nearly=usual.nearly)) == vars(usual)


def test_labels_of_other_elements_keep_to_the_share_of_smp_or_are_left(
    bar: dict[str, np.ndarray], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Where quadratic tets need more SMP than the goal allows, the labels of the linear ones are handed on."""

    def all_smp(relaxed: Relaxed, *_: Any) -> Search:
        problem = relaxed.at.equilibria.problem
        rest = at_rest(problem)
        density = replace(rest.design, rho=np.ones(problem.n_tets))
        return replace(rest, design=density, relaxed_rms=relaxed.at.relaxed_rms)

    monkeypatch.setattr(_finish, "rounded_on", all_smp)
    monkeypatch.setattr(_finish, "LINEAR_HOLDS", 0.0)
    monkeypatch.setattr(_attempts, "_prints_better", lambda *_: False)
    for most, kept in ((None, True), (0.9, False)):
        found = solved(bar, Goal(tolerance=0.6, max_forces=3, max_smp_fraction=most), solver=QUADRATIC)["relaxed"]
        assert (len(found["x"]) > len(bar["X"])) == kept


def phases(found: dict[str, Any]) -> list[bytes]:
    return [line.split(b",")[1] for line in found["solve_trace"].splitlines()[1:]]


def test_nothing_is_rounded_in_linear_elements_where_quadratic_ones_do_it_well() -> None:
    bar = bent_bar((9, 2, 2), 50.0)
    found = solved(bar, Goal(tolerance=1.0, max_forces=3), solver=QUADRATIC)
    assert _finish.NOT_LINEAR in found["solve_report"]["left_out"]
    assert b"round" not in phases(found)[: phases(found).index(b"carried over")]
    assert phases(found).count(b"carried over") == 1
    assert len(found["relaxed"]["x"]) > len(bar["X"])


def test_linear_elements_round_what_quadratic_ones_lose(
    bar: dict[str, np.ndarray], monkeypatch: pytest.MonkeyPatch
) -> None:
    tried = []
    monkeypatch.setattr(_finish, "rounded_on", lambda *_: tried.append(1))
    monkeypatch.setattr(_finish, "LINEAR_HOLDS", 0.0)
    found = solved(bar, Goal(tolerance=1.5, max_forces=3), solver=QUADRATIC)
    assert len(tried) == 1
    assert len(found["relaxed"]["x"]) == len(bar["X"])
    assert _finish.NOT_LINEAR not in found["solve_report"]["left_out"]
    assert found["solve_report"]["printed_rms_mm"] <= 1.5


@pytest.fixture(scope="module")
def relaxed_bar() -> tuple[dict[str, np.ndarray], Search, ReducedSettings]:
    """A bar, its relaxed design in linear elements, and the settings of the search."""
    bar, profile = bent_bar((9, 2, 2), 50.0), PROFILE | {"goal": Goal(tolerance=1.0, max_forces=3)}
    problem = problem_of(bar, PROFILE["materials"], "linear")
    settings = search_settings(problem, profile)
    return bar, reduced.relaxed(problem, settings, lambda at: None), settings  # noqa: ARG005


@pytest.mark.parametrize(("share", "searched"), [(1.01, False), (0.99, True)])
def test_quadratic_elements_that_lose_a_design_are_searched_themselves_where_it_misses_the_tolerance(
    relaxed_bar: tuple[dict[str, np.ndarray], Search, ReducedSettings],
    monkeypatch: pytest.MonkeyPatch,
    share: float,
    searched: bool,
) -> None:
    """share : the tolerance, in errors of the relaxed design of linear elements in quadratic ones"""
    bar, found, settings = relaxed_bar
    carried = carried_in(problem_of(bar, PROFILE["materials"], "quadratic"), found)
    assert carried is not None
    settings = replace(settings, weights=settings.weights.replace(error_scale=share * carried.rms))
    asked: list[Problem] = []
    monkeypatch.setattr(_finish, "LINEAR_HOLDS", 0.0)
    monkeypatch.setattr(_finish, "far_off", lambda *_: False)
    monkeypatch.setattr(_finish, "rounded_on", lambda *_: None)
    monkeypatch.setattr(_finish, "_found_in", lambda problem, *_: asked.append(problem))
    profile = PROFILE | {"goal": Goal(tolerance=1.0, max_forces=3)}
    _finish.finished(bar, profile, "quadratic", found, settings, trace_of(found.equilibria.problem, bar))
    assert [problem.body.order for problem in asked] == [2] * searched


@pytest.mark.parametrize(
    ("lost", "found_there", "far", "clear", "steps"),
    [
        (0.99, True, False, False, ["relaxed", "rounded"]),
        (1.01, True, False, False, ["relaxed", "searched"]),
        (1.01, False, False, False, ["relaxed", "searched", "rounded"]),
        (1.01, False, True, False, ["relaxed", "searched"]),
        (1.01, False, True, True, ["relaxed", "searched"]),
        (0.99, True, True, False, ["relaxed", "searched"]),
        (0.99, True, True, True, ["relaxed", "rounded"]),
    ],
)
def test_a_design_that_quadratic_elements_lose_is_rounded_only_where_these_find_no_other(
    relaxed_bar: tuple[dict[str, np.ndarray], Search, ReducedSettings],
    monkeypatch: pytest.MonkeyPatch,
    lost: float,
    found_there: bool,
    far: bool,
    clear: bool,
    steps: list[str],
) -> None:
    """lost : error of the design relaxed in quadratic elements, in the largest that is no loss
    far, clear : whether it misses the tolerance by far there, and was relaxed clear of unstable states
    """
    bar, found, settings = relaxed_bar
    settings = replace(settings, weights=settings.weights.replace(error_scale=0.5 * found.relaxed_rms))
    done = list[str]()

    def relaxing(carried: Search, settings: ReducedSettings, *_: Any) -> Relaxed:
        done.append("relaxed")
        return Relaxed(replace(carried, relaxed_rms=lost * _finish.LOST * found.relaxed_rms), settings, clear)

    def rounding(relaxed: Relaxed, *_: Any) -> Search:
        done.append("rounded")
        return relaxed.at

    def searching(_: Problem, settings: ReducedSettings, __: Trace) -> Search | None:
        done.append("searched")
        assert settings.patch_radii == (found.patch_radius,)
        return found if found_there else None

    for name, value in (("relaxed_from", relaxing), ("rounded_on", rounding), ("_found_in", searching)):
        monkeypatch.setattr(_finish, name, value)
    monkeypatch.setattr(_finish, "far_off", lambda at, _: far and at.equilibria.problem.body.order == 2)
    monkeypatch.setattr(_finish, "LINEAR_HOLDS", 0.0)
    profile = PROFILE | {"goal": Goal(tolerance=1.0, max_forces=3)}
    finish = _finish.finished(bar, profile, "quadratic", found, settings, trace_of(found.equilibria.problem, bar))
    assert (finish.found is None) == (done[-1] == "searched" and not found_there)
    assert (finish.found is found) == (done[-1] == "searched" and found_there)
    assert done == steps


@pytest.mark.parametrize(("tolerance", "reached"), [(1.0, True), (1e-6, False)])
def test_a_search_in_quadratic_elements_ends_in_labels_or_where_the_relaxed_design_misses_the_tolerance(
    relaxed_bar: tuple[dict[str, np.ndarray], Search, ReducedSettings],
    monkeypatch: pytest.MonkeyPatch,
    tolerance: float,
    reached: bool,
) -> None:
    """Labels come from a design that keeps clear of unstable states."""
    bar, profile = relaxed_bar[0], PROFILE | {"goal": Goal(tolerance=tolerance, max_forces=3)}
    problem = problem_of(bar, PROFILE["materials"], "quadratic")
    cleared, relaxed_clear = list[Search](), _finish.relaxed_clear

    def watched(at: Search, *rest: Any) -> Relaxed:
        cleared.append(at)
        return relaxed_clear(at, *rest)

    monkeypatch.setattr(_finish, "relaxed_clear", watched)
    settings, trace = search_settings(problem, profile), trace_of(problem, bar)
    found = _finish._found_in(problem, settings, trace)
    assert (found is not None) == bool(cleared) == reached
    shown = [row["phase"] for row in trace.rows]
    assert shown[:2] == ["start", "relax"]
    assert ("round" in shown) == reached
    if found is not None:
        assert ambiguous_fraction(found.design.rho) < 1e-3
        assert found.rms <= settings.weights.error_scale


def trace_of(problem: Problem, mesh: dict[str, np.ndarray]) -> Trace:
    return Trace(problem, mesh, SilentMonitor(), 1.0)


@pytest.mark.parametrize(
    ("quadratic_rms", "linear_rms", "tried", "delivered"),
    [(0.9, 0.1, False, "quadratic"), (1.2, 1.1, True, "linear"), (1.2, 1.3, True, "quadratic")],
)
def test_the_design_that_prints_better_is_delivered(
    monkeypatch: pytest.MonkeyPatch, quadratic_rms: float, linear_rms: float, tried: bool, delivered: str
) -> None:
    """Errors as printed in shares of the tolerance; linear elements are tried where quadratic ones miss it."""
    bar, goal = bent_bar((9, 2, 2), 50.0), Goal(tolerance=1.5, max_forces=3)
    tolerance = goal.tolerance / float(np.linalg.norm(np.ptp(bar["X"], axis=0)))
    as_printed = _finish.as_printed

    def printed(problem: Problem, *given: Any, **named: Any) -> Printed:
        found = as_printed(problem, *given, **named)
        return found if problem.body.order == 1 else replace(found, rms=quadratic_rms * tolerance)

    monkeypatch.setattr(_finish, "as_printed", printed)
    monkeypatch.setattr(_attempts, "refitted_in", lambda *_: linear_rms * tolerance)
    monkeypatch.setattr(_finish, "LINEAR_HOLDS", 0.0)
    for module in (_finish, _attempts):
        monkeypatch.setattr(module, "CERTAINLY_ENOUGH", 0.0)
    found = solved(bar, goal, solver=QUADRATIC)
    assert (_finish.NOT_LINEAR not in found["solve_report"]["left_out"]) == tried
    assert (len(found["relaxed"]["x"]) > len(bar["X"])) == (delivered == "quadratic")


@pytest.mark.parametrize(("in_fit", "asked"), [(None, 1), (0.1, 0), (0.3, 0)])
def test_an_error_in_the_elements_of_the_fit_is_not_found_twice(
    bar: dict[str, np.ndarray], monkeypatch: pytest.MonkeyPatch, in_fit: float | None, asked: int
) -> None:
    problem = problem_of(bar, PROFILE["materials"], "linear")
    best, calls = at_rest(problem), list[Any]()
    settings = search_settings(problem, PROFILE | {"goal": Goal(0.6, 3)})

    def refitted(*given: Any) -> float:
        calls.append(given)
        return 0.1

    monkeypatch.setattr(_attempts, "refitted_in", refitted)
    better = _attempts._prints_better(best, _attempts._Linear(best.design, 0.2, in_fit), problem, 0.2, settings)
    assert better == (in_fit != 0.3)
    assert len(calls) == asked
    assert not _attempts._prints_better(best, _attempts._Linear(None, np.inf), problem, 0.2, settings)


def test_quadratic_elements_do_not_round_what_they_see_as_linear_ones_do(
    bar: dict[str, np.ndarray], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(_finish, "LINEAR_HOLDS", 100.0)
    found = solved(bar, Goal(tolerance=1.5, max_forces=3), solver=QUADRATIC)
    assert _finish.LINEAR_ROUNDS in found["solve_report"]["left_out"]
    assert phases(found).count(b"carried over") == 1
    assert phases(found)[phases(found).index(b"carried over") + 1] == b"round"
    assert len(found["relaxed"]["x"]) == len(bar["X"])


@pytest.mark.parametrize("element", ["linear", "quadratic"])
def test_labels_that_other_elements_do_not_hold_are_designed_again(
    bar: dict[str, np.ndarray], monkeypatch: pytest.MonkeyPatch, element: str
) -> None:
    """Where these are those of the last fit, and miss the tolerance by more than flips win back."""
    monkeypatch.setattr(_finish, "LINEAR_HOLDS", 100.0)
    left, asked = [0.0], list[float]()

    def refitted(*_: Any) -> float:
        asked.append(left[0])
        return left[0]

    monkeypatch.setattr(_attempts, "refitted_in", refitted)
    solver = SolverSettings(element=element)
    for share, attempts in ((1.4, 1), (1.6, len(_settings.ATTEMPTS))):
        asked.clear()
        goal = Goal(tolerance=1.5, max_forces=3)
        left[0] = share * goal.tolerance / float(np.linalg.norm(np.ptp(bar["X"], axis=0)))
        report = solved(bar, goal, solver=solver)["solve_report"]
        assert report["attempts"] == (attempts if element == "quadratic" else 1)
        assert len(asked) == (attempts if element == "quadratic" else 0)


def test_a_goal_far_out_of_reach_is_not_rounded_in_quadratic_elements(bar: dict[str, np.ndarray]) -> None:
    found = solved(bar, Goal(tolerance=0.01, max_forces=1), solver=QUADRATIC)
    assert _finish.NOT_QUADRATIC in found["solve_report"]["left_out"]
    assert b"carried over" not in phases(found)
    linear = solved(bar, Goal(tolerance=0.01, max_forces=1))
    assert _finish.NOT_QUADRATIC not in linear["solve_report"]["left_out"]


@pytest.fixture
def few(monkeypatch: pytest.MonkeyPatch) -> None:
    """More than 1,000 tets are many, and 400 are enough to search on."""
    monkeypatch.setattr(_coarse, "MANY_TETS", 1_000)
    monkeypatch.setattr(_coarse, "COARSE_TETS", 400)


@pytest.mark.usefixtures("few")
def test_many_tets_are_searched_on_a_coarser_mesh(fine_bar: dict[str, np.ndarray]) -> None:
    """The design is in equilibrium on the whole mesh, near 0 or 1 in all its tets, and not far from the goal."""
    found = solved(fine_bar, Goal(tolerance=0.6, max_forces=4))
    relaxed, report = found["relaxed"], found["solve_report"]
    assert relaxed["rho"].shape == (len(fine_bar["tets"]),)
    assert np.isin(np.round(relaxed["rho"], 2), (0.0, 1.0)).mean() > 0.99
    assert relaxed["x"].shape == fine_bar["X"].shape
    assert len(relaxed["patch_center"]) == 4
    assert b"carried over" in found["solve_trace"]
    assert any(left["what"] == f"search on all {len(fine_bar['tets'])} tets" for left in report["left_out"])
    problem = problem_of(fine_bar, PROFILE["materials"], "linear")
    assert shape_error(problem, relaxed["y"] / problem.length).rms * problem.length < 1.5


def carried_phases(found: dict[str, Any]) -> list[str]:
    """Phases of the trace from the first design that was carried over on."""
    rows = [row.split(b",")[1].decode() for row in found["solve_trace"].splitlines()]
    return rows[rows.index("carried over") :]


@pytest.mark.usefixtures("few")
def test_the_design_is_rounded_where_tets_are_small(
    fine_bar: dict[str, np.ndarray], monkeypatch: pytest.MonkeyPatch
) -> None:
    """On all tets, or on a mesh between if they are too many; where that comes to nothing the coarse labels serve."""
    goal = Goal(tolerance=0.6, max_forces=4)
    errors = {}
    whole = solved(fine_bar, goal)
    assert carried_phases(whole)[:2] == ["carried over", "relax"]
    assert carried_phases(whole)[-1] == "round"
    errors["all"] = off_by(fine_bar, whole)
    monkeypatch.setattr(_coarse, "MOST_ROUNDED", 1_000)
    monkeypatch.setattr(_coarse, "ROUNDED_TETS", 1_200)
    between = solved(fine_bar, goal)
    assert carried_phases(between).count("carried over") == 2
    assert carried_phases(between)[-1] == "carried over"
    assert between["relaxed"]["rho"].shape == (len(fine_bar["tets"]),)
    monkeypatch.setattr(_coarse, "MOST_ROUNDED", 10**6)
    monkeypatch.setattr(_bring_up, "rounded_from", lambda *_: None)
    coarse = solved(fine_bar, goal)
    assert carried_phases(coarse) == ["carried over"]
    errors["coarse"] = off_by(fine_bar, coarse)
    assert errors["all"] < errors["coarse"]


@pytest.mark.usefixtures("few")
@pytest.mark.parametrize(("tolerance", "nearer"), [(0.1, 0.5), (0.1, 5.0), (0.1, None), (0.6, 0.5)])
def test_what_misses_the_tolerance_on_all_tets_is_rounded_there_too(
    fine_bar: dict[str, np.ndarray], monkeypatch: pytest.MonkeyPatch, tolerance: float, nearer: float | None
) -> None:
    """From the relaxed design of the mesh between; its labels serve where it comes to nothing, or is off farther."""
    monkeypatch.setattr(_coarse, "MOST_ROUNDED", 1_000)
    monkeypatch.setattr(_coarse, "ROUNDED_TETS", 1_200)
    rounded_from, n_tets, before = _bring_up.rounded_from, len(fine_bar["tets"]), list[float]()

    def rounded_off(carried: Search, *given: Any) -> Search | None:
        if len(carried.design.rho) < n_tets:
            return rounded_from(carried, *given)
        problem, final = carried.equilibria.problem, carried.design.final
        before.append(shape_error(problem, final.y).rms * problem.length)
        assert undecided_fraction(carried.design.rho) > 0.1
        if nearer is None:
            return None
        y = problem.X_temp + nearer * (final.y - problem.X_temp)
        return replace(carried, design=replace(carried.design, final=replace(final, y=y)))

    monkeypatch.setattr(_bring_up, "rounded_from", rounded_off)
    found = solved(fine_bar, Goal(tolerance=tolerance, max_forces=4))
    assert len(before) == (1 if tolerance == 0.1 else 0)
    taken = bool(before) and nearer == 0.5
    assert (undecided_fraction(found["relaxed"]["rho"]) > 0.1) == taken
    if taken:
        assert off_by(fine_bar, found) < 0.6 * before[0]


@pytest.mark.usefixtures("few")
def test_a_coarse_mesh_is_searched_for_less_than_the_tolerance(
    fine_bar: dict[str, np.ndarray], monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[float | None] = []
    designed = solve._designed

    def watched(problem: Any, mesh: Any, profile: Any, *rest: Any) -> Any:
        asked.append(profile["goal"].tolerance)
        return designed(problem, mesh, profile, *rest)

    monkeypatch.setattr(solve, "_designed", watched)
    solved(fine_bar, Goal(tolerance=0.6, max_forces=4))
    solved(fine_bar, Goal(max_forces=4))
    usual = limits_of(Goal(), Acceptance(), PROFILE["rig"], shapes_of(fine_bar, None)).tolerance
    assert asked == [pytest.approx(0.8 * 0.6), pytest.approx(0.8 * usual)]


@pytest.mark.usefixtures("few")
def test_a_design_that_needs_too_much_smp_when_rounded_again_is_not_taken(
    fine_bar: dict[str, np.ndarray], monkeypatch: pytest.MonkeyPatch
) -> None:
    def all_smp(carried: Search, *_: Any) -> Search:
        return replace(carried, design=replace(carried.design, rho=np.ones(len(carried.design.rho))))

    monkeypatch.setattr(_bring_up, "rounded_from", all_smp)
    assert solved(fine_bar, Goal(tolerance=0.6, max_forces=4))["relaxed"]["rho"].min() == 1.0
    limited = solved(fine_bar, Goal(tolerance=0.6, max_forces=4, max_smp_fraction=0.9))
    assert limited["relaxed"]["rho"].min() < 0.5


def off_by(mesh: dict[str, np.ndarray], found: dict[str, Any]) -> float:
    """RMS error, mm, of the design."""
    problem = problem_of(mesh, PROFILE["materials"], "linear")
    return shape_error(problem, found["relaxed"]["y"] / problem.length).rms * problem.length


def test_the_search_keeps_a_little_below_the_share_of_smp_that_the_goal_allows(bar: dict[str, np.ndarray]) -> None:
    problem = problem_of(bar, PROFILE["materials"], "linear")
    for limit in (0.0, 0.3, 1.0):
        settings = search_settings(problem, PROFILE | {"goal": Goal(0.6, 3, max_smp_fraction=limit)})
        assert 0.95 * limit <= settings.max_smp_fraction <= 0.98 * limit


@pytest.mark.usefixtures("few")
def test_a_design_that_is_lost_on_the_whole_mesh_is_searched_there(
    fine_bar: dict[str, np.ndarray], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(_bring_up, "carried_up", lambda *_: None)
    found = solved(fine_bar, Goal(tolerance=0.6, max_forces=4))
    assert found["relaxed"]["rho"].shape == (len(fine_bar["tets"]),)
    assert not any(left["what"].startswith("search on") for left in found["solve_report"]["left_out"])


@pytest.mark.usefixtures("few")
def test_quadratic_elements_keep_to_their_mesh(fine_bar: dict[str, np.ndarray]) -> None:
    problem = problem_of(fine_bar, PROFILE["materials"], "linear")
    assert _coarse.coarse_for(problem, fine_bar, PROFILE["materials"], "quadratic", SilentMonitor()) == []
    assert len(_coarse.coarse_for(problem, fine_bar, PROFILE["materials"], "linear", SilentMonitor())) == 1


def test_a_plate_too_thin_to_coarsen_is_searched_whole(monkeypatch: pytest.MonkeyPatch) -> None:
    X, tets = box((60.0, 40.0, 1.0), (12, 8, 1), "five")
    plate = {"X": X, "X_temp": X, "tets": tets, "clamp": X[:, 0] <= 5.0}
    monkeypatch.setattr(_coarse, "MANY_TETS", 100)
    monkeypatch.setattr(_coarse, "COARSE_TETS", 400)
    problem = problem_of(plate, PROFILE["materials"], "linear")
    assert _coarse.coarse_for(problem, plate, PROFILE["materials"], "linear", SilentMonitor()) == []


@pytest.mark.usefixtures("few")
def test_a_coarse_search_that_was_stopped_goes_on(fine_bar: dict[str, np.ndarray]) -> None:
    """What it keeps has names of its own: a search on the whole mesh that follows does not take it for its own."""
    kept: dict[str, Any] = {}

    class Keeping(SilentMonitor):
        def save(self, name: str, arrays: Any) -> None:
            kept[name] = arrays

        def restore(self, name: str) -> Any:
            return kept.get(name)

    inputs = {"mesh": fine_bar, "check_report": {"nothing_to_program": False}, "picked": None}
    profile = PROFILE | {"goal": Goal(tolerance=0.6, max_forces=4)}
    first = run(inputs, profile, Keeping())
    assert {name.split("-")[0] for name in kept} == {"coarse"}
    again = run(inputs, profile, Keeping())
    np.testing.assert_array_equal(first["relaxed"]["rho"], again["relaxed"]["rho"])


def test_tets_that_rounding_leaves_are_shown_and_decided_again_by_a_run_that_was_stopped(
    bar: dict[str, np.ndarray], memory: type[Any]
) -> None:
    problem, monitor = problem_of(bar, PROFILE["materials"], "linear"), memory()
    trace, rest = Trace(problem, bar, monitor, 1.0), at_rest(problem)
    watch = _attempts._watch(0, None, trace, monitor, [])
    ended = replace(rest, iteration=7)
    for at in (replace(rest, phase=reduced.Phase.ROUND, iteration=6), ended, replace(rest, iteration=8)):
        watch(at)
    assert [row["phase"] for row in trace.rows] == ["start", "round", "round"]
    assert search_from(problem, monitor.saved[_attempts.CHECKPOINT]).iteration == ended.iteration
