"""The stage solve: how many points it takes, and what it says where a goal is out of reach."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from bent_bar import PROFILE, bent_bar

from fab4d.design.problem import Problem
from fab4d.design.reduced import Search, at_rest
from fab4d.io.scene import Acceptance, Goal, SolverSettings
from fab4d.report.metrics import shapes_of
from fab4d.stages import solve
from fab4d.stages._design import problem_of
from fab4d.stages._figures import limits_of
from fab4d.stages.monitor import SilentMonitor
from fab4d.stages.solve import run, search_settings


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
    assert found["relaxed"]["relaxed_rms"] <= 0.6 * 0.6
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
    monkeypatch.setattr(solve, "MANY_TETS", problem.n_tets - 1)
    fast = search_settings(problem, profile)
    assert fast.round_growth > 2 > usual.round_growth
    assert replace(fast, round_growth=usual.round_growth) == usual


def test_labels_of_other_elements_keep_to_the_share_of_smp_or_are_left(
    bar: dict[str, np.ndarray], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Where quadratic tets need more SMP than the goal allows, the labels of the linear ones are handed on."""
    quadratic = SolverSettings(element="quadratic")

    def all_smp(problem: Problem, relaxed: Search, *_: Any) -> Search:
        rest = at_rest(problem)
        return replace(rest, design=replace(rest.design, rho=np.ones(problem.n_tets)), relaxed_rms=relaxed.relaxed_rms)

    monkeypatch.setattr(solve, "rounded_in", all_smp)
    for most, kept in ((None, True), (0.9, False)):
        found = solved(bar, Goal(tolerance=0.6, max_forces=3, max_smp_fraction=most), solver=quadratic)["relaxed"]
        assert (len(found["x"]) > len(bar["X"])) == kept
