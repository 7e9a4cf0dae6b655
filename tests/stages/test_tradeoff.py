"""The study tradeoff on samples/strip: rows as printed, kept and gone on with, and picked by stage solve."""

import csv
import io
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fab4d.errors import EquilibriumError, SceneError
from fab4d.io.meshes import read_mesh
from fab4d.io.scene import Scene, Weights, load_scene
from fab4d.runner.table import stage_table
from fab4d.stages import _printed, check, solve, threshold, tradeoff
from fab4d.stages._design import problem_of
from fab4d.stages._printed import as_printed, faults, refitted_in
from fab4d.stages._search import search_from
from fab4d.stages._settings import search_settings
from fab4d.stages.monitor import SilentMonitor

STRIP = Path(__file__).parents[2] / "samples" / "strip"
STUDY = stage_table().study("tradeoff")
Kept = tuple[list[dict[str, str]], Any]


def profile_of(scene: Scene, stage: Any) -> dict[str, Any]:
    return {name: getattr(scene, name) for name in stage.profile}


@pytest.fixture(scope="module")
def scene() -> Scene:
    return load_scene(STRIP)


@pytest.fixture(scope="module")
def checked(scene: Scene) -> dict[str, Any]:
    files = {"permanent": read_mesh(scene.permanent), "temporary": read_mesh(scene.temporary)}
    return check.run(files, profile_of(scene, stage_table().stage("check")), SilentMonitor())


def study(scene: Scene, checked: dict[str, Any], monitor: Any, **options: Any) -> list[dict[str, str]]:
    made = tradeoff.run(checked, profile_of(scene, STUDY), monitor, **options)
    return list(csv.DictReader(io.StringIO(made["tradeoff_csv"].decode())))


@pytest.fixture(scope="module")
def kept(scene: Scene, checked: dict[str, Any], memory: Any) -> Kept:
    """Two rows of three points, and what was kept of them."""
    monitor = memory()
    return study(scene, checked, monitor, points=[3], prices=[1.0, 4.0]), monitor


def test_dearer_smp_gives_a_row_with_less_of_it(kept: Kept) -> None:
    rows, _ = kept
    assert [row["id"] for row in rows] == ["3x1", "3x4"]
    share = [float(row["smp_fraction"]) for row in rows]
    assert share[1] < 0.9 * share[0]
    assert [float(row["lam_SMP"]) for row in rows] == pytest.approx([0.05, 0.2])
    assert {row["points"] for row in rows} == {"3"}


def test_mass_and_cost_are_those_of_the_share(scene: Scene, checked: dict[str, Any], kept: Kept) -> None:
    mesh, card = checked["mesh"], scene.materials
    edges = mesh["X"][mesh["tets"][:, 1:]] - mesh["X"][mesh["tets"][:, :1]]
    cm3 = np.abs(np.linalg.det(edges)).sum() / 6000
    for row in kept[0]:
        smp, tpe = cm3 * float(row["smp_fraction"]), cm3 * (1 - float(row["smp_fraction"]))
        mass = smp * card.smp_density, tpe * card.tpe_density
        assert float(row["mass_g"]) == pytest.approx(sum(mass))
        price = (mass[0] * card.smp_price + mass[1] * card.tpe_price) / 1000
        assert float(row["cost_usd"]) == pytest.approx(price)


def test_a_finished_row_is_not_made_again_and_a_lost_one_comes_out_equal(
    scene: Scene, checked: dict[str, Any], memory: Any, kept: Kept, monkeypatch: pytest.MonkeyPatch
) -> None:
    rows, whole = kept
    killed = memory({name: arrays for name, arrays in whole.saved.items() if name == "3x1"})
    killed.saved["index"] = {"names": np.array(["3x1"])}
    searched, solve_reduced = [], tradeoff.solve_reduced

    def counted(problem: Any, settings: Any, watch: Any, start: Any) -> Any:
        searched.append(start.lam_SMP)
        return solve_reduced(problem, settings, watch, start)

    monkeypatch.setattr(tradeoff, "solve_reduced", counted)
    again = study(scene, checked, killed, points=[3], prices=[1.0, 4.0])
    assert searched == pytest.approx([0.2])
    assert [row | {"tau": ""} for row in again] == [row | {"tau": ""} for row in rows]
    for name in ("rho", "x", "y", "forces"):
        np.testing.assert_array_equal(killed.saved["3x4"][name], whole.saved["3x4"][name])
    assert study(scene, checked, killed, points=[3], prices=[4.0]) == again


def test_stage_solve_takes_a_picked_row_as_it_is(scene: Scene, checked: dict[str, Any], kept: Kept) -> None:
    """Thresholding what solve makes of the pick gives the design that the row was judged by, before its flips."""
    arrays = kept[1].saved["3x4"]
    made = solve.run({**checked, "picked": arrays}, profile_of(scene, stage_table().stage("solve")), SilentMonitor())
    np.testing.assert_array_equal(made["relaxed"]["rho"], arrays["rho"])
    assert made["solve_report"]["picked"]["id"] == "3x4"
    assert made["solve_report"]["picked"] == json.loads(str(arrays["row"]))
    assert len(made["relaxed"]["patch_center"]) == 3
    assert [line.split(b",")[1] for line in made["solve_trace"].splitlines()[1:]] == [b"picked"]
    cost = made["relaxed"]["repair_cost"]
    labels = threshold.labels_for(checked["mesh"]["X"], checked["mesh"]["tets"], arrays["rho"], cost, scene.printer)
    assert labels.smp.any()


def test_numbers_of_points_without_a_design_are_told(scene: Scene, checked: dict[str, Any], memory: Any) -> None:
    free = {**checked, "mesh": {**checked["mesh"], "clamp": np.zeros(len(checked["mesh"]["X"]), bool)}}
    with pytest.raises(EquilibriumError, match=r"2 points: .*needs 3 points"):
        study(scene, free, memory(), points=[2])


@pytest.mark.parametrize("weights", [Weights(lam_SMP=0.0), Weights(lam_force=1.0)])
def test_weights_that_leave_nothing_to_multiply_are_refused(
    scene: Scene, checked: dict[str, Any], memory: Any, weights: Weights
) -> None:
    with pytest.raises(SceneError, match="lam_SMP, which must be above 0"):
        study(replace(scene, weights=weights), checked, memory())


def test_nothing_to_program_is_nothing_to_trade(scene: Scene, checked: dict[str, Any], memory: Any) -> None:
    still = {**checked, "check_report": {**checked["check_report"], "nothing_to_program": True}}
    with pytest.raises(SceneError, match="nothing to trade"):
        study(scene, still, memory())


def test_usual_points_are_half_to_all() -> None:
    assert tradeoff.usual_points(8) == [4, 6, 8]
    assert tradeoff.usual_points(3) == [2, 3]
    assert tradeoff.usual_points(1) == [1]


@pytest.fixture(scope="module")
def judged(scene: Scene, checked: dict[str, Any], kept: Kept) -> tuple[Any, ...]:
    """Problem, design and print of row 3x1, which is acceptable."""
    problem = problem_of(checked["mesh"], scene.materials, "linear")
    found = search_from(problem, kept[1].saved["3x1"])
    weights = search_settings(problem, profile_of(scene, STUDY)).weights
    return problem, found, as_printed(problem, checked["mesh"], scene.printer, scene.goal, weights, found, np.inf)


def test_printed_labels_are_refitted_in_other_elements(
    scene: Scene, checked: dict[str, Any], judged: tuple[Any, ...]
) -> None:
    """A fit is made where the tolerance is missed; in the same elements nothing changes."""
    problem, found, printed = judged
    quadratic = problem_of(checked["mesh"], scene.materials, "quadratic")
    weights = search_settings(problem, profile_of(scene, STUDY)).weights
    same = refitted_in(problem, found, printed.design, weights.replace(error_scale=1.0))
    assert same == pytest.approx(printed.rms, rel=1e-3)
    carried = refitted_in(quadratic, found, printed.design, weights.replace(error_scale=1.0))
    fitted = refitted_in(quadratic, found, printed.design, weights.replace(error_scale=0.5 * carried))
    assert abs(carried / printed.rms - 1) > 0.02
    assert fitted < carried


def test_flips_of_a_judged_design_end_where_it_is_good_enough(
    scene: Scene, checked: dict[str, Any], judged: tuple[Any, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    problem, found, printed = judged
    weights = search_settings(problem, profile_of(scene, STUDY)).weights
    asked = list[float]()

    def polished(_: Any, design: Any, __: Any, settings: Any, ___: Any) -> Any:
        asked.append(settings.target_rms)
        return design

    monkeypatch.setattr(_printed, "polish_labels", polished)
    good_enough = 0.5 * (found.relaxed_rms + printed.rms)
    for down_to in (0.0, good_enough, 2 * printed.rms):
        as_printed(problem, checked["mesh"], scene.printer, scene.goal, weights, found, down_to)
    assert found.relaxed_rms < printed.rms
    assert asked == [found.relaxed_rms, good_enough]


@pytest.mark.parametrize(
    ("goal", "rig", "acceptance", "tolerance_mm", "words"),
    [
        ({}, {}, {}, 1.0, None),
        ({}, {}, {}, 0.01, "0.01 mm are allowed"),
        ({"max_smp_fraction": 0.1}, {}, {}, 1.0, "10.0% are allowed"),
        ({}, {"max_force": 20.0}, {}, 1.0, "the rig gives 20 N"),
        ({}, {}, {"max_isolated_fraction": 0.0}, 1.0, "touch no other SMP tet"),
    ],
)
def test_a_design_is_judged_by_goal_rig_and_acceptance(
    scene: Scene,
    checked: dict[str, Any],
    judged: tuple[Any, ...],
    goal: Any,
    rig: Any,
    acceptance: Any,
    tolerance_mm: float,
    words: str | None,
) -> None:
    problem, found, printed = judged
    sections = {
        "goal": replace(scene.goal, **goal),
        "rig": replace(scene.rig, **rig),
        "acceptance": replace(scene.acceptance, **acceptance),
    }
    seen = faults(problem, checked["mesh"]["tets"], sections, found, printed, tolerance_mm / problem.length)
    assert len(seen) == (words is not None)
    assert words is None or words in seen[0]


def test_a_state_that_loading_does_not_reach_is_not_acceptable(
    scene: Scene, checked: dict[str, Any], judged: tuple[Any, ...]
) -> None:
    """The same forces and positions on a median shape that is moved elsewhere."""
    problem, found, printed = judged
    median = printed.design.median
    moved = replace(printed.design, median=replace(median, x=median.x + 1e-3 * ~problem.clamp[:, None]))
    sections = {name: getattr(scene, name) for name in ("goal", "rig", "acceptance")}
    tets, tolerance = checked["mesh"]["tets"], 1.0 / problem.length
    seen = faults(problem, tets, sections, found, replace(printed, design=moved), tolerance)
    assert seen == ["loading from the permanent shape does not end in the designed state"]
    lost = faults(problem, tets, sections, found, replace(printed, design=None), tolerance)
    assert lost == ["the printed labels have no equilibrium near the design"]
