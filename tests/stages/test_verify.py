"""The stage verify: what it delivers is what the simulation found, and it tells when that is not the design."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fab4d.design.equilibria import RIG_COMPLIANCE, Equilibria
from fab4d.design.gauss_newton import Design
from fab4d.design.patches import build_patches, spread_centers
from fab4d.io.cards import load_material
from fab4d.mesh.rigid import best_rigid_motion
from fab4d.stages import verify
from fab4d.stages._design import patch_arrays, patches_of, problem_of
from fab4d.stages.monitor import SilentMonitor
from fab4d.stages.verify import run

CARD = load_material("paper-corrected", Path())
Arrays = dict[str, np.ndarray]


@pytest.fixture(scope="module")
def scene(mesh: Arrays) -> Arrays:
    """The box, clamped at its left end, that wants to be bent upwards by 40 degrees."""
    X = mesh["X"]
    radius = 30.0 / np.radians(40)
    turn = np.maximum(X[:, 0] - 5.0, 0.0) / radius
    arm = radius - (X[:, 2] - 10.0)
    bent = np.column_stack([np.minimum(X[:, 0], 5.0) + arm * np.sin(turn), X[:, 1], 10 + radius - arm * np.cos(turn)])
    more = {"clamp": X[:, 0] <= 5.0, "vertex_map": np.arange(len(X)), "tet_map": 7 + np.arange(len(mesh["tets"]))}
    return {"X": X, "X_temp": bent, "tets": mesh["tets"]} | more


@pytest.fixture(scope="module")
def labels(scene: Arrays) -> Arrays:
    """SMP in the upper half."""
    return {"smp": scene["X"][scene["tets"]][:, :, 2].mean(axis=1) > 10.0}


@pytest.fixture(scope="module")
def printed(scene: Arrays, labels: Arrays) -> Arrays:
    """The equilibria with four points held where the wanted shape has them."""
    problem = problem_of(scene, CARD, "linear")
    patches = build_patches(problem, spread_centers(problem, 4), 6.0 / problem.length)
    equilibria, x = Equilibria(problem, patches), problem.X_temp
    rho = labels["smp"].astype(np.float64)
    median = equilibria.solve_median(rho, patches.mean(x), x, np.zeros((4, 3)), 1e-12, 60)
    final = equilibria.solve_final(rho, median, median.x, 1e-11, 60)
    assert median.solution.converged
    assert final.solution.converged
    shapes = {"x": median.x * problem.length, "y": final.y * problem.length}
    return shapes | patch_arrays(problem, patches, Design(rho, median, final))


def verified(
    scene: Arrays, labels: Arrays, printed: Arrays, card: Any = CARD, loaded: Arrays | None = None
) -> tuple[Arrays, dict[str, Any]]:
    result = run(
        {"mesh": scene, "labels": labels, "printed": printed, "loaded": loaded},
        {"materials": card},
        SilentMonitor(),
    )
    return result["state"], result["verify_report"]


def test_a_design_is_reached_and_its_state_told(scene: Arrays, labels: Arrays, printed: Arrays) -> None:
    state, report = verified(scene, labels, printed)
    assert report["reached"]
    assert report["reasons"] == []
    assert max(report["equilibrium_residual"].values()) < 1e-10
    np.testing.assert_allclose(state["x"], printed["x"], atol=1e-7)
    np.testing.assert_allclose(state["patch_force"], printed["patch_force"], rtol=1e-6)
    np.testing.assert_array_equal(state["x"][state["clamp"]], scene["X"][scene["clamp"]])


def test_a_loading_that_was_followed_before_is_not_followed_again(
    scene: Arrays, labels: Arrays, printed: Arrays, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its end, known to four digits, is solved to rounding and measured as if it had been."""
    state, report = verified(scene, labels, printed)
    off = 1e-4 * np.sin(scene["X"]) * ~scene["clamp"][:, None]
    loaded = {"x": state["x"] + off, "y": state["y"] + off, "patch_force": state["patch_force"]}
    loaded["load_steps"] = np.array(report["load_steps"])
    loaded["patch_force"] = held_force(scene, printed, loaded["x"])
    monkeypatch.setattr(verify, "program", None)
    again, same = verified(scene, labels, printed, loaded=loaded)
    for name in ("x", "patch_force"):
        np.testing.assert_allclose(again[name], state[name], rtol=1e-8, atol=1e-8)
    np.testing.assert_allclose(again["y"], best_fit(again["y"], state["y"]), atol=1e-8)
    assert same["load_steps"] == report["load_steps"]
    assert same["error"]["rms"] == pytest.approx(report["error"]["rms"], rel=1e-8)
    assert max(same["equilibrium_residual"].values()) < 1e-10


def held_force(scene: Arrays, printed: Arrays, x: np.ndarray) -> np.ndarray:
    """(K, 3) the forces, N, that go with the shape x (mm) where the points are held as in `printed`."""
    problem = problem_of(scene, CARD, "linear")
    patches = patches_of(problem, printed)
    moved = (patches.mean(printed["x"]) - patches.mean(x)) / problem.length
    return printed["patch_force"] + moved / RIG_COMPLIANCE * problem.force


def test_a_quadratic_fit_is_verified_in_quadratic_elements(scene: Arrays, labels: Arrays, printed: Arrays) -> None:
    """The state is that of a median problem built apart, solved from the wanted shape instead of by loading."""
    problem = problem_of(scene, CARD, "quadratic")
    equilibria = Equilibria(problem, patches_of(problem, printed))
    rho = labels["smp"].astype(np.float64)
    held = equilibria.patches.mean(problem.X_temp)
    median = equilibria.solve_median(rho, held, problem.X_temp, np.zeros((4, 3)), 1e-12, 60)
    final = equilibria.solve_final(rho, median, median.x, 1e-11, 60)
    L0, design = problem.length, Design(rho, median, final)
    quadratic = {"x": median.x * L0, "y": final.y * L0} | patch_arrays(problem, equilibria.patches, design)
    state, report = verified(scene, labels, quadratic)
    assert (report["element_order"], report["reasons"]) == (2, [])
    assert state["elements"].shape[1] == 10
    np.testing.assert_allclose(state["patch_force"], quadratic["patch_force"], rtol=1e-6)
    np.testing.assert_allclose(state["y"], best_fit(state["y"], quadratic["y"]), atol=1e-7)
    sizes = np.linalg.norm(state["patch_force"], axis=1)
    assert report["force_change"]["quadratic_N"] == pytest.approx(sizes)
    assert max(report["force_change"]["linear_N"]) > 1.1 * sizes.max()
    assert report["force_uncertainty"]["method"] == "quadratic elements on a mesh refined 1:8"
    assert 0 < report["force_uncertainty"]["largest"] < 0.5


def best_fit(y: np.ndarray, other: np.ndarray) -> np.ndarray:
    """The shape `other` (N, 3) moved rigidly onto y."""
    R, t = best_rigid_motion(other, y)
    return other @ R.T + t


def test_forces_and_moments_of_points_and_clamp_balance(scene: Arrays, labels: Arrays, printed: Arrays) -> None:
    state, _ = verified(scene, labels, printed)
    force, x = state["force"], state["x"]
    scale = np.linalg.norm(force.sum(axis=0)) + np.linalg.norm(state["patch_force"], axis=1).max()
    np.testing.assert_allclose(force.sum(axis=0) + state["clamp_reaction"], 0.0, atol=1e-9 * scale)
    arms = x - x[state["clamp"]].mean(axis=0)
    moment = np.cross(arms, force).sum(axis=0) + state["clamp_moment"]
    np.testing.assert_allclose(moment, 0.0, atol=1e-9 * scale * np.ptp(x))
    np.testing.assert_allclose(force.sum(axis=0), state["patch_force"].sum(axis=0), atol=1e-9 * scale)


def test_another_median_shape_than_the_designed_one_is_told(scene: Arrays, labels: Arrays, printed: Arrays) -> None:
    """The points stand where they should, but the part between them does not: nothing is claimed to be reached."""
    x = printed["x"].copy()
    inside = ~scene["clamp"]
    x[inside] += 0.5 * np.sin(scene["X"][inside][:, [2, 0, 1]])
    _, report = verified(scene, labels, printed | {"x": x})
    assert not report["reached"]
    assert "mm off the designed median shape" in report["reasons"][0]
    assert max(report["equilibrium_residual"].values()) < 1e-10


def test_other_labels_than_the_designed_ones_are_noticed(scene: Arrays, labels: Arrays, printed: Arrays) -> None:
    _, report = verified(scene, {"smp": ~labels["smp"]}, printed)
    assert not report["reached"]


def test_a_material_stretched_beyond_its_card_is_told(scene: Arrays, labels: Arrays, printed: Arrays) -> None:
    brittle = replace(CARD, tpe_max_stretch=1.05)
    state, report = verified(scene, labels, printed, brittle)
    reason = next(reason for reason in report["reasons"] if reason.startswith("TPE is stretched"))
    assert "the card allows 1.05" in reason
    edges = np.swapaxes(state["nodes"][scene["tets"][:, 1:]] - state["nodes"][scene["tets"][:, :1]], 1, 2)
    moved = np.swapaxes(state["x"][scene["tets"][:, 1:]] - state["x"][scene["tets"][:, :1]], 1, 2)
    stretch = np.linalg.svd(moved @ np.linalg.inv(edges), compute_uv=False)[:, 0]
    over = ~labels["smp"] & (stretch > 1.05)
    worst = int(np.argmax(np.where(over, stretch, 0.0)))
    assert f"in tet {scene['tet_map'][worst]} ({over.sum()} tets in all)" in reason
    assert not any(reason.startswith("SMP is") for reason in report["reasons"])
