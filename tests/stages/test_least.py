"""The least SMP for the goal, on samples/strip: judged as printed, the best kept, gone on with after a kill."""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fab4d.design import tradeoff
from fab4d.errors import SceneError
from fab4d.io.meshes import read_mesh
from fab4d.io.scene import Goal, Scene, Weights, load_scene
from fab4d.runner.table import stage_table
from fab4d.stages import _least, check, solve
from fab4d.stages.monitor import SilentMonitor

STRIP = Path(__file__).parents[2] / "samples" / "strip"
Searched = tuple[dict[str, Any], Any]


@pytest.fixture(scope="module")
def scene() -> Scene:
    """The strip with a tolerance that leaves room below it."""
    strip = load_scene(STRIP)
    return replace(strip, goal=replace(strip.goal, tolerance=0.7, smp="least"))


@pytest.fixture(scope="module")
def checked(scene: Scene) -> dict[str, Any]:
    return check_stage(scene)


def check_stage(scene: Scene) -> dict[str, Any]:
    files = {"permanent": read_mesh(scene.permanent), "temporary": read_mesh(scene.temporary)}
    profile = {name: getattr(scene, name) for name in stage_table().stage("check").profile}
    return check.run(files, profile, SilentMonitor())


def solved(scene: Scene, checked: Mapping[str, Any], monitor: SilentMonitor) -> dict[str, Any]:
    profile = {name: getattr(scene, name) for name in stage_table().stage("solve").profile}
    return solve.run({**checked, "picked": None}, profile, monitor)


@pytest.fixture(scope="module")
def searched(scene: Scene, checked: dict[str, Any], memory: Any) -> Searched:
    """What a search of three trials finds, and what it kept."""
    monitor = memory()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(tradeoff, "MOST_TRIALS", 3)
        return solved(scene, checked, monitor), monitor


def test_the_least_smp_that_is_acceptable_is_taken(scene: Scene, checked: dict[str, Any], searched: Searched) -> None:
    trials = searched[0]["solve_report"]["least_smp"]
    acceptable = [trial for trial in trials if trial["acceptable"]]
    assert [trial["lam_SMP"] / trials[0]["lam_SMP"] for trial in trials[:2]] == [1, 2]
    assert len(acceptable) > 1  # else there is nothing to choose from
    best = min(acceptable, key=lambda trial: trial["smp_fraction"])
    assert best["smp_fraction"] < 0.8 * trials[0]["smp_fraction"]
    assert best["rms_mm"] <= 0.9 * scene.goal.tolerance
    assert searched[0]["solve_report"]["printed_rms_mm"] == best["rms_mm"]
    rho = searched[0]["relaxed"]["rho"]
    mesh = checked["mesh"]
    edges = mesh["X"][mesh["tets"][:, 1:]] - mesh["X"][mesh["tets"][:, :1]]
    volumes = np.abs(np.linalg.det(edges))
    delivered = volumes @ rho / volumes.sum()
    # It is rounded in other elements than the trials, whose labels are repaired.
    assert min(trials, key=lambda trial: abs(trial["smp_fraction"] - delivered)) is best
    assert delivered < 0.8 * trials[0]["smp_fraction"]


def test_what_is_not_acceptable_says_why(searched: Searched) -> None:
    for trial in searched[0]["solve_report"]["least_smp"]:
        assert trial["acceptable"] == (not trial["reasons"])


def test_a_killed_search_goes_on_with_the_same_bits(
    scene: Scene, checked: dict[str, Any], memory: Any, searched: Searched, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole, monitor = searched
    assert {"trial-1", "trial-2"} <= set(monitor.saved)
    killed = memory({name: arrays for name, arrays in monitor.saved.items() if name != "trial-2"})
    prices = []

    def counted(problem: Any, settings: Any, start: Any, lam_SMP: float, watch: Any) -> Any:
        prices.append(lam_SMP)
        return tradeoff.search_at(problem, settings, start, lam_SMP, watch)

    monkeypatch.setattr(tradeoff, "MOST_TRIALS", 3)
    monkeypatch.setattr(_least, "search_at", counted)
    again = solved(scene, checked, killed)
    assert prices == [whole["solve_report"]["least_smp"][2]["lam_SMP"]]
    assert again["solve_report"]["least_smp"] == whole["solve_report"]["least_smp"]
    for name, array in whole["relaxed"].items():
        np.testing.assert_array_equal(again["relaxed"][name], array)
    assert len(again["solve_trace"].splitlines()) == len(whole["solve_trace"].splitlines())


def test_smp_that_costs_nothing_cannot_be_made_dearer(scene: Scene, checked: dict[str, Any]) -> None:
    free = replace(scene, weights=Weights(lam_SMP=0.0))
    with pytest.raises(SceneError, match="lam_SMP is 0"):
        solved(free, checked, SilentMonitor())


@pytest.mark.parametrize(("smp", "left_out"), [("enough", True), ("least", False)])
def test_the_check_says_when_the_search_is_left_out(scene: Scene, smp: str, left_out: bool) -> None:
    goal: Goal = replace(scene.goal, smp=smp)
    report = check_stage(replace(scene, goal=goal))["check_report"]
    assert ("search for the least SMP" in [item["what"] for item in report["left_out"]]) == left_out
