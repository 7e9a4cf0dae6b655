"""The stage solve: how many points it takes, and what it says where a goal is out of reach."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from shapes.boxes import box
from shapes.warps import Turn, ramp, rod, warped

from fab4d.io.cards import load_material, load_printer, load_rig
from fab4d.io.scene import Goal, SolverSettings, Weights
from fab4d.stages.monitor import SilentMonitor
from fab4d.stages.solve import run

SIZE = (60.0, 12.0, 8.0)
PROFILE = {
    "materials": load_material("paper-corrected", Path()),
    "printer": load_printer("generic-dual-0.4", Path()),
    "rig": load_rig("bench", Path()),
    "weights": Weights(),
    "solver": SolverSettings(element="linear"),
}


@pytest.fixture(scope="module")
def bar() -> dict[str, np.ndarray]:
    """A bar clamped at its left end that wants to be bent by 50 degrees."""
    X, tets = box(SIZE, (7, 1, 1), "five")
    line = rod((8.0, SIZE[1] / 2, SIZE[2] / 2), (SIZE[0], SIZE[1] / 2, SIZE[2] / 2), (0, 0, 1))
    bent = warped(X, line, (Turn((0, 0, 1), 50.0, lambda s: ramp(s, 0, 5)),))
    return {"X": X, "X_temp": bent, "tets": tets, "clamp": X[:, 0] <= 8.0}


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
