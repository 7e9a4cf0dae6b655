"""Coarser meshes of the same body, and where points are in a mesh."""

from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from shapes.boxes import box

from fab4d.mesh import coarsening
from fab4d.mesh.coarsening import coarsened, nearest_tets
from fab4d.mesh.measures import face_area_vectors, tet_volumes
from fab4d.mesh.quality import non_manifold_edges, non_manifold_vertices
from fab4d.mesh.topology import face_table, unique_edges

Mesh = tuple[np.ndarray, np.ndarray]


def block() -> Mesh:
    return box((6.0, 4.0, 4.0), (18, 12, 12), "six")


def plate() -> Mesh:
    """One tet thick: nothing may be collapsed across it."""
    return box((12.0, 8.0, 0.3), (36, 24, 1), "six")


def frame() -> Mesh:
    """A square with a square hole through it."""
    X, tets = box((9.0, 9.0, 3.0), (18, 18, 6), "six")
    middle = X[tets].mean(axis=1)
    kept = tets[(np.abs(middle[:, :2] - 4.5) > 1.5).any(axis=1)]
    vertices, numbers = np.unique(kept, return_inverse=True)
    return X[vertices], numbers.reshape(-1, 4)


def sphere() -> Mesh:
    """A cube's vertices pushed out onto a ball."""
    X, tets = box((2.0, 2.0, 2.0), (10, 10, 10), "five")
    X = X - 1.0
    lengths = np.linalg.norm(X, axis=1, keepdims=True)
    return X * np.abs(X).max(axis=1, keepdims=True) / np.where(lengths > 0, lengths, 1.0), tets


def bent(X: np.ndarray) -> np.ndarray:
    return X + 0.02 * np.column_stack([X[:, 1] ** 2, X[:, 0] * X[:, 1], -(X[:, 0] ** 2)])


def euler_characteristic(tets: np.ndarray) -> int:
    table = face_table(tets)
    n_faces = len(table.boundary) + len(table.interior)
    return len(np.unique(tets)) - len(unique_edges(tets)[0]) + n_faces - len(tets)


@pytest.mark.parametrize("body", [block, plate, frame])
def test_a_coarser_mesh_fills_the_same_body(body: Callable[[], Mesh]) -> None:
    """Flat faces and sharp edges stay where they are, holes stay open, and no tet turns over in either shape."""
    X, tets = body()
    clamp = X[:, 0] <= X[:, 0].min() + 1e-9
    coarse = coarsened(X, bent(X), tets, clamp, len(tets) // 6)
    assert len(coarse.tets) < 0.4 * len(tets)
    Y = X[coarse.vertices]
    assert tet_volumes(Y, coarse.tets).min() > 0
    assert tet_volumes(bent(X)[coarse.vertices], coarse.tets).min() > 0
    assert tet_volumes(Y, coarse.tets).sum() == pytest.approx(tet_volumes(X, tets).sum(), rel=1e-12)
    faces = face_table(coarse.tets).boundary
    assert not len(non_manifold_edges(faces))
    assert not len(non_manifold_vertices(faces))
    assert euler_characteristic(coarse.tets) == euler_characteristic(tets)
    fixed, held = clamp[coarse.vertices], np.isin(face_table(tets).boundary, np.flatnonzero(clamp)).all(axis=1)
    areas = np.linalg.norm(face_area_vectors(X, face_table(tets).boundary), axis=1)
    coarse_areas = np.linalg.norm(face_area_vectors(Y, faces), axis=1)
    assert coarse_areas[fixed[faces].all(axis=1)].sum() == pytest.approx(areas[held].sum())


def test_a_curved_surface_stays_near() -> None:
    X, tets = sphere()
    coarse = coarsened(X, X, tets, np.zeros(len(X), bool), len(tets) // 8)
    assert len(coarse.tets) < 0.4 * len(tets)
    assert tet_volumes(X[coarse.vertices], coarse.tets).sum() == pytest.approx(tet_volumes(X, tets).sum(), rel=0.05)


@pytest.mark.parametrize("body", [block, plate, frame])
def test_the_topology_is_kept_whatever_the_shape_becomes(
    body: Callable[[], Mesh], monkeypatch: pytest.MonkeyPatch
) -> None:
    """As few tets as can be, flat ones and any surface allowed: walls are not pinched and holes not closed."""
    monkeypatch.setattr(coarsening, "LONGEST_EDGE", np.inf)
    monkeypatch.setattr(coarsening, "LARGEST_DISTANCE", np.inf)
    monkeypatch.setattr(coarsening, "LEAST_COSINE", -1.0)
    monkeypatch.setattr(coarsening, "QUALITIES", ((0.0, 0.0),))
    X, tets = body()
    coarse = coarsened(X, X, tets, np.zeros(len(X), bool), 1)
    assert len(coarse.tets) < 0.1 * len(tets)
    faces = face_table(coarse.tets).boundary
    assert not len(non_manifold_edges(faces))
    assert not len(non_manifold_vertices(faces))
    assert euler_characteristic(coarse.tets) == euler_characteristic(tets)


def test_no_tet_turns_over_in_the_other_shape() -> None:
    """Twisted so far that a tet of the wanted size would."""
    X, tets = block()
    angle = 0.9 * X[:, 0]
    y, z = X[:, 1] - 2.0, X[:, 2] - 2.0
    twisted = np.column_stack([X[:, 0], y * np.cos(angle) - z * np.sin(angle), y * np.sin(angle) + z * np.cos(angle)])
    coarse = coarsened(X, twisted, tets, np.zeros(len(X), bool), len(tets) // 30)
    assert len(coarse.tets) < 0.5 * len(tets)
    assert tet_volumes(twisted[coarse.vertices], coarse.tets).min() > 0


def test_clamped_vertices_are_merged_with_clamped_ones_only() -> None:
    """So one with free neighbours alone stays."""
    X, tets = block()
    lone = (np.abs(X % 2.0) < 1e-9).all(axis=1)
    coarse = coarsened(X, X, tets, lone, len(tets) // 8)
    assert np.isin(np.flatnonzero(lone), coarse.vertices).all()


def test_a_mesh_that_is_small_enough_is_left_alone() -> None:
    X, tets = block()
    coarse = coarsened(X, X, tets, np.zeros(len(X), bool), len(tets))
    np.testing.assert_array_equal(coarse.vertices[coarse.tets], tets)


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 2**32 - 1), st.floats(0.1, 0.9))
def test_coarser_random_meshes_stay_valid(seed: int, share: float) -> None:
    """Wherever inner vertices are, no tet turns over, the surface of the box is kept and none of it is lost."""
    rng = np.random.default_rng(seed)
    X, tets = box((1.0, 1.0, 1.0), (5, 5, 5), "six")
    inside = ((X > 1e-9) & (X < 1 - 1e-9)).all(axis=1)
    X = X + 0.04 * inside[:, None] * rng.uniform(-1, 1, X.shape)
    coarse = coarsened(X, X, tets, rng.random(len(X)) < 0.2, int(share * len(tets)))
    volumes = tet_volumes(X[coarse.vertices], coarse.tets)
    assert volumes.min() > 0
    assert volumes.sum() == pytest.approx(1.0, rel=1e-12)
    assert euler_characteristic(coarse.tets) == 1


def test_a_point_is_found_in_the_tet_around_it() -> None:
    X, tets = block()
    X = bent(X)
    inner = np.random.default_rng(0).dirichlet(np.ones(4), len(tets))
    np.testing.assert_array_equal(nearest_tets(X, tets, np.einsum("mk,mki->mi", inner, X[tets])), np.arange(len(tets)))


def test_a_point_outside_has_the_tet_next_to_it() -> None:
    X, tets = frame()
    on_surface, outside = (np.random.default_rng(0).uniform(0, 9, (50, 3)) * [1.0, 0.0, 0.3] for _ in range(2))
    outside[:, 1] = -0.1
    found = X[tets[nearest_tets(X, tets, outside)]]
    assert (found[:, :, 1].min(axis=1) == 0.0).all()
    assert (np.abs(found.mean(axis=1) - on_surface).max(axis=1) < 1.0).all()
