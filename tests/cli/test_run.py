"""`fab4d run` from outside: a whole run of samples/strip, judged from its files alone by code that is not fab4d's."""

import csv
import json
import re
import shutil
import signal
import subprocess
import sys
import tomllib
from pathlib import Path
from typing import Any

import manifold3d
import meshio
import numpy as np
import pytest
import trimesh
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from fab4d import errors
from fab4d.runner.table import stage_table

ROOT = Path(__file__).parents[2]
STRIP = ROOT / "samples" / "strip"
GRID_MM = 2.0**-14
"""Coordinates are rounded to multiples of this."""
SAME_FILES = (
    "design.vtu",
    "print/smp.stl",
    "print/tpe.stl",
    "print/part.3mf",
    "rig/forces.csv",
    "rig/rig-sheet.pdf",
    "work/rounded.npz",
    "work/labels.npz",
    "work/state.npz",
)


def command(*arguments: object) -> list[str]:
    return [sys.executable, "-m", "fab4d", *(str(argument) for argument in arguments)]


def fab4d(*arguments: object) -> subprocess.CompletedProcess[str]:
    return subprocess.run(command(*arguments), capture_output=True, text=True, check=False)


@pytest.fixture(scope="module")
def strip(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The run folder of a finished run of samples/strip."""
    folder = tmp_path_factory.mktemp("strip") / "run"
    done = fab4d("run", STRIP, "--out", folder)
    assert done.returncode == 0, done.stdout + done.stderr
    assert done.stdout.startswith("ACCEPTED\n")
    return folder


@pytest.fixture(scope="module")
def report(strip: Path) -> dict[str, Any]:
    return json.loads((strip / "report.json").read_text())


@pytest.fixture(scope="module")
def design(strip: Path) -> meshio.Mesh:
    return meshio.read(strip / "design.vtu")


# -- report.json

NUMBERS = (
    "target_displacement_mm",
    "smp_fraction",
    "forces",
    "ambiguous_fraction",
    "isolated_fraction",
    "fixity",
    "undesired_deformation",
    "min_det_F",
    "element_order",
    "mass_g",
    "cost_usd",
    "tau_s",
    "wall_s",
    "peak_rss_mb",
)


def test_the_report_has_every_field_that_other_programs_read(report: dict[str, Any]) -> None:
    assert (report["verdict"], report["reasons"]) == ("ACCEPTED", [])
    kinds = [f"{kind}_{unit}" for kind in ("rms", "max", "hausdorff") for unit in ("mm", "rel")]
    assert sorted(report["error"]) == sorted(kinds)
    for name in NUMBERS:
        assert isinstance(report[name], (int, float)), name
    assert set(report["equilibrium_residual"]) == {"median", "final"}
    assert [stage["name"] for stage in report["stages"]] == list(stage_table().names[:-1])
    assert all(stage["wall_s"] > 0 and stage["tau"] > 0 for stage in report["stages"])
    assert {"fab4d", "numpy", "scipy", "numba"} <= set(report["versions"])
    assert all({"what", "why"} == set(item) for item in report["left_out"])


def test_the_report_keeps_what_the_scene_asks_for(report: dict[str, Any]) -> None:
    goal = tomllib.loads((STRIP / "scene.toml").read_text())["goal"]
    assert report["error"]["rms_mm"] <= goal["tolerance"]
    assert 0 < report["forces"] <= goal["max_forces"]
    assert 0 < report["smp_fraction"] < 1
    assert report["error"]["hausdorff_mm"] <= report["error"]["max_mm"]
    assert report["error"]["rms_mm"] <= report["error"]["max_mm"]


def test_the_report_tells_the_inputs_by_their_sha256(report: dict[str, Any]) -> None:
    told = "".join(f"{digest}  {name}\n" for name, digest in report["inputs"].items())
    assert set(report["inputs"]) == {"scene.toml", "perm.vtu", "temp.vtu"}
    checked = subprocess.run(["sha256sum", "-c"], input=told, text=True, cwd=STRIP, capture_output=True, check=False)
    assert checked.returncode == 0, checked.stdout


# -- the two equilibria of design.vtu, evaluated anew

EDGES = ((0, 1), (1, 2), (0, 2), (0, 3), (1, 3), (2, 3))


def shape_gradients(points: np.ndarray, cells: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Gradients (m, nq, nn, 3) of the shape functions and weights (m, nq) of linear or 10-node straight tets."""
    corners = points[cells[:, :4]]
    edges = np.swapaxes(corners[:, 1:] - corners[:, :1], 1, 2)
    inverse = np.linalg.inv(edges)
    barycentric = np.concatenate([-inverse.sum(axis=1, keepdims=True), inverse], axis=1)
    volumes = np.linalg.det(edges) / 6
    if cells.shape[1] == 4:
        return barycentric[:, None], volumes[:, None]
    a, b = (5 + 3 * 5**0.5) / 20, (5 - 5**0.5) / 20
    gradients = []
    for at in np.full((4, 4), b) + (a - b) * np.eye(4):
        corner = [(4 * at[i] - 1) * barycentric[:, i] for i in range(4)]
        middle = [4 * (at[i] * barycentric[:, j] + at[j] * barycentric[:, i]) for i, j in EDGES]
        gradients.append(np.stack(corner + middle, axis=1))
    return np.stack(gradients, axis=1), np.repeat(volumes[:, None] / 4, 4, axis=1)


def stress(F: np.ndarray, mu: np.ndarray, kappa: np.ndarray) -> np.ndarray:
    """P = mu J^(-2/3) (F - I1/3 F^-T) + kappa (J - 1) J F^-T, for F (m, nq, 3, 3) and moduli (m,)."""
    J = np.linalg.det(F)[..., None, None]
    G = np.swapaxes(np.linalg.inv(F), -1, -2)
    I1 = (F**2).sum(axis=(-1, -2))[..., None, None]
    mu, kappa = mu[:, None, None, None], kappa[:, None, None, None]
    return mu * J ** (-2 / 3) * (F - I1 / 3 * G) + kappa * (J - 1) * J * G


class Evaluated:
    """Nodal forces of both energies of model.md section 2 on the states of a design.vtu, in N."""

    def __init__(self, design: meshio.Mesh) -> None:
        self.cells = design.cells[0].data
        self.smp = design.cell_data["smp"][0].astype(float)
        self.dN, self.weights = shape_gradients(design.points, self.cells)
        card = tomllib.loads((ROOT / "profiles" / "materials" / "paper-corrected.toml").read_text())
        phases = {"tpe": card["tpe"], "rubbery": card["smp"]["rubbery"], "glassy": card["smp"]["glassy"]}
        self.moduli = {name: np.array([phase["mu_MPa"], phase["kappa_MPa"]]) for name, phase in phases.items()}
        self.F_x = self.gradients(design.point_data["median"])
        self.F_y = self.gradients(design.point_data["temporary"])
        self.n = len(design.points)

    def gradients(self, x: np.ndarray) -> np.ndarray:
        return np.einsum("mai,mqaj->mqij", x[self.cells], self.dN)

    def nodal(self, P: np.ndarray) -> np.ndarray:
        per_element = np.einsum("mq,mqij,mqaj->mai", self.weights, P, self.dN)
        forces = np.zeros((self.n, 3))
        np.add.at(forces, self.cells, per_element)
        return forces

    def median(self) -> np.ndarray:
        mu, kappa = np.outer(self.smp, self.moduli["rubbery"]).T + np.outer(1 - self.smp, self.moduli["tpe"]).T
        return self.nodal(stress(self.F_x, mu, kappa))

    def final(self) -> np.ndarray:
        A = np.linalg.inv(self.F_x)
        frozen = stress(self.F_y @ A, *np.outer(self.smp, self.moduli["glassy"]).T) @ np.swapaxes(A, -1, -2)
        elastic = stress(self.F_y, *np.outer(1 - self.smp, self.moduli["tpe"]).T)
        return self.nodal(frozen + elastic)


def largest(forces: np.ndarray) -> float:
    return float(np.linalg.norm(forces, axis=1).max())


@pytest.fixture(scope="module")
def evaluated(design: meshio.Mesh) -> Evaluated:
    return Evaluated(design)


def point_forces(design: meshio.Mesh) -> np.ndarray:
    """(K, 3) resultants of the nodal forces of each patch."""
    held, force = design.point_data["held"], design.point_data["force"]
    return np.array([force[held == k].sum(axis=0) for k in range(held.max() + 1)])


def test_the_median_shape_needs_the_forces_that_are_told_and_nothing_else(
    design: meshio.Mesh, evaluated: Evaluated
) -> None:
    rest = evaluated.median() - design.point_data["force"]
    rest[design.point_data["clamp"] == 1] = 0.0
    assert largest(rest) <= 1e-8 * largest(point_forces(design))


def test_the_forces_and_the_clamp_balance(design: meshio.Mesh, evaluated: Evaluated) -> None:
    """Forces and moments of points and clamp: without this the part would fly away or turn in the rig."""
    clamp, x = design.point_data["clamp"] == 1, design.point_data["median"]
    loads = design.point_data["force"].copy()
    loads[clamp] += evaluated.median()[clamp]
    scale = largest(point_forces(design))
    assert np.abs(loads.sum(axis=0)).max() <= 1e-7 * scale
    assert np.abs(np.cross(x, loads).sum(axis=0)).max() <= 1e-7 * scale * np.ptp(x)


def test_the_final_shape_is_free_of_force(design: meshio.Mesh, evaluated: Evaluated) -> None:
    assert largest(evaluated.final()) <= 1e-8 * largest(point_forces(design))


def test_the_evaluation_can_fail(design: meshio.Mesh) -> None:
    """A thousandth of a millimetre, one label, or a force of half the size is seen."""
    scale = largest(point_forces(design))
    moved = design.copy()
    moved.point_data["temporary"] = design.point_data["temporary"].copy()
    moved.point_data["temporary"][7] += 1e-3
    assert largest(Evaluated(moved).final()) > 1e-6 * scale
    flipped = design.copy()
    smp = design.cell_data["smp"][0].copy()
    smp[np.argmax(smp)] = 0
    flipped.cell_data["smp"] = [smp]
    assert largest(Evaluated(flipped).median() - Evaluated(design).median()) > 1e-6 * scale


def test_no_element_is_inverted(evaluated: Evaluated, report: dict[str, Any]) -> None:
    smallest = min(np.linalg.det(evaluated.F_x).min(), np.linalg.det(evaluated.F_y).min())
    assert smallest > 0
    assert report["min_det_F"] == pytest.approx(smallest, rel=1e-9)


def test_forces_act_on_held_points_outside_the_clamp_alone(design: meshio.Mesh) -> None:
    data = design.point_data
    loaded = np.any(data["force"] != 0, axis=1)
    np.testing.assert_array_equal(loaded, data["held"] >= 0)
    assert not (loaded & (data["clamp"] == 1)).any()
    np.testing.assert_array_equal(data["median"][data["clamp"] == 1], design.points[data["clamp"] == 1])


def test_labels_are_decided_and_clusters_are_of_smp(design: meshio.Mesh, report: dict[str, Any]) -> None:
    smp, cluster, rho = (design.cell_data[name][0] for name in ("smp", "cluster", "rho"))
    assert set(np.unique(smp)) == {0, 1}
    np.testing.assert_array_equal(cluster > 0, smp == 1)
    assert rho.min() >= 0
    assert rho.max() <= 1
    volumes = shape_gradients(design.points, design.cells[0].data)[1].sum(axis=1)
    assert report["smp_fraction"] == pytest.approx(volumes[smp == 1].sum() / volumes.sum(), rel=1e-12)


# -- the error, from the scene's own files


def boundary(tets: np.ndarray) -> np.ndarray:
    faces = np.sort(tets[:, [[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]]].reshape(-1, 3), axis=1)
    unique, counts = np.unique(faces, axis=0, return_counts=True)
    return unique[counts == 1]


def test_the_error_is_that_of_the_final_shape_to_the_scenes_temporary_one(
    design: meshio.Mesh, report: dict[str, Any]
) -> None:
    permanent, temporary = meshio.read(STRIP / "perm.vtu"), meshio.read(STRIP / "temp.vtu")
    n = len(permanent.points)
    distance, same = cKDTree(design.points[:n]).query(permanent.points)
    assert distance.max() < GRID_MM
    assert len(set(same)) == n
    y = design.point_data["temporary"][same]
    faces = boundary(permanent.cells_dict["tetra"])
    a, b, c = np.moveaxis(permanent.points[faces], 1, 0)
    areas = np.bincount(faces.ravel(), np.repeat(np.linalg.norm(np.cross(b - a, c - a), axis=1) / 6, 3), minlength=n)
    weights = areas / areas.sum()
    centers = weights @ temporary.points, weights @ y
    turn, _ = Rotation.align_vectors(temporary.points - centers[0], y - centers[1], weights=weights)
    squared = ((turn.apply(y - centers[1]) - temporary.points + centers[0]) ** 2).sum(axis=1)
    assert report["error"]["rms_mm"] == pytest.approx(np.sqrt(weights @ squared), abs=GRID_MM)
    assert report["error"]["max_mm"] == pytest.approx(np.sqrt(squared[np.unique(faces)].max()), abs=2 * GRID_MM)
    diagonal = np.linalg.norm(np.ptp(permanent.points, axis=0))
    assert report["error"]["rms_rel"] == pytest.approx(report["error"]["rms_mm"] / diagonal, rel=1e-6)


def test_the_curve_of_error_ends_at_the_error_of_the_report(strip: Path, report: dict[str, Any]) -> None:
    rows = list(csv.DictReader((strip / "error-vs-time.csv").read_text().splitlines()))
    for kind in ("rms_mm", "max_mm", "hausdorff_mm"):
        assert float(rows[-1][kind]) == pytest.approx(report["error"][kind], abs=1e-6)
    assert float(rows[-1]["smp_fraction"]) == pytest.approx(report["smp_fraction"], rel=1e-9)
    assert int(rows[-1]["forces"]) == report["forces"]
    times = [float(row["wall_s"]) for row in rows]
    assert times == sorted(times)
    assert times[-1] <= report["wall_s"]


# -- what is printed and what is set up


def test_the_bodies_are_solids_that_fill_the_part(strip: Path, design: meshio.Mesh, report: dict[str, Any]) -> None:
    bodies = {name: trimesh.load_mesh(strip / "print" / f"{name}.stl") for name in ("smp", "tpe")}
    volumes = shape_gradients(design.points, design.cells[0].data)[1].sum(axis=1)
    solids = {}
    for name, body in bodies.items():
        assert body.is_volume, name
        mesh = manifold3d.Mesh64(np.asarray(body.vertices, np.float64), np.asarray(body.faces, np.uint64))
        solids[name] = manifold3d.Manifold(mesh)
        assert solids[name].status() == manifold3d.Error.NoError
        assert solids[name].volume() == pytest.approx(body.volume, rel=1e-9)
    assert sum(body.volume for body in bodies.values()) == pytest.approx(volumes.sum(), rel=1e-6)
    assert bodies["smp"].volume == pytest.approx(volumes[design.cell_data["smp"][0] == 1].sum(), rel=1e-3)
    assert (solids["smp"] ^ solids["tpe"]).volume() < 1e-6 * volumes.sum()
    # Both polymers of the card weigh 1.2 g/cm^3.
    assert report["mass_g"] == pytest.approx(1.2e-3 * volumes.sum(), rel=1e-6)


def test_the_force_table_is_that_of_the_design(strip: Path, design: meshio.Mesh) -> None:
    rows = list(csv.DictReader((strip / "rig" / "forces.csv").read_text().splitlines()))
    forces, held = point_forces(design), design.point_data["held"]
    assert len(rows) == len(forces)
    for k, row in enumerate(rows):
        told = {name: np.array([float(row[f"{name}_{a}"]) for a in axes]) for name, axes in vectors().items()}
        assert int(row["point"]) == k + 1
        np.testing.assert_allclose(told["force"], forces[k], rtol=1e-9)
        size = np.linalg.norm(forces[k])
        assert float(row["force_N"]) == pytest.approx(size, rel=1e-9)
        assert float(row["force_kgf"]) == pytest.approx(size / 9.80665, rel=1e-9)
        np.testing.assert_allclose(told["direction"], forces[k] / size, atol=1e-9)
        # A force is spread as its point's mean position is taken: the shares of the force are the weights.
        on = held == k
        share = design.point_data["force"][on] @ forces[k] / size**2
        np.testing.assert_allclose(told["position"], share @ design.points[on], atol=1e-9)
        np.testing.assert_allclose(told["hold"], share @ design.point_data["median"][on], atol=1e-9)


def vectors() -> dict[str, tuple[str, ...]]:
    mm, newton = ("x_mm", "y_mm", "z_mm"), ("x_N", "y_N", "z_N")
    return {"position": mm, "hold": mm, "force": newton, "direction": ("x", "y", "z")}


def test_the_rig_sheet_is_a_pdf_and_the_page_stands_alone(strip: Path) -> None:
    assert (strip / "rig" / "rig-sheet.pdf").read_bytes().startswith(b"%PDF-")
    page = (strip / "report.html").read_text()
    assert "ACCEPTED" in page
    assert not re.search(r"(src|href)=[\"']https?:", page)


# -- going on after a kill


def killed_at(line: str, out: Path, with_signal: signal.Signals = signal.SIGKILL) -> int:
    """Start a run, send it a signal as soon as it shows a line that begins with `line`; its exit code."""
    process = subprocess.Popen(
        command("run", STRIP, "--out", out), stderr=subprocess.PIPE, text=True, preexec_fn=_heed_interrupts
    )
    assert process.stderr is not None
    with process, process.stderr:
        for shown in process.stderr:
            if " ".join(shown.split()).startswith(line):
                process.send_signal(with_signal)
                process.stderr.read()
                return process.wait()
    msg = f"the run never showed {line!r}"
    raise AssertionError(msg)


def _heed_interrupts() -> None:
    """Shells start what they put in the background deaf to SIGINT, and processes inherit that: so would the run."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)


def bytes_of(folder: Path) -> dict[str, bytes]:
    return {name: (folder / name).read_bytes() for name in SAME_FILES}


INSIDE = {"solve": ["solve relax", "solve round"], "refit": ["refit refit"]}
"""Phases in which a stage is killed too."""


def test_a_run_that_is_killed_in_every_stage_ends_with_the_same_bytes(strip: Path, tmp_path: Path) -> None:
    out = tmp_path / "run"
    for stage in stage_table().names:
        for place in [f"{stage} runs:", *INSIDE.get(stage, [])]:
            assert killed_at(place, out) == -signal.SIGKILL
            assert not (out / "work" / "manifests" / f"{stage}.json").exists()
            assert not (out / "report.json").exists()
    done = fab4d("run", STRIP, "--out", out)
    assert done.returncode == 0, done.stderr
    assert [line.split()[1] for line in done.stderr.splitlines() if "runs:" in line or "current" in line] == [
        *["current"] * (len(stage_table().names) - 1),
        "runs:",
    ]
    ours, theirs = bytes_of(out), bytes_of(strip)
    assert [name for name in SAME_FILES if ours[name] != theirs[name]] == []
    assert not list(out.rglob("*.writing"))


def test_a_stopped_run_says_how_to_go_on(tmp_path: Path) -> None:
    out = tmp_path / "run"
    assert killed_at("solve runs:", out, signal.SIGINT) == errors.InterruptedRunError.exit_code
    assert (out / "work" / "manifests" / "check.json").exists()


# -- exit codes of the real thing


def scene_like_strip(folder: Path, **changes: str) -> Path:
    """A copy of samples/strip with the texts `changes` replaced in its scene."""
    shutil.copytree(STRIP, folder)
    text = (folder / "scene.toml").read_text()
    for old, new in changes.items():
        line = next(line for line in text.splitlines() if line.startswith(old))
        text = text.replace(line, new)
    (folder / "scene.toml").write_text(text)
    return folder


def test_a_design_that_misses_the_goal_is_delivered_rejected(strip: Path, tmp_path: Path) -> None:
    scene, out = scene_like_strip(tmp_path / "strip", tolerance="tolerance = 0.001"), tmp_path / "run"
    shutil.copytree(strip, out)
    done = fab4d("run", scene, "--from", "report", "--out", out)
    assert done.returncode == errors.DesignRejectedError.exit_code, done.stderr
    assert done.stdout.startswith("REJECTED\n  - RMS error is ")
    rejected = json.loads((out / "report.json").read_text())
    assert rejected["verdict"] == "REJECTED"
    assert "allowed is at most 0.001 mm" in rejected["reasons"][0]
    assert "REJECTED" in (out / "report.html").read_text()


@pytest.mark.parametrize(
    ("changes", "error"),
    [
        ({"tolerance": "tolerence = 1"}, errors.SceneError),
        ({"temporary": 'temporary = "nowhere.vtu"'}, errors.MeshError),
        ({"units": 'units = "m"'}, errors.MeshError),
        ({"box": "box = [[500, 0, 0], [501, 1, 1]]"}, errors.SceneError),
    ],
    ids=["unknown key", "missing file", "wrong units", "clamp beside the part"],
)
def test_what_is_wrong_with_a_scene_ends_with_its_own_code(
    tmp_path: Path, changes: dict[str, str], error: type[errors.Fab4dError]
) -> None:
    done = fab4d("run", scene_like_strip(tmp_path / "strip", **changes), "--out", tmp_path / "run")
    assert done.returncode == error.exit_code
    assert "fab4d: " in done.stderr
    assert "Traceback" not in done.stderr


# -- units


def written(path: Path, points: np.ndarray, mesh: meshio.Mesh) -> None:
    meshio.write(path, meshio.Mesh(points, mesh.cells))


def test_the_same_part_in_metres_is_the_same_design(strip: Path, tmp_path: Path, report: dict[str, Any]) -> None:
    scene = scene_like_strip(
        tmp_path / "strip",
        units='units = "m"',
        box="box = [[-0.001, -0.001, -0.001], [0.008, 0.013, 0.009]]",
        tolerance="tolerance = 0.000426",
    )
    for name in ("perm.vtu", "temp.vtu"):
        mesh = meshio.read(STRIP / name)
        written(scene / name, mesh.points / 1000, mesh)
    out = tmp_path / "run"
    assert fab4d("run", scene, "--out", out).returncode == 0
    metres, mm = meshio.read(out / "design.vtu"), meshio.read(strip / "design.vtu")
    np.testing.assert_array_equal(metres.cell_data["smp"][0], mm.cell_data["smp"][0])
    np.testing.assert_array_equal(metres.points, mm.points)
    diagonal = np.linalg.norm(np.ptp(mm.points, axis=0))
    for name in ("median", "temporary"):
        np.testing.assert_allclose(metres.point_data[name], mm.point_data[name], atol=1e-9 * diagonal)
    np.testing.assert_allclose(
        metres.point_data["force"], mm.point_data["force"], atol=1e-9 * largest(point_forces(mm))
    )
    told = json.loads((out / "report.json").read_text())
    assert told["error"] == pytest.approx(report["error"], rel=1e-9)


# -- nothing to program


@pytest.mark.parametrize("turned", [False, True], ids=["equal shapes", "turned shape"])
@pytest.mark.parametrize("clamped", [True, False], ids=["clamp", "no clamp"])
def test_nothing_to_program_is_one_body_of_tpe(tmp_path: Path, turned: bool, clamped: bool) -> None:
    scene = scene_like_strip(tmp_path / "strip")
    if not clamped:
        text = (scene / "scene.toml").read_text()
        (scene / "scene.toml").write_text(re.sub(r"\[\[rig\.clamp\]\]\nbox.*\n", "", text))
    mesh = meshio.read(STRIP / "perm.vtu")
    points = mesh.points
    if turned:
        points = Rotation.from_rotvec([0.4, -0.2, 1.0]).apply(points) + np.array([5, 7, -3])
    written(scene / "temp.vtu", points, mesh)
    out = tmp_path / "run"
    done = fab4d("run", scene, "--out", out)
    assert done.returncode == 0, done.stderr
    files = {str(path.relative_to(out)) for path in out.rglob("*") if "work" not in path.parts and path.is_file()}
    assert "print/tpe.stl" in files
    assert not files & {"print/smp.stl", "rig/rig-sheet.pdf", "rig/forces.csv"}
    report = json.loads((out / "report.json").read_text())
    assert (report["verdict"], report["forces"], report["smp_fraction"]) == ("ACCEPTED", 0, 0.0)
    assert report["error"]["max_mm"] < 2 * GRID_MM
    left_out = " ".join(item["what"] + ": " + item["why"] for item in report["left_out"])
    assert "rig sheet" in left_out
    assert "moved rigidly" in left_out
    design = meshio.read(out / "design.vtu")
    assert not design.cell_data["smp"][0].any()
    assert not design.point_data["force"].any()
    np.testing.assert_allclose(design.point_data["median"], design.points, atol=1e-9)
    body = trimesh.load_mesh(out / "print" / "tpe.stl")
    assert body.is_volume
    volumes = shape_gradients(design.points, design.cells[0].data)[1]
    assert body.volume == pytest.approx(volumes.sum(), rel=1e-6)
