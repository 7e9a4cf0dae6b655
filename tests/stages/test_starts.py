"""Other points for the search to begin with: when they are looked for, which are taken, how a stopped run goes on."""

import csv
import io
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from bent_bar import PROFILE, bent_bar

from fab4d.design import starts as starts_of_design
from fab4d.design.patches import build_patches, pad_vertices
from fab4d.design.problem import Problem
from fab4d.design.reduced import Phase, ReducedSettings, Search, relaxed
from fab4d.design.starts import beginnings, crossed_centers, random_centers
from fab4d.errors import EquilibriumError
from fab4d.io.scene import Goal
from fab4d.stages import _starts
from fab4d.stages._design import Trace, problem_of
from fab4d.stages._settings import search_settings
from fab4d.stages._starts import Starts
from fab4d.stages.monitor import SilentMonitor
from fab4d.stages.solve import run

MESH = bent_bar((7, 1, 1), 60.0)
PROBLEM = problem_of(MESH, PROFILE["materials"], "linear")
Arrays = Mapping[str, np.ndarray]


class Keeping(SilentMonitor):
    """Keeps what is saved, as a run folder does, and dies at the save after `dies` of them."""

    def __init__(self, dies: int | None = None) -> None:
        self.kept: dict[str, dict[str, np.ndarray]] = {}
        self.left = dies

    def save(self, name: str, arrays: Arrays) -> None:
        if self.left == 0:
            raise KeyboardInterrupt
        self.left = None if self.left is None else self.left - 1
        self.kept[name] = dict(arrays)

    def restore(self, name: str) -> dict[str, np.ndarray] | None:
        return self.kept.get(name)


def settings_of(tolerance: float, points: int = 2) -> Any:
    goal = Goal(tolerance=tolerance, max_forces=points)
    return lambda problem: search_settings(problem, PROFILE | {"goal": goal})


def usual(tolerance: float) -> Search:
    return relaxed(PROBLEM, settings_of(tolerance)(PROBLEM), lambda at: None)  # noqa: ARG005


@pytest.fixture(scope="module")
def nearly() -> float:
    """A tolerance, mm, that two points spread over the bar miss by little: what they come to depends on it."""
    tolerance = 0.3
    for _ in range(10):
        tolerance *= 0.9
        if tolerance < usual(tolerance).relaxed_rms * PROBLEM.length < 1.4 * tolerance:
            return tolerance
    pytest.fail("no tolerance is missed by little")


def starts(tolerance: float, monitor: Any) -> Starts:
    trace = Trace(PROBLEM, MESH, monitor, 1.0)
    return Starts(PROBLEM, MESH, PROFILE["materials"], settings_of(tolerance), trace, monitor)


def test_random_points_are_apart_from_each_other_and_from_the_clamp() -> None:
    among = set(pad_vertices(PROBLEM).tolist())
    several = [random_centers(PROBLEM, 4, seed) for seed in range(6)]
    for centers in several:
        assert len(set(centers.tolist())) == 4
        assert set(centers.tolist()) <= among
    assert len({tuple(centers) for centers in several}) > 3
    np.testing.assert_array_equal(several[0], random_centers(PROBLEM, 4, 0))


@pytest.mark.parametrize("seed", range(5))
def test_crossed_points_are_some_of_both(seed: int) -> None:
    one, other = random_centers(PROBLEM, 4, 0), random_centers(PROBLEM, 4, 1)
    found = crossed_centers(PROBLEM, one, other, np.random.default_rng(seed))
    assert len(set(found.tolist())) == 4
    assert set(found.tolist()) <= {*one.tolist(), *other.tolist()}
    np.testing.assert_array_equal(
        np.sort(crossed_centers(PROBLEM, one, one, np.random.default_rng(seed))), np.sort(one)
    )


def test_the_second_half_of_the_beginnings_is_crossed_from_the_best(monkeypatch: pytest.MonkeyPatch) -> None:
    first, errors, begun = usual(0.3), iter([5.0, 1.0, 9.0, 1.1, 3.0, 3.0, 3.0, 3.0]), list[np.ndarray]()

    def ended(problem: Problem, settings: ReducedSettings, watch: Any) -> Search:  # noqa: ARG001
        if len(begun) == 2:
            begun.append(np.zeros(0, np.int64))
            raise EquilibriumError
        begun.append(settings.centers)
        patches = build_patches(problem, settings.centers, 0.03)
        return replace(first, equilibria=first.equilibria.with_patches(patches), relaxed_rms=next(errors))

    monkeypatch.setattr(starts_of_design, "relaxed", ended)
    monkeypatch.setattr(starts_of_design, "PARENTS", 2)
    found = list(beginnings(PROBLEM, settings_of(0.3, 4)(PROBLEM), lambda at: None, 8))  # noqa: ARG005
    assert len(found) == 7
    for seed in (0, 1, 3):
        np.testing.assert_array_equal(begun[seed], random_centers(PROBLEM, 4, seed))
    # The errors are 5, 1 and, past the one that is lost, 9: the best two are the second and the first.
    best = {*begun[1].tolist(), *begun[0].tolist()}
    assert set(begun[4].tolist()) <= best


@pytest.mark.parametrize(("share", "looked_for"), [(0.6, False), (0.8, True), (1.1, False)])
def test_other_points_are_looked_for_where_the_tolerance_is_nearly_met(
    share: float, looked_for: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    first = replace(usual(0.3), relaxed_rms=0.3 / share / PROBLEM.length)
    looked = []
    monkeypatch.setattr(Starts, "_search", lambda self, rms: looked.append(rms) or _starts.NO_OTHERS)  # noqa: ARG005
    assert starts(0.3, Keeping()).best(first, lambda at: None) is first  # noqa: ARG005
    assert bool(looked) is looked_for


def begun_with(first: Search, ends: Mapping[int, float], seen: list[int]) -> Any:
    """Beginnings whose only centre is the index of the point that is moved, and the errors, mm, that they end with."""

    def beginnings(problem: Problem, settings: ReducedSettings, watch: Any, most: int) -> Any:  # noqa: ARG001
        for vertex, rms in ends.items():
            seen.append(vertex)
            patches = build_patches(problem, np.array([vertex]), 0.03)
            equilibria = first.equilibria.with_patches(patches)
            yield replace(first, equilibria=equilibria, relaxed_rms=rms / problem.length)

    return beginnings


@pytest.mark.parametrize(
    ("ends", "chosen", "seen"),
    [
        ((0.95, 0.99), None, 2),  # too little better than 0.97
        ((0.96, 0.93, 0.94), 1, 3),
        ((0.9, 0.7, 0.6), 1, 2),  # the second is well below the tolerance of 0.85: enough
    ],
)
def test_the_lowest_end_is_taken(
    ends: tuple[float, ...], chosen: int | None, seen: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    vertices = pad_vertices(PROBLEM)[[3, 12, 24]]
    first, looked = usual(0.85), list[int]()
    monkeypatch.setattr(_starts, "beginnings", begun_with(first, dict(zip(vertices.tolist(), ends)), looked))  # noqa: B905
    found = starts(0.85, Keeping())._search(0.97 / PROBLEM.length)
    np.testing.assert_array_equal(found["centers"], [] if chosen is None else [vertices[chosen]])
    assert ("rho" in found) == (chosen is not None)
    assert len(looked) == seen


def test_on_a_coarser_mesh_the_points_are_vertices_of_the_whole_one(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Each beginning is compared with the usual one on the same mesh."""
    mesh = bent_bar((24, 5, 4), 60.0)
    problem = problem_of(mesh, PROFILE["materials"], "linear")
    monkeypatch.setattr(_starts, "LARGE_TETS", 1_000)
    monkeypatch.setattr(_starts, "START_TETS", 500)
    coarse = _starts.coarse_of(problem, mesh, PROFILE["materials"], 500)
    own, seen = coarse.level.coarse, list[int]()
    vertex = int(pad_vertices(own)[-1])
    first = relaxed(own, settings_of(0.3)(own), lambda at: None)  # noqa: ARG005
    monkeypatch.setattr(_starts, "relaxed", lambda *_: replace(first, relaxed_rms=1.0 / own.length))
    monkeypatch.setattr(_starts, "beginnings", begun_with(first, {vertex: 0.95}, seen))
    trace = Trace(problem, mesh, SilentMonitor(), 1.0)
    mine = Starts(problem, mesh, PROFILE["materials"], settings_of(0.3), trace, Keeping())
    found = mine._search(0.5 / problem.length)
    assert found.keys() == {"centers"}
    (found,) = found["centers"]
    np.testing.assert_allclose(mesh["X"][found], own.body.X[vertex] * own.length, atol=1e-12)


@pytest.mark.parametrize("why", ["no equilibrium", "thin walls"])
def test_the_usual_points_are_kept_where_a_coarser_mesh_tells_nothing(
    why: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    mesh = bent_bar((24, 5, 4), 60.0)
    problem = problem_of(mesh, PROFILE["materials"], "linear")
    monkeypatch.setattr(_starts, "LARGE_TETS", 1_000)
    monkeypatch.setattr(_starts, "START_TETS", 500 if why == "no equilibrium" else problem.n_tets)

    def lost(*_: Any) -> Search:
        raise EquilibriumError(why)

    looked = list[int]()
    monkeypatch.setattr(_starts, "relaxed", lost)
    monkeypatch.setattr(_starts, "beginnings", lambda *_: looked.append(1) or [])
    trace = Trace(problem, mesh, SilentMonitor(), 1.0)
    mine = Starts(problem, mesh, PROFILE["materials"], settings_of(0.3), trace, Keeping())
    assert mine._search(0.5 / problem.length) is _starts.NO_OTHERS
    assert not looked


def test_the_error_is_that_of_the_better_points(nearly: float) -> None:
    """The real search, judged by relaxing from what it returns; the usual points are kept where none are better."""
    tolerance, monitor = nearly, Keeping()
    first, mine = usual(tolerance), starts(tolerance, monitor)
    best = mine.best(first, lambda at: None)  # noqa: ARG005
    assert best.equilibria.patches.count == 2
    assert (best is first) if mine.chosen() is None else (best.relaxed_rms < first.relaxed_rms)


def test_the_design_that_was_found_with_other_points_is_relaxed_further(
    nearly: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Relaxing anew from the points that it ended with would come to another one."""
    monkeypatch.setattr(_starts, "BETTER", 10.0)
    tolerance, monitor, shown = nearly, Keeping(), list[Search]()
    best = starts(tolerance, monitor).best(usual(tolerance), shown.append)
    found = monitor.kept[_starts.CENTERS]
    np.testing.assert_array_equal(shown[0].design.rho, found["rho"])
    assert shown[0].phase is Phase.RELAX
    assert shown[1].phase in (Phase.RELAX, Phase.ROUND)
    assert best.relaxed_rms <= 1.01 * shown[0].rms


def test_a_stopped_run_goes_on_to_the_same_design(nearly: float, monkeypatch: pytest.MonkeyPatch) -> None:
    """Stopped at each save from the end of the first relaxing on."""
    monkeypatch.setattr(starts_of_design, "BEGINNINGS", 2)
    monkeypatch.setattr(_starts, "BETTER", 10.0)
    inputs = {"mesh": MESH, "check_report": {"nothing_to_program": False}, "picked": None}
    profile = PROFILE | {"goal": Goal(tolerance=nearly, max_forces=2)}
    whole = Recording()
    done = run(inputs, profile, whole)
    expected = done["relaxed"]
    first = whole.names.index(_starts.FIRST)
    assert _starts.CENTERS in whole.names
    for dies in (first + 1, first + 2, first + 4):
        monitor = Keeping(dies)
        with pytest.raises(KeyboardInterrupt):
            run(inputs, profile, monitor)
        monitor.left = None
        found = run(inputs, profile, monitor)
        np.testing.assert_array_equal(found["relaxed"]["rho"], expected["rho"])
        np.testing.assert_array_equal(found["relaxed"]["patch_center"], expected["patch_center"])
        if dies == first + 4:
            assert phases(found) == phases(done)


def test_other_prices_of_smp_set_out_from_the_better_design(nearly: float, monkeypatch: pytest.MonkeyPatch) -> None:
    """That is the first one, if the other is worse in the end."""
    monkeypatch.setattr(starts_of_design, "BEGINNINGS", 2)
    monkeypatch.setattr(_starts, "BETTER", 10.0)
    lower = Starts._lower
    worse = lambda self, first, other, watch: lower(self, first, replace(other, relaxed_rms=1.0), watch)  # noqa: E731
    monkeypatch.setattr(Starts, "_lower", worse)
    inputs = {"mesh": MESH, "check_report": {"nothing_to_program": False}, "picked": None}
    monitor = Keeping()
    found = run(inputs, PROFILE | {"goal": Goal(tolerance=nearly, max_forces=2)}, monitor)
    for name in ("rho", "centers"):
        np.testing.assert_array_equal(monitor.kept["relaxed"][name], monitor.kept[_starts.FIRST][name])
    assert phases(found).count("start") == 2


def phases(found: dict[str, Any]) -> list[str]:
    return [row["phase"] for row in csv.DictReader(io.StringIO(found["solve_trace"].decode()))]


class Recording(Keeping):
    """Remembers the names of all saves."""

    def __init__(self) -> None:
        super().__init__()
        self.names: list[str] = []

    def save(self, name: str, arrays: Arrays) -> None:
        super().save(name, arrays)
        self.names.append(name)
