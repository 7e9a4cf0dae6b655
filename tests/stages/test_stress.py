"""The study stress: its figures are those of states solved anew, and scale as the equations do."""

from typing import Any

import numpy as np
import pytest
from test_sensitivity import CARD, scaled_inputs

from fab4d.design.equilibria import Equilibria
from fab4d.design.forward import Balance, program
from fab4d.errors import SceneError
from fab4d.io.csvtable import read_csv
from fab4d.report.stress import COLUMNS
from fab4d.stages import stress
from fab4d.stages._design import patches_of, problem_of
from fab4d.stages.monitor import SilentMonitor
from fab4d.stages.stress import CASES, Case, row_of

Arrays = dict[str, np.ndarray]


@pytest.fixture(scope="module")
def inputs(mesh: Arrays) -> dict[str, Any]:
    """A bar bent upwards by 40 degrees at four points."""
    return scaled_inputs(mesh)


def row(inputs: dict[str, Any], case: Case) -> dict[str, Any]:
    smp = inputs["labels"]["smp"].astype(np.float64)
    return row_of(case, inputs["mesh"], inputs["state"], smp, CARD, tau_s=1.0)


@pytest.mark.parametrize(
    "case",
    [
        Case("as designed"),
        Case("all stiffer", {"tpe": 7.0, "rubbery": 7.0, "glassy": 7.0}),
        Case("tiny", size=1e-3),
        Case("huge", size=1e3),
        Case("away", away=1e3),
    ],
    ids=lambda case: case.name,
)
def test_the_shape_hangs_on_ratios_of_moduli_alone(inputs: dict[str, Any], case: Case) -> None:
    found = row(inputs, case)
    assert found["solved"]
    assert found["loaded"] == found["unloaded"] == 1.0
    assert max(found["residual_median"], found["residual_final"]) < stress.SOLVED
    # The rig's compliance, 1e-4 in units of TPE and diagonal, does not scale with the moduli.
    assert found["off_rel"] < (1e-5 if case.stiffer else 1e-9)
    assert found["negative_modes"] == 0
    assert found["min_det_F"] > 0


def test_size_and_place_are_changed_together_with_the_forces() -> None:
    arrays = {"X": np.eye(3), "patch_force": np.ones((2, 3)), "tets": np.arange(4)}
    moved = stress._moved(arrays, Case("", size=10.0, away=3.0), diagonal=2.0)
    np.testing.assert_array_equal(moved["X"], 10 * np.eye(3) + 6)
    np.testing.assert_array_equal(moved["patch_force"], np.full((2, 3), 100.0))
    assert moved["tets"] is arrays["tets"]


def test_the_stiffer_the_cold_smp_the_less_the_part_springs_back(inputs: dict[str, Any]) -> None:
    """Off the designed final shape, by less and less more: the frozen shape is the limit."""
    off = [row(inputs, Case("", {"glassy": stiffer}))["off_rel"] for stiffer in (1.0, 10.0, 100.0, 1000.0)]
    gains = np.diff(off)
    assert (gains > 0).all()
    assert gains[2] < 0.2 * gains[1] < gains[0]


def test_bulk_moduli_keep_the_volume(inputs: dict[str, Any]) -> None:
    least = [row(inputs, Case("", bulkier=bulkier))["min_det_F"] for bulkier in (1.0, 10.0, 1000.0)]
    assert 0 < least[0] < least[1] < least[2] < 1
    assert 1 - least[2] < 0.25 * (1 - least[0])


@pytest.mark.parametrize(("rounding", "solved"), [(0.0, False), (1.0, True)])
def test_a_residual_above_the_limit_is_solved_only_if_it_is_rounding(
    inputs: dict[str, Any], monkeypatch: pytest.MonkeyPatch, rounding: float, solved: bool
) -> None:
    monkeypatch.setattr(stress, "SOLVED", 0.0)
    monkeypatch.setattr(stress, "_rounding", lambda *_: Balance(rounding, rounding, 1.0))
    assert row(inputs, CASES[0])["solved"] == solved


def test_rounding_leaves_more_of_what_is_stiff_and_far_away(inputs: dict[str, Any]) -> None:
    usual, stiff, away = (row(inputs, case) for case in (CASES[0], Case("", {"glassy": 1e3}), Case("", away=1e3)))
    assert stiff["rounding_final"] > 100 * usual["rounding_final"]
    assert away["rounding_median"] > 100 * usual["rounding_median"]
    assert usual["rounding_final"] < 1e-10


def test_a_singular_tangent_has_no_number_of_unstable_ways(
    inputs: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    problem = problem_of(inputs["mesh"], CARD, "linear")
    equilibria = Equilibria(problem, patches_of(problem, inputs["state"]))
    smp, x = inputs["labels"]["smp"].astype(np.float64), inputs["state"]["x"] / problem.length
    done = program(equilibria, smp, x, inputs["state"]["patch_force"] / problem.force)
    assert stress._negative_modes(equilibria, smp, done) == 0
    monkeypatch.setattr(Equilibria, "median_tangent", lambda *_: np.zeros(equilibria.held_pattern.nnz))
    assert stress._negative_modes(equilibria, smp, done) is None


def test_a_table_of_all_cases_and_the_largest_residual_of_those_solved(inputs: dict[str, Any]) -> None:
    found = stress.run(inputs, {"materials": CARD}, SilentMonitor())
    rows, report = read_csv(found["stress_csv"], COLUMNS, "stress.csv"), found["stress_report"]
    assert [each["case"] for each in rows] == [case.name for case in CASES]
    solved = [each for each in rows if each["solved"] == "yes"]
    assert report["cases"] == len(CASES)
    assert report["solved"] == len(solved) >= 10
    assert report["largest_residual"] == max(
        float(each[name]) for each in solved for name in ("residual_median", "residual_final")
    )


def test_finished_cases_are_not_simulated_again(
    inputs: dict[str, Any], memory: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    made, monitor = list[str](), memory()

    def counted(case: Case, *_: Any) -> dict[str, Any]:
        made.append(case.name)
        if len(made) == 3:
            raise KeyboardInterrupt
        return {"case": case.name, "solved": False, **dict.fromkeys(COLUMNS[2:])}

    monkeypatch.setattr(stress, "row_of", counted)
    with pytest.raises(KeyboardInterrupt):
        stress.run(inputs, {"materials": CARD}, monitor)
    found = stress.run(inputs, {"materials": CARD}, monitor)
    assert made == [case.name for case in (*CASES[:3], *CASES[2:])]
    assert found["stress_report"]["largest_residual"] is None


def test_without_points_there_is_nothing_to_stress(inputs: dict[str, Any]) -> None:
    none = inputs | {"state": inputs["state"] | {"patch_center": np.zeros(0, np.int64)}}
    with pytest.raises(SceneError, match="nothing to stress"):
        stress.run(none, {"materials": CARD}, SilentMonitor())
