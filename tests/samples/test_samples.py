"""Every sample scene: what is committed is what the scripts make, and every pair of shapes is usable."""

import tomllib
from functools import cache
from pathlib import Path

import meshio
import numpy as np
import pytest
from shapes.catalogue import COMMITTED, SAMPLES
from shapes.scene import Sample, rounded, scene_text

from fab4d.mesh.measures import bounding_box_diagonal, deformation_gradients, tet_volumes
from fab4d.mesh.topology import component_labels, face_table

FOLDER = Path(__file__).parents[2] / "samples"
COUNTS = {
    "strip": (117, 240),
    "twist-bar": (768, 1705),
    "tower": (1592, 3066),
    "gripper": (1444, 4860),
    "fin": (1728, 6888),
    "smiley": (2919, 10506),
    "snake": (3025, 14400),
}
SIZES = {
    "strip": (84, 12, 8),
    "twist-bar": (55, 155, 5),
    "tower": (76, 76, 200),
    "snake": (192, 24, 24),
    "arm": (168, 14, 14),
    "plate": (100, 100, 4),
}
ABOUT = {"human": 5000, "arm": 2000, "hand": 6000, "flower": 9000, "key": 4000}


@cache
def sample(name: str) -> Sample:
    return SAMPLES[name]()


def in_clamp(made: Sample, margin: float = 0.0) -> np.ndarray:
    low, high = np.array(made.clamp)
    return np.all((low - margin <= made.X) & (high + margin >= made.X), axis=1)


def smallest_dihedral(X: np.ndarray, tets: np.ndarray) -> float:
    """Degrees, from the angle between the heights of the tet (the gradients of its barycentric coordinates)."""
    D = X[tets[:, 1:]] - X[tets[:, :1]]
    inner = np.swapaxes(np.linalg.inv(D), 1, 2)
    gradients = np.concatenate([-inner.sum(axis=1, keepdims=True), inner], axis=1)
    gradients /= np.linalg.norm(gradients, axis=2, keepdims=True)
    cosines = np.einsum("mik,mjk->mij", gradients, gradients)[:, *np.triu_indices(4, 1)]
    return float(np.degrees(np.pi - np.arccos(np.clip(cosines, -1, 1))).min())


def fans(boundary: np.ndarray) -> int:
    """Fans of boundary faces around vertices: as many as boundary vertices when the surface is a manifold."""
    corner = np.arange(boundary.size).reshape(-1, 3)
    u, v = (np.concatenate([boundary[:, i] for i in order]) for order in ([0, 1, 2], [1, 2, 0]))
    at_u, at_v = (np.concatenate([corner[:, i] for i in order]) for order in ([0, 1, 2], [1, 2, 0]))
    order = np.lexsort([np.maximum(u, v), np.minimum(u, v)]).reshape(-1, 2)
    flipped = u[order[:, 0]] != u[order[:, 1]]
    assert flipped.all()
    first, second = order.T
    pairs = np.vstack([np.column_stack([at_u[first], at_v[second]]), np.column_stack([at_v[first], at_u[second]])])
    return int(component_labels(boundary.size, pairs).max()) + 1


@pytest.mark.parametrize("name", COMMITTED)
def test_committed_files_are_what_the_scripts_make(name: str) -> None:
    made = sample(name)
    permanent, temporary = (meshio.read(FOLDER / name / file) for file in ("perm.vtu", "temp.vtu"))
    np.testing.assert_allclose(permanent.points, rounded(made.X), rtol=0, atol=2e-9)
    np.testing.assert_allclose(temporary.points, rounded(made.X_temp), rtol=0, atol=2e-9)
    for mesh in (permanent, temporary):
        assert mesh.points.dtype == np.float64
        np.testing.assert_array_equal(mesh.cells_dict["tetra"], made.tets)
    assert (FOLDER / name / "scene.toml").read_text(encoding="utf-8") == scene_text(name, made)


@pytest.mark.parametrize("name", COUNTS)
def test_vertex_and_tet_counts(name: str) -> None:
    assert (len(sample(name).X), len(sample(name).tets)) == COUNTS[name]


@pytest.mark.parametrize("name", SIZES)
def test_box_size(name: str) -> None:
    np.testing.assert_allclose(np.ptp(sample(name).X, axis=0), SIZES[name], rtol=0, atol=0.3)


@pytest.mark.parametrize("name", [f"{figure}{mesh}" for figure in ABOUT for mesh in ("", "-irregular")])
def test_tet_count_of_the_hard_scenes(name: str) -> None:
    assert len(sample(name).tets) == pytest.approx(ABOUT[name.removesuffix("-irregular")], rel=0.15)


@pytest.mark.parametrize("name", SAMPLES)
def test_permanent_shape_is_one_sound_body(name: str) -> None:
    made = sample(name)
    table = face_table(made.tets)
    assert tet_volumes(made.X, made.tets).min() > 1e-9 * bounding_box_diagonal(made.X) ** 3
    assert smallest_dihedral(made.X, made.tets) > 10.0
    assert component_labels(len(made.tets), table.interior_tets).max() == 0
    assert np.array_equal(np.unique(made.tets), np.arange(len(made.X)))
    assert 80.0 <= np.ptp(made.X, axis=0).max() <= 210.0


@pytest.mark.parametrize("name", SAMPLES)
def test_surface_is_a_manifold(name: str) -> None:
    boundary = face_table(sample(name).tets).boundary
    edges = np.sort(boundary[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    assert np.all(np.unique(edges, axis=0, return_counts=True)[1] == 2)
    assert fans(boundary) == len(np.unique(boundary))


@pytest.mark.parametrize("name", SAMPLES)
def test_temporary_shape_is_one_that_an_elastic_body_can_take(name: str) -> None:
    made = sample(name)
    F = deformation_gradients(made.X, made.X_temp, made.tets)
    volumes = tet_volumes(made.X, made.tets)
    assert np.linalg.det(F).min() > 0.3
    assert np.linalg.svd(F, compute_uv=False).max() < 1.8
    assert (volumes @ np.linalg.det(F)) / volumes.sum() == pytest.approx(1.0, abs=0.02)


@pytest.mark.parametrize("name", SAMPLES)
def test_clamp_holds_some_vertices_that_do_not_move_and_touches_no_other(name: str) -> None:
    made = sample(name)
    held = in_clamp(made)
    np.testing.assert_array_equal(rounded(made.X)[held], rounded(made.X_temp)[held])
    assert 12 <= held.sum() < 0.5 * len(made.X)
    assert np.linalg.matrix_rank(made.X[held] - made.X[held][0]) == 3
    np.testing.assert_array_equal(in_clamp(made, 5e-3), in_clamp(made, -5e-3))
    assert np.abs(made.X_temp - made.X).max() > 0.05 * bounding_box_diagonal(made.X)


def test_scene_tolerance_is_a_share_of_the_diagonal() -> None:
    made = sample("twist-bar")
    goal = tomllib.loads(scene_text("twist-bar", made))["goal"]
    assert goal["tolerance"] == pytest.approx(4e-3 * np.sqrt(55**2 + 155**2 + 5**2), rel=5e-3)
    assert goal["max_forces"] == 8
