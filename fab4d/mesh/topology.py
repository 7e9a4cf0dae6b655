"""Who touches whom: faces, edges, neighbours, components of tet and triangle meshes."""

from typing import NamedTuple

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from fab4d.mesh.tetmesh import BoolArray, IntArray

# Corners of face i of a tet (opposite corner i), outward for a positively oriented tet.
TET_FACES = np.array([[1, 2, 3], [0, 3, 2], [0, 1, 3], [0, 2, 1]])
# Edges in the VTK order of the mid-edge nodes of a quadratic tet.
TET_EDGES = np.array([[0, 1], [1, 2], [0, 2], [0, 3], [1, 3], [2, 3]])


class FaceTable(NamedTuple):
    """The faces of a tet mesh, split into boundary and interior ones."""

    boundary: IntArray
    """(b, 3) vertices, outward orientation."""
    boundary_tets: IntArray
    """(b,) the tet that owns each boundary face."""
    interior: IntArray
    """(k, 3) vertices, outward of the first tet of `interior_tets`."""
    interior_tets: IntArray
    """(k, 2) the two tets at each interior face."""


def face_table(tets: IntArray) -> FaceTable:
    """Boundary and interior faces of tets (m, 4).

    Raises ValueError when more than two tets share a face.
    """
    faces = tets[:, TET_FACES].reshape(-1, 3)
    owners = np.repeat(np.arange(len(tets)), 4)
    keys = np.sort(faces, axis=1)
    order = np.lexsort(keys.T[::-1])
    keys = keys[order]
    starts = np.flatnonzero(np.r_[True, np.any(keys[1:] != keys[:-1], axis=1)]) if len(keys) else np.zeros(0, int)
    counts = np.diff(np.r_[starts, len(keys)])
    if np.any(counts > 2):
        face = keys[starts[np.argmax(counts > 2)]]
        msg = f"face {face.tolist()} is shared by {counts.max()} tets"
        raise ValueError(msg)
    # A stable order (by first tet) keeps the result independent of the sort's ties.
    single = np.sort(order[starts[counts == 1]])
    first, second = order[starts[counts == 2]], order[starts[counts == 2] + 1]
    first, second = np.minimum(first, second), np.maximum(first, second)
    by_first = np.argsort(first)
    first, second = first[by_first], second[by_first]
    return FaceTable(faces[single], owners[single], faces[first], np.column_stack([owners[first], owners[second]]))


def unique_edges(tets: IntArray) -> tuple[IntArray, IntArray]:
    """Edges (e, 2), smaller vertex first, and the edge of each tet's six local edges (m, 6) in VTK order."""
    ends = np.sort(tets[:, TET_EDGES].reshape(-1, 2), axis=1)
    edges, inverse = np.unique(ends, axis=0, return_inverse=True)
    return edges, inverse.reshape(-1, 6)


def cells_by_vertex(cells: IntArray, n_vertices: int) -> tuple[IntArray, IntArray]:
    """Where the cells (m, k) of each vertex begin (n + 1,), and the cells of each vertex in turn (m k,)."""
    corners = cells.ravel()
    order = np.argsort(corners, kind="stable")
    return np.searchsorted(corners[order], np.arange(n_vertices + 1)), order // cells.shape[1]


def component_labels(n_items: int, pairs: IntArray) -> IntArray:
    """Connected-component number (n_items,) of the graph with edges `pairs` (k, 2)."""
    graph = coo_array((np.ones(len(pairs), np.int8), (pairs[:, 0], pairs[:, 1])), shape=(n_items, n_items))
    return connected_components(graph, directed=False)[1].astype(np.int64)


def vertices_near(tets: IntArray, chosen: BoolArray, n_vertices: int, rings: int | None) -> BoolArray:
    """Vertices (n,) of the `chosen` (m,) tets and of `rings` - 1 layers around them; all for None."""
    near = np.full(n_vertices, rings is None)
    near[tets[chosen]] = True
    for _ in range((rings or 1) - 1):
        near[tets[near[tets].any(axis=1)]] = True
    return near
