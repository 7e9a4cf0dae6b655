"""Every refusal, repair and warning of the mesh doctor, on meshes made hostile on purpose."""

from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from fab4d.elasticity.neo_hooke import energy_density
from fab4d.errors import MeshError, SceneError
from fab4d.io.cards import RigCard, load_material, load_printer, load_rig
from fab4d.io.meshes import RawMesh, read_mesh
from fab4d.io.scene import ClampRegion, Goal, load_scene
from fab4d.materials.cards import MaterialCard
from fab4d.mesh.distance import shape_error
from fab4d.mesh.grid import FINEST_STEP, snapped
from fab4d.mesh.measures import deformation_gradients, tet_volumes, vertex_areas
from fab4d.mesh.topology import face_table
from fab4d.stages.check import run
from fab4d.stages.monitor import SilentMonitor

CASES = Path(__file__).parents[3] / "shared" / "cases"
# Six tets around the diagonal of a cell, all positive.
CORNERS = np.array([[0, 1, 3, 7], [0, 3, 2, 7], [0, 2, 6, 7], [0, 6, 4, 7], [0, 4, 5, 7], [0, 5, 1, 7]])
LEFT = (ClampRegion(box=((-1, -1, -1), (0.5, 99, 99))),)
Arrays = dict[str, np.ndarray]


def grid(*cells: int, size: float = 5.0) -> tuple[np.ndarray, np.ndarray]:
    """A box of cubes with 6 tets each, mm."""
    shape = np.array(cells) + 1
    numbers = np.arange(shape.prod()).reshape(*shape)
    corner = [
        numbers[i : i + cells[0], j : j + cells[1], k : k + cells[2]].ravel()
        for k in (0, 1)
        for j in (0, 1)
        for i in (0, 1)
    ]
    points = size * np.stack(np.meshgrid(*(np.arange(n) for n in shape), indexing="ij"), axis=-1).reshape(-1, 3)
    return points.astype(float), np.stack(corner, axis=1)[:, CORNERS].reshape(-1, 4)


def bent(points: np.ndarray) -> np.ndarray:
    """The points bent by half a radian per 30 mm about the y axis."""
    angle, radius = points[:, 0] / 60, 60 + points[:, 2]
    return np.column_stack([radius * np.sin(angle), points[:, 1], radius * np.cos(angle) - 60])


X, TETS = grid(6, 2, 2)
Y = bent(X)


def raw(points: np.ndarray, tets: np.ndarray = TETS, file: str = "perm.vtu", **sets: np.ndarray) -> RawMesh:
    return RawMesh(points, tets, sets, file)


def check(
    permanent: RawMesh,
    temporary: RawMesh,
    clamp: tuple[ClampRegion, ...] = LEFT,
    units: str = "mm",
    material: str = "paper-corrected",
    tolerance: float | None = None,
    materials: MaterialCard | None = None,
    max_forces: int | None = None,
    rig: RigCard | None = None,
) -> tuple[Arrays, dict[str, Any]]:
    profile = {
        "units": units,
        "clamp": clamp,
        "printer": load_printer("generic-dual-0.4", Path()),
        "materials": materials or load_material(material, Path()),
        "goal": Goal(tolerance, max_forces),
        "rig": rig or load_rig("bench", Path()),
        "gravity": None,
    }
    result = run({"permanent": permanent, "temporary": temporary}, profile, SilentMonitor())
    return result["mesh"], result["check_report"]


def check_points(x: np.ndarray, y: np.ndarray, tets: np.ndarray = TETS, **more: Any) -> tuple[Arrays, dict[str, Any]]:
    return check(raw(x, tets), raw(y, tets, "temp.vtu"), **more)


def codes(report: dict[str, Any]) -> dict[str, dict[str, Any]]:
    return {finding["code"]: finding for finding in report["findings"]}


def test_a_sound_pair_passes_without_findings() -> None:
    mesh, report = check_points(X, Y)
    assert report["findings"] == []
    assert not report["nothing_to_program"]
    np.testing.assert_array_equal(mesh["X"], X)
    np.testing.assert_allclose(mesh["X_temp"], Y, rtol=0, atol=FINEST_STEP)
    np.testing.assert_array_equal(mesh["X_temp"], snapped(Y))
    np.testing.assert_array_equal(np.flatnonzero(mesh["clamp"]), np.flatnonzero(X[:, 0] == 0))
    np.testing.assert_array_equal(mesh["vertex_map"], np.arange(len(X)))
    assert report["statistics"]["interior_vertices"] == 5
    assert report["statistics"]["volume_mm3"] == pytest.approx(30 * 10 * 10)


@pytest.mark.parametrize(("units", "mm"), [("m", 1000.0), ("cm", 10.0), ("in", 25.4)])
def test_any_unit_gives_the_same_mesh(units: str, mm: float) -> None:
    expected, _ = check_points(X, Y)
    mesh, _ = check_points(X / mm, Y / mm, units=units)
    for name in ("X", "X_temp"):
        np.testing.assert_allclose(mesh[name], expected[name], rtol=1e-12, atol=1e-12 * 30)
    for name in ("tets", "clamp", "vertex_map", "tet_map"):
        np.testing.assert_array_equal(mesh[name], expected[name])


# 1. Each file.


def test_vertex_numbers_out_of_range_are_refused() -> None:
    tets = TETS.copy()
    tets[17, 2] = 9999
    with pytest.raises(MeshError, match=r"temp\.vtu: tet 17 use.* outside 0\.\.62"):
        check(raw(X), raw(Y, tets, "temp.vtu"))


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_points_that_are_not_finite_are_refused(value: float) -> None:
    x = X.copy()
    x[7, 1] = value
    with pytest.raises(MeshError, match=r"perm\.vtu: vertex 7 .* not finite"):
        check_points(x, Y)


# 2. Units.


def test_metres_called_millimetres_are_refused_with_the_likely_unit() -> None:
    with pytest.raises(MeshError, match=r"longest side is 0\.03 mm .*likely m\)"):
        check_points(X / 1000, Y / 1000)


def test_millimetres_called_metres_are_refused_with_the_likely_unit() -> None:
    with pytest.raises(MeshError, match=r"longest side is 3e\+04 mm .*likely mm or cm\)"):
        check_points(X, Y, units="m")


def test_two_files_in_different_units_are_refused() -> None:
    with pytest.raises(MeshError, match=r"temp\.vtu: its diagonal is 0\.001\d* times .*units"):
        check_points(X, Y / 1000)


def test_a_part_larger_than_the_printer_is_refused() -> None:
    with pytest.raises(MeshError, match=r"450 x 150 x 150 mm do not fit into the 300 x 300 x 300 mm .*generic-dual"):
        check_points(15 * X, 15 * Y)


# 3. Compatibility.


def test_other_vertex_counts_are_refused() -> None:
    with pytest.raises(MeshError, match=r"temp\.vtu: 64 vertices, but perm\.vtu has 63"):
        check(raw(X), raw(np.vstack([Y, Y[:1]]), file="temp.vtu"))


def test_other_connectivity_is_refused_with_the_tet() -> None:
    # The cells cut along another diagonal, but for one tet: the numbers of tets at the vertices differ.
    swapped = np.arange(len(X)).reshape(7, 3, 3)[:, ::-1].ravel()
    other = np.vstack([swapped[TETS[:, [0, 1, 3, 2]]][:-1], TETS[-1:]])
    with pytest.raises(MeshError, match=r"144 and 144 tets, of which \d+ .*tet \d+ of perm\.vtu with vertices \["):
        check(raw(X), raw(Y, other, "temp.vtu"))
    with pytest.raises(MeshError, match=r"tet 5 of perm\.vtu .* is not in temp\.vtu"):
        check(raw(X), raw(Y, np.delete(TETS, 5, axis=0), "temp.vtu"))


def test_renumbered_vertices_are_recognised() -> None:
    number = np.random.default_rng(0).permutation(len(X))
    y = np.zeros_like(Y)
    y[number] = Y
    with pytest.raises(MeshError, match=r"temp\.vtu: .*renumbered by the exporter"):
        check(raw(X), raw(y, number[TETS], "temp.vtu"))


def test_an_odd_permutation_is_refused_and_named() -> None:
    tets = TETS.copy()
    tets[9] = tets[9, [1, 0, 2, 3]]
    with pytest.raises(MeshError, match=r"temp\.vtu: 1 tets .*tet 9.*odd permutation"):
        check(raw(X), raw(Y, tets, "temp.vtu"))


def test_row_order_and_even_permutations_do_not_matter() -> None:
    rng = np.random.default_rng(1)
    tets = rng.permutation(TETS)
    tets[::2] = tets[::2][:, [1, 2, 0, 3]]
    mesh, report = check(raw(X), raw(Y, tets, "temp.vtu"))
    assert report["findings"] == []
    np.testing.assert_array_equal(mesh["tets"], TETS)


# 4. Cleaning.


def test_unused_vertices_are_left_out_of_everything() -> None:
    far = np.array([[1e7, 0, 0], [np.nan, 0, 0]])
    stray = np.vstack([far, X]), np.vstack([far, Y])
    mesh, report = check_points(*stray, tets=TETS + 2)
    assert codes(report)["unreferenced-vertex"]["indices"] == [0, 1]
    assert codes(report)["unreferenced-vertex"]["severity"] == "repaired"
    np.testing.assert_array_equal(mesh["vertex_map"], np.arange(2, len(X) + 2))
    np.testing.assert_array_equal(mesh["X"], X)
    np.testing.assert_array_equal(mesh["tets"], TETS)


def test_duplicate_tets_and_repeated_vertices_are_left_out() -> None:
    tets = np.vstack([TETS[:3], [[4, 4, 5, 6]], TETS[3:], TETS[8:9][:, [2, 0, 1, 3]]])
    mesh, report = check_points(X, Y, tets)
    assert codes(report)["repeated-vertex"]["indices"] == [3]
    assert codes(report)["duplicate-tet"]["indices"] == [len(tets) - 1]
    np.testing.assert_array_equal(mesh["tets"], TETS)
    np.testing.assert_array_equal(tets[mesh["tet_map"]], TETS)


def test_tets_of_repeated_vertices_alone_are_refused() -> None:
    with pytest.raises(MeshError, match="no tet has four different vertices"):
        check_points(X, Y, np.array([[0, 0, 9, 1]]))


def with_mid_nodes(points: np.ndarray, sag: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    from fab4d.mesh.quadratic import quadratic_tets, with_midpoints

    tets, edges = quadratic_tets(TETS, len(X))
    nodes = with_midpoints(points, edges)
    nodes[len(X)] += sag
    return nodes, tets


def test_ten_node_tets_give_their_corners_and_curved_sides_are_told() -> None:
    (x, tets), (y, _) = with_mid_nodes(X), with_mid_nodes(Y)
    mesh, report = check_points(x, y, tets)
    assert report["findings"] == []
    np.testing.assert_array_equal(mesh["tets"], TETS)
    _, report = check_points(x, with_mid_nodes(Y, 0.3)[0], tets)
    curved = codes(report)["curved-sides"]
    assert curved["severity"] == "warning"
    assert curved["file"] == "temp.vtu"
    assert "0.52 mm" in curved["message"]


# 5. Orientation.


def test_left_handed_tets_are_turned_round() -> None:
    tets = TETS.copy()
    tets[[4, 40]] = tets[[4, 40]][:, [0, 2, 1, 3]]
    mesh, report = check_points(X, Y, tets)
    assert codes(report)["left-handed"]["indices"] == [4, 40]
    assert tet_volumes(mesh["X"], mesh["tets"]).min() > 0
    mesh, report = check_points(X, Y, TETS[:, [0, 2, 1, 3]])
    assert codes(report)["left-handed"]["count"] == len(TETS)
    assert tet_volumes(mesh["X"], mesh["tets"]).min() > 0


@pytest.mark.parametrize("exporter_turned_them", [False, True])
def test_a_folded_permanent_shape_is_refused(exporter_turned_them: bool) -> None:
    inner = int(np.flatnonzero(np.all(X == [15, 5, 5], axis=1))[0])
    x = X.copy()
    x[inner] += [12, 0, 0]
    negative = tet_volumes(x, TETS) < 0
    assert negative.any()
    tets = np.where((negative & exporter_turned_them)[:, None], TETS[:, [0, 1, 3, 2]], TETS)
    with pytest.raises(MeshError, match=r"perm\.vtu: tets \d+, .* folded .*volume"):
        check_points(x, Y, tets)


def test_a_face_of_three_tets_is_refused() -> None:
    x = np.vstack([X, [[15, 5, 40]]])
    inside = face_table(TETS)
    tets = np.vstack([TETS, [[*inside.interior[40], len(X)]]])
    first, second = inside.interior_tets[40]
    with pytest.raises(MeshError, match=rf"more than two tets share a face \(tets {first}, {second}, 144\)"):
        check_points(x, bent(x), tets)


# 6. Tets.


def test_zero_volume_is_refused() -> None:
    x = X.copy()
    x[X[:, 2] == 0, 2] = 5
    with pytest.raises(MeshError, match=r"perm\.vtu: 72 tets have no volume .*tet 0 with vertices"):
        check_points(x, Y)


def flattened(height: float) -> np.ndarray:
    x = X.copy()
    x[X[:, 2] == 0, 2] = 5 - height
    return x


def test_flat_tets_are_refused_and_thin_ones_told() -> None:
    with pytest.raises(MeshError, match=r"tets are flat .*dihedral angle 0\.0\d+ degrees"):
        check_points(flattened(0.003), bent(flattened(0.003)))
    _, report = check_points(flattened(0.3), bent(flattened(0.3)))
    assert codes(report)["thin-tet"]["severity"] == "warning"
    assert codes(report)["thin-tet"]["count"] > 10


# 7. Deformation.


@pytest.mark.parametrize("mirror", [[-1, 1, 1], [1, 1, -1]])
def test_a_mirror_image_is_recognised(mirror: list[int]) -> None:
    with pytest.raises(MeshError, match=r"temp\.vtu: the mirror image of perm\.vtu"):
        check_points(X, Y * mirror)


SURFACE = np.unique(face_table(TETS).boundary)
CENTRES = np.flatnonzero(np.all(X[:, 1:] == 5, axis=1) & (X[:, 0] > 0) & (X[:, 0] < 30))


def test_a_sound_target_is_not_projected() -> None:
    mesh, report = check_points(X, Y)
    assert report["target_projection"] is None
    assert "projection of the temporary shape" in {entry["what"] for entry in report["left_out"]}
    assert "X_wanted" not in mesh


@pytest.mark.parametrize("seed", [0, 1])
def test_the_inside_of_the_temporary_shape_does_not_matter(seed: int) -> None:
    """Only its surface is wanted: whatever is inside, the elastic body inside that surface is taken."""
    one, other = Y.copy(), Y.copy()
    one[CENTRES[2]] += [12, 0, 0]
    other[CENTRES] = np.random.default_rng(seed).uniform(-100, 100, (len(CENTRES), 3))
    for y in (one, other):
        assert np.linalg.det(deformation_gradients(X, y, TETS)).min() < 0
    (first, report), (second, _) = check_points(X, one), check_points(X, other)
    np.testing.assert_allclose(first["X_temp"], second["X_temp"], rtol=0, atol=1e-9)
    np.testing.assert_array_equal(first["X_temp"][SURFACE], snapped(Y)[SURFACE])
    assert np.linalg.det(deformation_gradients(X, first["X_temp"], TETS)).min() > 0.5
    assert codes(report)["inside"]["severity"] == "repaired"
    assert report["target_projection"]["rms_mm"] == 0.0
    assert "X_wanted" not in first


@pytest.mark.parametrize(
    ("pinch", "first"), [(6.0, "target: inside, at most"), (12.0, "target: inverted tets, attempt 1 of")]
)
def test_each_attempt_at_a_target_that_takes_long_is_told(
    monkeypatch: pytest.MonkeyPatch, pinch: float, first: str
) -> None:
    told: list[str] = []
    monkeypatch.setattr(SilentMonitor, "progress", lambda _, phase, **__: told.append(phase))
    pinched = Y.copy()
    pinched[SURFACE[np.argmax(Y[SURFACE, 0])], 0] -= pinch
    check_points(X, pinched, tolerance=5.0)
    attempts = told[told.index("target") + 1 : told.index("outlook")]
    assert attempts[0].startswith(first)
    assert attempts[-1].startswith("target: surface, 36 vertices free")


def test_a_clamp_that_reaches_inside_is_told_by_its_surface() -> None:
    y = bent(np.maximum(X - [5, 0, 0], 0)) + np.minimum(X, [5, 0, 0]) * [1, 0, 0]
    wild = y.copy()
    wild[CENTRES] += np.random.default_rng(6).normal(size=(len(CENTRES), 3)) * 9
    mesh, report = check_points(X, wild, clamp=(ClampRegion(box=((-1, -1, -1), (5, 99, 99))),))
    assert set(codes(report)) == {"inside"}
    assert mesh["clamp"][CENTRES].any()
    np.testing.assert_array_equal(mesh["X_temp"][mesh["clamp"]], X[mesh["clamp"]])
    np.testing.assert_array_equal(mesh["X_temp"][SURFACE], snapped(y)[SURFACE])


def test_the_inside_is_where_the_elastic_energy_is_least() -> None:
    y = Y.copy()
    y[CENTRES] += 40
    mesh, _ = check_points(X, y)
    card = load_material("paper-corrected", Path()).tpe
    rng = np.random.default_rng(2)

    def energy(x: np.ndarray) -> float:
        volumes = tet_volumes(X, TETS)
        return float(volumes @ energy_density(deformation_gradients(X, x, TETS), card.mu, card.kappa))

    least = energy(mesh["X_temp"])
    for _ in range(5):
        moved = mesh["X_temp"].copy()
        moved[CENTRES] += 0.02 * rng.standard_normal((len(CENTRES), 3))
        assert energy(moved) > least


def spiked(depth: float) -> np.ndarray:
    """Y with the middle vertex of its upper side pulled down by `depth` mm: beyond 5 mm tets are inverted."""
    y = Y.copy()
    y[np.all(X == [15, 5, 10], axis=1), 2] -= depth
    return y


@pytest.mark.parametrize("depth", [10.3, 30.0, -25.0])
def test_a_spike_of_the_surface_is_projected_and_the_cost_told(depth: float) -> None:
    y = spiked(depth)
    mesh, report = check_points(X, y, tolerance=8.0)
    told = report["target_projection"]
    F = deformation_gradients(X, mesh["X_temp"], TETS)
    assert np.linalg.det(F).min() >= 0.1 - 1e-4
    assert np.linalg.svd(F, compute_uv=False).max() <= 3.0 + 1e-4
    np.testing.assert_array_equal(mesh["X_wanted"][SURFACE], snapped(y)[SURFACE])
    np.testing.assert_array_equal(mesh["X_temp"][mesh["clamp"]], X[mesh["clamp"]])
    assert codes(report)["projected"]["severity"] == "repaired"
    moved = np.linalg.norm(mesh["X_temp"] - y, axis=1)
    assert told["max_mm"] == pytest.approx(moved[SURFACE].max(), abs=1e-3)
    assert X[told["moved_most"][0]["vertex"]].tolist() == [15, 5, 10]
    assert told["max_mm"] < 1.1 * abs(depth)
    areas = vertex_areas(X, face_table(TETS).boundary)
    rms = shape_error(mesh["X_temp"], y, face_table(TETS).boundary, areas).rms
    assert told["rms_mm"] == pytest.approx(rms, rel=1e-3)


def test_the_projection_is_as_near_as_the_bounds_allow() -> None:
    """A bar stretched too far by its last cells alone: the nearest shape stretches these as far as it may."""
    y = X.copy()
    y[X[:, 0] == 30, 0] = 25 + 5 * 3.2
    mesh, report = check_points(X, y, tolerance=2.0)
    tip = mesh["X_temp"][X[:, 0] == 30, 0].mean()
    assert 25 + 5 * 3.0 * 0.93 < tip < 25 + 5 * 3.15
    assert report["target_projection"]["max_mm"] < 1.5


def test_a_projection_that_costs_more_than_the_tolerance_is_refused() -> None:
    with pytest.raises(MeshError, match=r"temp\.vtu: .* mm RMS .* at vertices \d+, .* tolerance is 0\.166 mm"):
        check_points(X, spiked(30.0))


def test_a_clamp_moved_within_the_temporary_shape_is_put_right() -> None:
    """By half a millimetre and two degrees: the shape is taken relative to the clamp, whose own shape is kept."""
    turn = Rotation.from_euler("xyz", [2, -1, 1], degrees=True)
    y = Y.copy()
    held = X[:, 0] == 0
    y[held] = turn.apply(y[held] - [0, 5, 5]) + np.array([0.3, 5.4, 5])
    y[held, 1] *= 1.001
    mesh, report = check_points(X, y)
    np.testing.assert_array_equal(mesh["X_temp"][held], X[held])
    assert codes(report)["moved"]["severity"] == "repaired"
    assert "the clamp region differs by up to 0.00" in report["target_projection"]["why"][0]
    assert 0 < report["target_projection"]["max_mm"] < 0.02
    # As asked for, up to the rigid motion that brings the clamp home.
    faces = face_table(TETS).boundary
    assert shape_error(mesh["X_wanted"], y, faces, vertex_areas(X, faces)).max < 1e-3


def test_what_cannot_be_mended_is_refused_with_the_tets() -> None:
    y = Y[np.random.default_rng(3).permutation(len(Y))]
    with pytest.raises(MeshError, match=r"temp\.vtu: \d+ tets are (inverted|squeezed) .*\(tets|mirror"):
        check_points(X, y)


@pytest.mark.parametrize(
    ("factors", "message"),
    [
        ([4, 1, 1], r"144 tets are stretched beyond the 3 .*up to 4\), most of the part .*; 6\d% of the deformation"),
        ([1, 1, 0.05], r"144 tets are squeezed to less than 0\.1 .*det F from 0\.05\)"),
    ],
)
def test_a_deformation_that_no_solid_follows_is_refused_with_what_limits_it(factors: list[float], message: str) -> None:
    with pytest.raises(MeshError, match=message):
        check_points(X, X * factors, clamp=())


def test_a_stretch_that_one_material_does_not_bear_is_told() -> None:
    soft = replace(load_material("paper-corrected", Path()), tpe_max_stretch=1.2)
    _, report = check_points(X, X * [1.5, 1, 1], clamp=(), materials=soft)
    assert {"stretch-tpe", "suggested-clamp"} == codes(report).keys()


@pytest.mark.parametrize(("squeezed", "told"), [(0.53, True), (0.55, False)])
def test_a_surface_that_creases_is_told(squeezed: float, told: bool) -> None:
    """A block squeezed along x: its two ends keep their shape, all other faces are squeezed."""
    _, report = check_points(X, X * [squeezed, 1.3, 1], clamp=())
    assert ("creased-surface" in codes(report)) == told
    if told:
        size = np.ptp(X, axis=0)
        ends = size[1] * size[2]
        share = 1 - ends / (ends + size[0] * size[1] + size[0] * size[2])
        message = codes(report)["creased-surface"]["message"]
        assert f"{share:.1%} of the surface" in message
        assert "down to 0.53" in message


def test_a_few_squeezed_faces_are_not_worth_telling(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("fab4d.stages.check.CREASED_SHARE", 0.99)
    _, report = check_points(X, X * [0.5, 1.3, 1], clamp=())
    assert "creased-surface" not in codes(report)


def test_a_doubtful_material_is_told() -> None:
    _, report = check_points(X, Y, material="paper-printed")
    assert "Poisson ratio of glassy is -0.03" in codes(report)["material"]["message"]


# 8. Rigid motion.


@pytest.mark.parametrize("offset", [0.0, 4e6])
def test_a_rigid_motion_is_nothing_to_program(offset: float) -> None:
    c, s = np.cos(1), np.sin(1)
    moved = X @ np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]).T + [3, 2, 1] + offset
    _, report = check_points(X, moved)
    assert report["nothing_to_program"]
    assert report["statistics"]["target_max_mm"] < 1e-6
    assert any("rig sheet" in entry["what"] for entry in report["left_out"])


def test_geo_referenced_coordinates_work() -> None:
    x = X + np.array([4e6, 5e5, 100.0])
    mesh, report = check_points(x, Y, clamp=(ClampRegion(vertices=tuple(range(9))),))
    assert set(codes(report)) == {"moved"}
    np.testing.assert_array_equal(mesh["X"], x)


def test_a_moved_temporary_shape_comes_back_to_the_clamp() -> None:
    """The rig holds the clamp where the permanent shape has it: the wanted shape is told relative to it."""
    turn = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    expected, _ = check_points(X, Y)
    mesh, report = check_points(X, Y @ turn.T + [5, -70, 3])
    assert codes(report)["moved"]["severity"] == "repaired"
    np.testing.assert_allclose(mesh["X_temp"], expected["X_temp"], rtol=0, atol=2 * FINEST_STEP)
    np.testing.assert_allclose(mesh["X_temp"][mesh["clamp"]], X[mesh["clamp"]], rtol=0, atol=2 * FINEST_STEP)


def test_without_a_clamp_a_moved_temporary_shape_stays_where_it_is() -> None:
    mesh, report = check_points(X, Y + 10, clamp=())
    assert "moved" not in codes(report)
    np.testing.assert_array_equal(mesh["X_temp"], snapped(Y + 10))


def test_a_clamp_that_would_have_to_deform_is_told() -> None:
    _, report = check_points(X, X * [1, 1.5, 1], tolerance=1.0)
    assert codes(report)["clamp-deforms"]["severity"] == "warning"


# What is foreseen.


def comb(bends: list[float]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A plate of 10 x 60 mm with three arms of 40 mm along x, each bent upwards by its angle (degrees) from the plate
    on: X, X_temp, tets."""
    x, tets = grid(10, 12, 1, size=5.0)
    centre = x[tets].mean(axis=1)
    kept = (centre[:, 0] < 10) | (np.mod(centre[:, 1], 25) < 10)
    used, tets = np.unique(tets[kept], return_inverse=True)
    x = x[used]
    degrees = np.array(bends)[np.minimum(x[:, 1] // 25, 2).astype(int)]
    rate, along = np.maximum(np.radians(np.abs(degrees)), 1e-9) / 40, np.maximum(x[:, 0] - 10, 0)
    arm = 1 / rate - x[:, 2]
    y = np.column_stack(
        [np.minimum(x[:, 0], 10) + arm * np.sin(rate * along), x[:, 1], 1 / rate - arm * np.cos(rate * along)]
    )
    return x, np.where((degrees > 0)[:, None], y, x), tets.reshape(-1, 4)


PLATE = (ClampRegion(box=((-1, -1, -1), (5, 99, 99))),)


@pytest.mark.parametrize(("bends", "points", "enough"), [([60, 60, 60], 3, True), ([60, 60, 60], 2, False)])
def test_each_limb_that_bends_needs_a_point(bends: list[float], points: int, enough: bool) -> None:
    x, y, tets = comb(bends)
    _, report = check_points(x, y, tets, clamp=PLATE, max_forces=points)
    assert ("too-few-points" not in codes(report)) == enough
    assert report["fewest_points"] == 3
    if not enough:
        assert "3 limbs change their own shape" in codes(report)["too-few-points"]["message"]
        assert codes(report)["too-few-points"]["severity"] == "warning"


def test_limbs_that_keep_their_shape_need_no_point() -> None:
    x, y, tets = comb([60, 0, 0])
    _, report = check_points(x, y, tets, clamp=PLATE, max_forces=1)
    assert "too-few-points" not in codes(report)


def test_a_motion_beyond_the_travel_of_the_rig_is_told() -> None:
    x, y, tets = comb([60, 0, 0])
    short = replace(load_rig("bench", Path()), max_travel=10.0)
    _, report = check_points(x, y, tets, clamp=PLATE, rig=short)
    assert "farther than the 10 mm" in codes(report)["travel"]["message"]
    assert np.linalg.norm((y - x)[codes(report)["travel"]["indices"]], axis=1).min() > 10
    _, report = check_points(x, y, tets, clamp=PLATE, rig=replace(short, max_travel=99.0))
    assert "travel" not in codes(report)


@pytest.mark.parametrize(("units", "mm"), [("mm", 1.0), ("m", 1000.0)])
def test_a_clamp_is_suggested_where_the_part_moves_as_one(units: str, mm: float) -> None:
    x, y, tets = comb([60, 60, 60])
    _, report = check_points(x / mm, y / mm, tets, clamp=(), units=units)
    low, high = np.array(report["suggested_clamp"]["box"])
    np.testing.assert_allclose([low[0], high[0]], [0, 10 / mm], atol=1e-3 / mm)
    assert f"box = {report['suggested_clamp']['box']}" in codes(report)["suggested-clamp"]["message"]
    # It is a clamp of a scene, and a good one.
    box = tuple(tuple(float(v) * mm for v in corner) for corner in (low, high))
    mesh, report = check_points(x, y, tets, clamp=(ClampRegion(box=box),))
    assert codes(report).keys() <= {"one-tet-thick", "moved"}
    assert mesh["clamp"].sum() == np.count_nonzero(x[:, 0] <= 10)
    assert report["statistics"]["clamp_deformation_mm"] < 1e-3


def test_no_clamp_is_suggested_where_there_is_one_or_nothing_moves_as_one() -> None:
    _, report = check_points(X, Y)
    assert report["suggested_clamp"] is None
    wavy = Y + 0.3 * np.random.default_rng(8).normal(size=X.shape)
    _, report = check_points(X, wavy, clamp=())
    assert report["suggested_clamp"] is None
    assert "suggested-clamp" not in codes(report)


# 9. Boundary, components, clamp.


def two_pieces(gap: float = 2.0) -> tuple[np.ndarray, np.ndarray]:
    points = np.vstack([X, X + np.array([30 + gap, 0, 0])])
    return points, np.vstack([TETS, TETS + len(X)])


@pytest.mark.parametrize("gap", [2.0, 0.0])
@pytest.mark.parametrize("clamp", [(), (*LEFT, ClampRegion(box=((59, -1, -1), (63, 99, 99))))])
def test_a_part_in_pieces_is_refused_however_it_is_held(gap: float, clamp: tuple[ClampRegion, ...]) -> None:
    x, tets = two_pieces(gap)
    with pytest.raises(MeshError, match=r"in 2 pieces that share no face, the smallest \(3e\+03 mm\^3\)"):
        check_points(x, bent(x), tets, clamp=clamp)


def test_one_piece_needs_no_clamp() -> None:
    mesh, report = check_points(X, Y, clamp=())
    assert not mesh["clamp"].any()
    assert "clamp" in {entry["what"] for entry in report["left_out"]}


def test_unmerged_vertices_are_told() -> None:
    """A slit halfway through the part."""
    slit = np.flatnonzero((X[:, 0] == 15) & (X[:, 1] == 0))
    copies = np.arange(len(X))
    copies[slit] = len(X) + np.arange(len(slit))
    beyond = X[TETS].mean(axis=1)[:, 0] > 15
    x, tets = np.vstack([X, X[slit]]), np.where(beyond[:, None], copies[TETS], TETS)
    _, report = check_points(x, bent(x), tets)
    assert codes(report)["coincident-vertices"]["count"] == len(slit)


def test_a_surface_that_touches_itself_is_refused_along_edges_and_told_at_vertices() -> None:
    x, tets = grid(2, 2, 1)
    cell = np.arange(len(tets)) // 6
    along_edge = tets[np.isin(cell, [0, 3])]
    with pytest.raises(MeshError, match=r"touches itself along 1 edges \(vertices \d+ and \d+\)"):
        check_points(x, bent(x), along_edge, clamp=())
    x, tets = grid(3, 2, 3)
    ring = [(0, 0, 1), (0, 0, 0), (1, 0, 0), (2, 0, 0), (2, 0, 1), (2, 0, 2), (2, 1, 2), (1, 1, 2)]
    at_vertex = tets[np.isin(np.arange(len(tets)) // 6, np.ravel_multi_index(np.transpose(ring), (3, 2, 3)))]
    _, report = check_points(x, bent(x), at_vertex, clamp=())
    (vertex,) = codes(report)["non-manifold-vertex"]["indices"]
    assert x[vertex].tolist() == [5, 5, 10]


def curled(radius: float, degrees: float) -> np.ndarray:
    """A bar of 30 mm as an arc in the x-z plane; its first cells stay."""
    x, _ = grid(12, 2, 2, size=2.5)
    angle = np.radians(degrees) * x[:, 0] / 30
    arm = radius + x[:, 2]
    return np.column_stack([arm * np.sin(angle), x[:, 1], arm * np.cos(angle) - radius])


def test_a_temporary_shape_that_passes_through_itself_is_told() -> None:
    x, tets = grid(12, 2, 2, size=2.5)
    _, report = check_points(x, curled(5, 330), tets)
    assert "self-intersection" not in codes(report)
    _, report = check_points(x, curled(5, 400), tets)
    found = codes(report)["self-intersection"]
    assert (found["severity"], found["file"]) == ("warning", "temp.vtu")
    # Its last cells are in its first ones.
    assert x[found["indices"], 0].min() < 6


def test_a_permanent_shape_that_passes_through_itself_is_refused() -> None:
    _, tets = grid(12, 2, 2, size=2.5)
    with pytest.raises(MeshError, match=r"perm\.vtu: the surface passes through itself .*vertices \[.* mm\)"):
        check_points(curled(5, 400), curled(5, 330), tets)


def test_a_part_one_tet_thick_is_told() -> None:
    x, tets = grid(6, 2, 1)
    _, report = check_points(x, bent(x), tets)
    assert codes(report).keys() == {"one-tet-thick"}


@pytest.mark.parametrize(
    ("region", "message"),
    [
        (ClampRegion(box=((40, 0, 0), (50, 1, 1))), r"1 catches no vertex .* box is \[40, 50\] .* part's \[0, 30\]"),
        (ClampRegion(box=((-1, -1, -1), (99, 99, 99))), "holds all 63 vertices"),
        (ClampRegion(vertices=(0, 63)), r"vertex 63 is not in perm\.vtu, whose vertices are 0\.\.62"),
        (ClampRegion(set_name="foot"), r'no vertex set "foot"; it has: base, none'),
        (ClampRegion(set_name="none"), "catches no vertex"),
    ],
)
def test_a_clamp_that_catches_nothing_or_everything_is_refused(region: ClampRegion, message: str) -> None:
    permanent = raw(X, base=np.arange(9), none=np.arange(0))
    with pytest.raises(SceneError, match=message):
        check(permanent, raw(Y, file="temp.vtu"), clamp=(region,))


def test_clamps_by_number_and_by_set_hold_the_vertices_of_the_file() -> None:
    x, y = np.vstack([X[:1] + 99, X]), np.vstack([Y[:1], Y])
    permanent = raw(x, TETS + 1, base=np.arange(4, 7))
    mesh, _ = check(
        permanent, raw(y, TETS + 1, "temp.vtu"), (ClampRegion(vertices=(1, 2)), ClampRegion(set_name="base"))
    )
    np.testing.assert_array_equal(mesh["vertex_map"][mesh["clamp"]], [1, 2, 4, 5, 6])


def test_a_box_whose_face_misses_vertices_by_rounding_catches_them() -> None:
    almost = ClampRegion(box=((1e-12, 0, 0), (5 - 1e-12, 10, 10)))
    mesh, _ = check_points(X, Y, clamp=(almost,))
    np.testing.assert_array_equal(mesh["clamp"], X[:, 0] <= 5)


def test_a_clamp_on_one_line_is_refused() -> None:
    with pytest.raises(MeshError, match=r"only vertices 0, 1, 2, on one line"):
        check_points(X, Y, clamp=(ClampRegion(vertices=(0, 1, 2)),))


# Real meshes, and many tets.


@pytest.mark.skipif(not CASES.is_dir(), reason="the shared cases are not beside this checkout")
@pytest.mark.parametrize("case", ["dino_bend50k", "eiffel_bend", "human_pose", "lattice_twist", "spot_bend190k"])
def test_the_shared_cases_import(case: str) -> None:
    scene = load_scene(CASES / case)
    mesh, report = check(read_mesh(scene.permanent), read_mesh(scene.temporary), scene.clamp, scene.units)
    assert {finding["severity"] for finding in report["findings"]} <= {"warning"}
    assert report["statistics"]["min_det_F"] > 0.4
    assert report["statistics"]["clamp_deformation_mm"] < 1e-9
    assert 0 < mesh["clamp"].sum() < len(mesh["X"])
    assert mesh["X"].max() > 10


def test_many_tets_are_checked_in_seconds() -> None:
    from time import process_time

    x, tets = grid(46, 26, 26, size=1.0)
    assert len(tets) > 186_000
    start = process_time()
    _, report = check_points(x, bent(x), tets)
    assert process_time() - start < 20
    assert report["findings"] == []


def test_the_order_of_checks_starts_with_the_files() -> None:
    """Of several faults the first check's is told: a user mends units before shapes."""
    faults = [
        (replace(raw(X), points=np.where(np.arange(63)[:, None] == 5, np.nan, X)), "not finite"),
        (raw(X / 1e6), "longest side"),
        (raw(X[:, [1, 0, 2]], np.delete(TETS, 0, axis=0)), "only in"),
    ]
    for (mesh, message), _ in pairwise([*faults, faults[0]]):
        with pytest.raises(MeshError, match=message):
            check(mesh, raw(Y, TETS[:, [1, 0, 2, 3]], "temp.vtu"))
