"""Uniform refinement: each tet in eight, all new vertices at the middles of edges."""

from dataclasses import dataclass

import numpy as np

from fab4d.mesh.tetmesh import FloatArray, IntArray
from fab4d.mesh.topology import TET_EDGES, unique_edges

# Corners of the eight children among the ten nodes of a quadratic tet (VTK order): four at the corners, and the
# octahedron between them cut along the diagonal of nodes 5 and 7. Source: Bey, Computing 55 (1995) 355.
CHILDREN = np.array(
    [
        [0, 4, 6, 7],
        [4, 1, 5, 8],
        [6, 5, 2, 9],
        [7, 8, 9, 3],
        [4, 5, 6, 7],
        [4, 8, 5, 7],
        [5, 8, 9, 7],
        [6, 5, 9, 7],
    ]
)


@dataclass(frozen=True, eq=False)
class Refinement:
    """tets (8 m, 4): the children of a tet one after another; edges (e, 2), whose middles are vertices n.. n + e."""

    tets: IntArray
    edges: IntArray


def refined(tets: IntArray, n_vertices: int) -> Refinement:
    """Each of the tets (m, 4) in eight."""
    edges, tet_edges = unique_edges(tets)
    nodes = np.hstack([tets, n_vertices + tet_edges])
    return Refinement(nodes[:, CHILDREN].reshape(-1, 4), edges)


def refined_faces(faces: IntArray, edges: IntArray, n_vertices: int) -> IntArray:
    """Each of the triangles (f, 3) in four (4 f, 3), its corners' ones first; `edges` as in Refinement."""
    key = edges[:, 0] * n_vertices + edges[:, 1]
    ends = np.sort(faces[:, [[0, 1], [1, 2], [2, 0]]], axis=2)
    middle = n_vertices + np.searchsorted(key, ends[..., 0] * n_vertices + ends[..., 1])
    (a, b, c), (ab, bc, ca) = faces.T, middle.T
    children = [(a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca)]
    return np.stack([np.column_stack(child) for child in children], axis=1).reshape(-1, 3)


def on_children(elements: IntArray, values: FloatArray, children: IntArray, n_nodes: int) -> FloatArray:
    """A quadratic field at the nodes of the refined quadratic mesh.

    elements : (m, 10) and values : (N, ...) of the coarse mesh        children : (8 m, 10) of the fine one, n_nodes its
    number of nodes. Exact: the children are part of their parents.
    """
    fine = np.zeros((n_nodes, *values.shape[1:]))
    shapes = _shapes(_child_nodes())
    fine[children.reshape(len(elements), 80)] = np.einsum("ca,ma...->mc...", shapes, values[elements])
    return fine


def _child_nodes() -> FloatArray:
    """(80, 4) barycentric coordinates in the parent of the ten nodes of each child."""
    i, j = TET_EDGES.T
    parent = np.concatenate([np.eye(4), 0.5 * (np.eye(4)[i] + np.eye(4)[j])])
    corners = parent[CHILDREN]
    return np.concatenate([corners, 0.5 * (corners[:, i] + corners[:, j])], axis=1).reshape(80, 4)


def _shapes(barycentric: FloatArray) -> FloatArray:
    """(k, 10) quadratic shape functions at barycentric coordinates (k, 4)."""
    i, j = TET_EDGES.T
    corner = barycentric * (2 * barycentric - 1)
    return np.hstack([corner, 4 * barycentric[:, i] * barycentric[:, j]])
