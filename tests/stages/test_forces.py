"""How far forces are to be trusted: against meshes much finer than those that the estimates come from."""

from pathlib import Path

import numpy as np
import pytest

from fab4d.design.equilibria import Equilibria
from fab4d.design.patches import build_patches
from fab4d.io.cards import load_material
from fab4d.mesh.quadratic import with_midpoints
from fab4d.mesh.refinement import refined, refined_faces
from fab4d.stages import _element, _forces
from fab4d.stages._design import problem_of
from fab4d.stages._forces import Held, force_report

CARD = load_material("paper-corrected", Path())
Arrays = dict[str, np.ndarray]


@pytest.fixture(scope="module")
def cantilever() -> Arrays:
    """60 x 10 x 8 mm, one tet thick, clamped at its left end, SMP below."""
    lines = [np.linspace(0, 60, 7), np.linspace(0, 10, 2), np.linspace(0, 8, 2)]
    i, j, k = np.meshgrid(*(np.arange(len(line)) for line in lines), indexing="ij")
    X = np.column_stack([lines[0][i.ravel()], lines[1][j.ravel()], lines[2][k.ravel()]])
    number = np.arange(len(X)).reshape(i.shape)
    corners = [number[:-1, :-1, :-1], number[1:, :-1, :-1], number[1:, 1:, :-1], number[1:, 1:, 1:]]
    corners += [number[:-1, 1:, :-1], number[:-1, 1:, 1:], number[:-1, :-1, 1:], number[1:, :-1, 1:]]
    paths = [(0, 1, 2, 3), (0, 2, 4, 3), (0, 4, 5, 3), (0, 5, 6, 3), (0, 6, 7, 3), (0, 7, 1, 3)]
    tets = np.concatenate([np.column_stack([corners[c].ravel() for c in path]) for path in paths])
    return {"X": X, "X_temp": X, "tets": tets, "clamp": X[:, 0] <= 0.0}


def tip_held(mesh: Arrays, element: str, times: int = 0) -> tuple[Held, Arrays]:
    """The mesh, refined some times, with its tip held half a mm up."""
    problem = problem_of(mesh, CARD, "linear")
    tip = int(np.argmax(mesh["X"] @ [1.0, 1e-3, 1e-3]))
    patches = build_patches(problem, np.array([tip]), 9.0 / problem.length)
    arrays = {"patch_center": patches.centers, "patch_faces": patches.faces, "patch_offsets": patches.offsets}
    low = mesh["X"][mesh["tets"]][:, :, 2].mean(axis=1) < 4.0
    rho = low.astype(np.float64)
    for _ in range(times):
        mesh, arrays = finer(mesh, arrays)
        rho = np.repeat(rho, 8)
    problem = problem_of(mesh, CARD, element)
    equilibria = Equilibria(problem, _forces.patches_of(problem, arrays))
    # A bar that bends without being stretched comes nearer by 0.6 times its rise squared over its length.
    held = equilibria.patches.mean(problem.body.X) + np.array([[-0.0025, 0.0, 0.5]]) / problem.length
    median = equilibria.solve_median(rho, held, problem.body.X, np.zeros((1, 3)), 1e-9, 40)
    assert median.solution.converged
    return Held(equilibria, rho, median.x, median.forces), arrays


def finer(mesh: Arrays, arrays: Arrays) -> tuple[Arrays, Arrays]:
    fine = refined(mesh["tets"], len(mesh["X"]))
    X = with_midpoints(mesh["X"], fine.edges)
    faces = refined_faces(arrays["patch_faces"], fine.edges, len(mesh["X"]))
    return (
        {"X": X, "X_temp": X, "tets": fine.tets, "clamp": X[:, 0] <= 0.0},
        arrays | {"patch_faces": faces, "patch_offsets": 4 * arrays["patch_offsets"]},
    )


@pytest.fixture(scope="module")
def true_force(cantilever: Arrays) -> float:
    """With quadratic tets on a mesh of 9,216: its own error is a fraction of a percent."""
    held, _ = tip_held(cantilever, "quadratic", 2)
    return newton(held)


def newton(held: Held) -> float:
    return float(np.linalg.norm(held.forces)) * held.equilibria.problem.force


@pytest.mark.parametrize(
    ("element", "most_refined", "method"),
    [
        ("quadratic", 200_000, "on a mesh refined 1:8"),
        ("quadratic", 0, "Richardson extrapolation from linear"),
        ("linear", 0, "Richardson extrapolation from quadratic"),
    ],
)
def test_uncertainty_covers_the_true_force(
    cantilever: Arrays,
    true_force: float,
    element: str,
    most_refined: int,
    method: str,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """One linear tet across makes the force several times too large; the estimates know that, without crying wolf."""
    monkeypatch.setattr(_forces, "MOST_REFINED_DOFS", most_refined)
    held, arrays = tip_held(cantilever, element)
    report = force_report(cantilever, CARD, arrays, held)
    found = report["force_uncertainty"]
    off = abs(newton(held) - true_force)
    assert method in found["method"]
    assert off <= found["N"][0]
    assert found["N"][0] <= 3 * off
    assert found["relative"][0] == pytest.approx(found["N"][0] / newton(held))
    assert report["left_out"] == []


def test_force_change_compares_both_elements_at_the_same_positions(cantilever: Arrays) -> None:
    linear, arrays = tip_held(cantilever, "linear")
    quadratic, _ = tip_held(cantilever, "quadratic")
    for held in (linear, quadratic):
        change = force_report(cantilever, CARD, arrays, held)["force_change"]
        assert change["linear_N"] == pytest.approx([newton(linear)], rel=1e-5)
        assert change["quadratic_N"] == pytest.approx([newton(quadratic)], rel=1e-5)
        # Directions change too.
        assert change["largest"] > newton(linear) / newton(quadratic) - 1
    assert newton(linear) > 2 * newton(quadratic)


def test_a_mesh_too_large_to_compare_is_left_out_and_that_is_said(
    cantilever: Arrays, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(_forces, "MOST_COMPARED_DOFS", 100)
    held, arrays = tip_held(cantilever, "linear")
    report = force_report(cantilever, CARD, arrays, held)
    assert report["force_change"] is None
    assert report["force_uncertainty"] is None
    dofs = _element.quadratic_dofs(cantilever)
    assert report["left_out"][0]["what"] == "uncertainty of the forces"
    assert f"{dofs} unknowns" in report["left_out"][0]["why"]


@pytest.mark.parametrize(
    ("wanted", "fine", "rounded", "most", "elements", "why"),
    [
        ("auto", 8.0, 10_000, 10_000, ("quadratic", "quadratic"), None),
        ("auto", 1.0, 10_000, 10_000, ("linear", "linear"), "1 linear ones span the thinnest walls"),
        ("auto", 8.0, 100, 10_000, ("linear", "quadratic"), "unknowns take too long (at most 100)"),
        ("auto", 8.0, 10, 100, ("linear", "linear"), "unknowns take too long (at most 100)"),
        ("linear", 8.0, 10_000, 10_000, ("linear", "linear"), "the scene asks for linear ones"),
        ("quadratic", 1.0, 10, 100, ("quadratic", "quadratic"), None),
    ],
)
def test_the_elements_of_rounding_and_last_fit(
    cantilever: Arrays,
    wanted: str,
    fine: float,
    rounded: int,
    most: int,
    elements: tuple[str, str],
    why: str | None,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    for name, value in (("FINE_ELEMENTS", fine), ("MOST_ROUNDED_DOFS", rounded), ("MOST_FITTED_DOFS", most)):
        monkeypatch.setattr(_element, name, value)
    found = _element.elements_for(cantilever, wanted)
    assert (found.rounding, found.last_fit) == elements
    assert (found.left_out == []) if why is None else (why in found.left_out[0]["why"])
