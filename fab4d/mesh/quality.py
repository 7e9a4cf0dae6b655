"""Shape of tets, sides of faces, manifoldness of the boundary, and how much of a mesh is surface."""

import numpy as np
from scipy.spatial import cKDTree

from fab4d.mesh.measures import face_area_vectors
from fab4d.mesh.rows import odd_rows, row_ids
from fab4d.mesh.tetmesh import BoolArray, FloatArray, IntArray
from fab4d.mesh.topology import TET_EDGES, TET_FACES, component_labels

_FACE_EDGES = np.array([[0, 1], [1, 2], [2, 0]])


def min_dihedral_angles(X: FloatArray, tets: IntArray) -> FloatArray:
    """Smallest of the six dihedral angles of each tet, (m,), degrees; 0 where a face has no area."""
    normals = np.stack([face_area_vectors(X, tets[:, face]) for face in TET_FACES], axis=1)
    lengths = np.linalg.norm(normals, axis=2)
    safe = np.where(lengths > 0, lengths, 1.0)
    first, second = np.triu_indices(4, 1)
    dots = np.einsum("mkc,mkc->mk", normals[:, first], normals[:, second])
    cosines = -dots / (safe[:, first] * safe[:, second])
    angles = np.degrees(np.arccos(np.clip(cosines, -1.0, 1.0))).min(axis=1)
    smallest: FloatArray = np.where(lengths.min(axis=1) > 0, angles, 0.0)
    return smallest


def crowded_tets(tets: IntArray) -> IntArray:
    """Tets with a face that more than two tets share."""
    ids = row_ids(np.sort(tets[:, TET_FACES].reshape(-1, 3), axis=1))
    return np.flatnonzero((np.bincount(ids)[ids] > 2).reshape(-1, 4).any(axis=1))


def overlapping_tets(tets: IntArray) -> BoolArray:
    """Whether a tet (of tets (m, 4), all positive) lies on the same side of a face as its neighbour there."""
    faces = tets[:, TET_FACES].reshape(-1, 3)
    ids = row_ids(np.sort(faces, axis=1))
    turns = np.where(odd_rows(faces), 1, -1)
    # Two tets on the two sides of a face go round it in opposite directions.
    excess = np.abs(np.bincount(ids, turns)[ids]).reshape(-1, 4)
    overlapping: BoolArray = np.any(excess > 1, axis=1)
    return overlapping


def non_manifold_edges(faces: IntArray) -> IntArray:
    """Edges (k, 2) of a closed triangle mesh (b, 3) that have not exactly two faces."""
    ends = np.sort(faces[:, _FACE_EDGES].reshape(-1, 2), axis=1)
    ids = row_ids(ends)
    counts = np.bincount(ids)
    representative = np.unique(ids, return_index=True)[1]
    return ends[representative[counts != 2]]


def non_manifold_vertices(faces: IntArray) -> IntArray:
    """Vertices around which the triangles (b, 3) form more than one fan, apart from those on non-manifold edges."""
    edge_rows = faces[:, _FACE_EDGES].reshape(-1, 2)
    ids = row_ids(np.sort(edge_rows, axis=1))
    order = np.argsort(ids, kind="stable")
    paired = order[np.flatnonzero(np.bincount(ids)[ids[order]] == 2)].reshape(-1, 2)
    # Corner 3 f + c is the vertex c of face f; edge row 3 f + e runs from its corner e to its corner e + 1.
    start, end = paired, paired - paired % 3 + (paired % 3 + 1) % 3
    flat = faces.ravel()
    swapped = flat[start[:, 0]] != flat[start[:, 1]]
    other_start = np.where(swapped, end[:, 1], start[:, 1])
    other_end = np.where(swapped, start[:, 1], end[:, 1])
    links = np.concatenate([np.column_stack([start[:, 0], other_start]), np.column_stack([end[:, 0], other_end])])
    fans = np.unique(np.column_stack([flat, component_labels(len(flat), links)]), axis=0)
    vertices, n_fans = np.unique(fans[:, 0], return_counts=True)
    return np.setdiff1d(vertices[n_fans > 1], non_manifold_edges(faces))


def coincident_vertices(X: FloatArray, distance: float) -> IntArray:
    """Pairs (k, 2) of vertices nearer to each other than `distance`, mm."""
    pairs: IntArray = cKDTree(X).query_pairs(distance, output_type="ndarray")
    return pairs.astype(np.int64)


def vertex_components(n_vertices: int, tets: IntArray) -> IntArray:
    """Component number (n,) of each vertex; tets that share a vertex are one component."""
    return component_labels(n_vertices, tets[:, TET_EDGES[[0, 2, 3]]].reshape(-1, 2))


def side_curvature(points: FloatArray, tets: IntArray) -> FloatArray:
    """Largest distance (m,) of the mid-edge nodes of 10-node tets (m, 10) from the middles of their edges."""
    middles = points[tets[:, TET_EDGES]].mean(axis=2)
    return np.linalg.norm(points[tets[:, 4:]] - middles, axis=2).max(axis=1)


def largest_stretches(F: FloatArray) -> FloatArray:
    """Largest principal stretch (m,) of deformation gradients (m, 3, 3)."""
    return np.sqrt(np.linalg.eigvalsh(np.swapaxes(F, 1, 2) @ F)[:, -1])


def smallest_surface_stretches(X: FloatArray, x: FloatArray, faces: IntArray) -> FloatArray:
    """Smaller principal stretch (b,) of triangles (b, 3) in their plane, from vertices X to x (n, 3)."""
    before, after = (np.swapaxes(v[faces[:, 1:]] - v[faces[:, :1]], 1, 2) for v in (X, x))
    in_plane = after @ np.linalg.inv(np.linalg.qr(before, mode="r"))
    return np.linalg.svd(in_plane, compute_uv=False)[:, -1].astype(np.float64)
