"""The stage sensitivity: its figures are those of states solved anew, and it says what it leaves out."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.linalg import eigh

from fab4d.design.equilibria import RIG_COMPLIANCE, Equilibria
from fab4d.design.gauss_newton import Design
from fab4d.design.patches import build_patches, spread_centers
from fab4d.design.robustness import Instability
from fab4d.design.stability import SoftModes
from fab4d.io.cards import load_material
from fab4d.materials.cards import Moduli
from fab4d.mesh.distance import shape_error
from fab4d.mesh.measures import vertex_areas
from fab4d.solvers.linear import SingularMatrixError
from fab4d.stages import sensitivity
from fab4d.stages._design import patch_arrays, patches_of, problem_of
from fab4d.stages.monitor import SilentMonitor

CARD = load_material("paper-corrected", Path())
Arrays = dict[str, np.ndarray]


def scaled_inputs(mesh: Arrays, scale: float = 1.0, card: Any = CARD, held: np.ndarray | None = None) -> dict[str, Any]:
    """The box bent upwards by 40 degrees, SMP in its upper half, held at four points, in equilibrium.

    scale : of all lengths      held : (4, 3) positions of the points, mm, or those of the wanted shape
    """
    X = scale * mesh["X"]
    radius, foot, middle = scale * 30.0 / np.radians(40), scale * 5.0, scale * 10.0
    turn = np.maximum(X[:, 0] - foot, 0.0) / radius
    arm = radius - (X[:, 2] - middle)
    bent = np.column_stack([np.minimum(X[:, 0], foot) + arm * np.sin(turn), X[:, 1], 0 * X[:, 2]])
    bent[:, 2] = middle + radius - arm * np.cos(turn)
    scene = {"X": X, "X_temp": bent, "tets": mesh["tets"], "clamp": X[:, 0] <= foot}
    smp = X[mesh["tets"]][:, :, 2].mean(axis=1) > middle
    problem = problem_of(scene, card, "linear")
    patches = build_patches(problem, spread_centers(problem, 4), 6.0 * scale / problem.length)
    equilibria, x, rho = Equilibria(problem, patches), problem.X_temp, smp.astype(np.float64)
    at = patches.mean(x) if held is None else held / problem.length
    median = equilibria.solve_median(rho, at, x, np.zeros((4, 3)), 1e-12, 60)
    final = equilibria.solve_final(rho, median, median.x, 1e-11, 60)
    assert median.solution.converged
    assert final.solution.converged
    shapes = {"x": median.x * problem.length, "y": final.y * problem.length}
    state = shapes | patch_arrays(problem, patches, Design(rho, median, final))
    return {
        "mesh": scene,
        "labels": {"smp": smp},
        "state": state,
        "verify_report": {"element_order": 1, "reached": True},
    }


def measured(inputs: dict[str, Any], card: Any = CARD) -> dict[str, Any]:
    return sensitivity.run(inputs, {"materials": card}, SilentMonitor())["sensitivity_report"]


def rms_mm(inputs: dict[str, Any]) -> float:
    """The error as the stage verify measures it."""
    mesh = inputs["mesh"]
    problem = problem_of(mesh, CARD, "linear")
    areas = vertex_areas(mesh["X"], problem.faces)
    return shape_error(inputs["state"]["y"], mesh["X_temp"], problem.faces, areas).rms


@pytest.fixture(scope="module")
def inputs(mesh: Arrays) -> dict[str, Any]:
    return scaled_inputs(mesh)


@pytest.fixture(scope="module")
def report(inputs: dict[str, Any]) -> dict[str, Any]:
    return measured(inputs)


def test_the_error_is_that_of_the_verified_state(inputs: dict[str, Any], report: dict[str, Any]) -> None:
    assert report["rms_mm"] == pytest.approx(rms_mm(inputs), rel=1e-9)
    assert (report["stable"], report["reasons"], report["left_out"]) == (True, [], [])


def test_moduli_are_those_of_a_design_made_anew(mesh: Arrays, inputs: dict[str, Any], report: dict[str, Any]) -> None:
    """Another card at the same held positions, solved from scratch."""
    held, before = inputs["state"]["patch_held"], np.linalg.norm(inputs["state"]["patch_force"])
    for phase in ("tpe", "rubbery", "glassy"):
        moduli = getattr(CARD, phase)
        other = replace(CARD, **{phase: Moduli(1.1 * moduli.mu, 1.1 * moduli.kappa)})
        anew = scaled_inputs(mesh, card=other, held=held)
        told = report["modulus"][phase]["stiffer"]
        assert told["rms_mm"] == pytest.approx(rms_mm(anew), rel=1e-3)
        assert told["forces"] == pytest.approx(np.linalg.norm(anew["state"]["patch_force"]) / before, rel=1e-3)
        assert report["modulus"][phase]["softer"]["rms_mm"] != pytest.approx(report["rms_mm"], rel=1e-4)


def test_changed_forces_are_simulated_but_on_the_largest_meshes(
    inputs: dict[str, Any], report: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sensitivity, "MOST_FORCED_TETS", len(inputs["mesh"]["tets"]) - 1)
    large = measured(inputs)
    assert large["left_out"] == [sensitivity.NOT_FORCED]
    for way in ("smaller", "larger"):
        assert report["force"][way]["simulated"]
        assert report["force"][way]["rms_mm"] is not None
        assert large["force"][way] == report["force"][way] | {"simulated": False, "rms_mm": None}


def test_the_worst_pads_are_simulated(mesh: Arrays, inputs: dict[str, Any], report: dict[str, Any]) -> None:
    points = report["hold"]["points"]
    worst = sorted(points, key=lambda p: -p["model_rms_mm"])
    assert [p["simulated"] for p in worst] == [p["rms_mm"] is not None for p in worst] == [True, True, False, False]
    held = inputs["state"]["patch_held"].copy()
    held[worst[0]["point"] - 1] += worst[0]["direction"]
    assert worst[0]["rms_mm"] == pytest.approx(rms_mm(scaled_inputs(mesh, held=held)), rel=1e-3)
    assert worst[0]["rms_mm"] == pytest.approx(worst[0]["model_rms_mm"], rel=0.2)
    assert all(np.linalg.norm(p["direction"]) == pytest.approx(1.0) for p in points)
    assert all(p["model_rms_mm"] > report["rms_mm"] for p in points)
    assert report["hold"]["random_rms_mm"] == report["hold"]["random_model_rms_mm"] > report["rms_mm"]


def test_everything_is_simulated_where_the_model_does_not_hold(
    inputs: dict[str, Any], report: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sensitivity, "MODEL_ERROR", 1e-9)
    hold, before = measured(inputs)["hold"], report["hold"]
    assert (before["model_holds"], hold["model_holds"]) == (True, False)
    assert all(p["simulated"] for p in hold["points"])
    for p in hold["points"]:
        assert p["rms_mm"] == pytest.approx(p["model_rms_mm"], rel=0.2)
    assert hold["random_rms_mm"] != hold["random_model_rms_mm"]
    assert hold["random_rms_mm"] == pytest.approx(hold["random_model_rms_mm"], rel=0.5)


@pytest.mark.parametrize(("off", "known"), [((), 2), ((0,), 4), ((1,), 4), ((0, 3), 6), ((5,), 2)])
def test_points_are_simulated_until_two_in_a_row_are_told_well(off: tuple[int, ...], known: int) -> None:
    """Six points, the worst first in pairs; those of `off` have half the error that the model tells, or no state."""
    told = np.array([3.0, 5.0, 4.0, 8.0, 6.0, 7.0])
    order = np.argsort(-told).tolist()

    def simulate(some: list[int]) -> list[float | None]:
        half = {order[k]: (None if k else told[order[k]] / 2) for k in off}
        return [half.get(k, float(told[k])) for k in some]

    assert list(sensitivity.simulated_points(told, simulate)) == order[:known]


def test_figures_grow_with_the_part(mesh: Arrays, report: dict[str, Any], monkeypatch: pytest.MonkeyPatch) -> None:
    """A part ten times as large with pads ten times as far off has ten times the errors; moduli and forces alike."""
    monkeypatch.setattr(sensitivity, "HOLD_MM", 10.0)
    large = measured(scaled_inputs(mesh, scale=10.0))
    for small, big in zip(report["hold"]["points"], large["hold"]["points"], strict=True):
        assert big["model_rms_mm"] == pytest.approx(10 * small["model_rms_mm"], rel=1e-5)
    for way in ("smaller", "larger"):
        assert large["force"][way]["rms_mm"] == pytest.approx(10 * report["force"][way]["rms_mm"], rel=1e-3)
    assert large["modulus"]["glassy"]["softer"]["rms_mm"] == pytest.approx(
        10 * report["modulus"]["glassy"]["softer"]["rms_mm"], rel=1e-4
    )
    assert large["instability"] == report["instability"]


def test_the_softest_mode_is_told_with_its_place(inputs: dict[str, Any], report: dict[str, Any]) -> None:
    mesh, softest = inputs["mesh"], report["softest"]
    problem = problem_of(mesh, CARD, "linear")
    equilibria = Equilibria(problem, patches_of(problem, inputs["state"]))
    design = sensitivity._verified_design(equilibria, inputs["labels"]["smp"].astype(np.float64), inputs["state"])
    tangent, positive = (equilibria.median_tangent(design.rho, design.median.x, spd=spd) for spd in (False, True))
    n, pattern = design.median.x.size, equilibria.held_pattern
    W = np.kron(equilibria.operator.toarray(), np.eye(3))
    dense = []
    for data in (tangent, positive):
        K = np.zeros((pattern.n_dofs, pattern.n_dofs))
        K[pattern.indices, pattern.column_of_entry()] = data
        K = K[:n, :n]
        dense.append(np.tril(K) + np.tril(K, -1).T + W.T @ W / RIG_COMPLIANCE)
    free = np.setdiff1d(np.arange(n), equilibria.held_mask.fixed)
    ratios, shapes = eigh(*(K[np.ix_(free, free)] for K in dense))
    assert softest["stiffness_left"] == pytest.approx(ratios[0], rel=1e-4)
    assert ratios[1] > 1.001 * ratios[0]
    shape = np.zeros(n)
    shape[free] = shapes[:, 0]
    node = np.linalg.norm(shape.reshape(-1, 3), axis=1).argmax()
    np.testing.assert_allclose(softest["at_mm"], mesh["X"][node], atol=1e-9)


def test_without_a_mode_none_is_told(inputs: dict[str, Any], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sensitivity, "soft_modes", lambda *_: SoftModes(np.zeros(0), np.zeros((0, 1, 3))))
    assert measured(inputs)["softest"] is None


def test_what_cannot_be_measured_is_left_out(inputs: dict[str, Any]) -> None:
    none = inputs | {"state": inputs["state"] | {"patch_center": np.zeros(0, int)}}
    astray = inputs | {"verify_report": {"element_order": 1, "reached": False}}
    for given, why in ((none, "nothing to program"), (astray, "did not reach")):
        left = measured(given)
        assert set(left) == {"left_out", "reasons"}
        assert why in left["left_out"][0]["why"]
        assert left["reasons"] == []


def test_a_state_that_would_not_stay_is_a_reason_to_reject(
    inputs: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    found = Instability(2, 0, 3, np.array([True, False, False, True]))
    monkeypatch.setattr(sensitivity, "instability_of", lambda _: found)
    report = measured(inputs)
    assert not report["stable"]
    assert report["instability"] == {"held": 2, "final": 0, "dead_loads": 3, "points": [1, 4]}
    assert report["reasons"][0].startswith("the held median shape is unstable in 2 ways")
    assert len(report["reasons"]) == 1
    assert "hold" not in report
    assert report["left_out"]


def test_a_singular_tangent_is_a_reason_to_reject(inputs: dict[str, Any], monkeypatch: pytest.MonkeyPatch) -> None:
    def singular(*_: Any) -> None:
        raise SingularMatrixError("unknown 7")  # noqa: EM101

    monkeypatch.setattr(sensitivity, "linearise", singular)
    report = measured(inputs)
    assert not report["stable"]
    assert "unknown 7" in report["reasons"][0]
