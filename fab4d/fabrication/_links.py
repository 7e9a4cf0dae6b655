"""The triangles, link edges and tets around each vertex, as flat tables that compiled kernels walk."""

from typing import NamedTuple

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from fab4d.mesh.tetmesh import BoolArray, IntArray
from fab4d.mesh.topology import face_table


class Links(NamedTuple):
    """The link of vertex v is the triangulated sphere (or disc, at the part's surface) that its tets cut out around it.

    Its triangles are the tets of the star, its edges are the faces at v, its nodes the neighbours of v.
    """

    vertices: IntArray
    """(m, 4) vertices of each tet."""
    star_start: IntArray
    """(n + 1,) where the star of each vertex begins in `star`."""
    star: IntArray
    """(4 m,) tets of each vertex in turn."""
    edge_start: IntArray
    """(n + 1,) where the link edges of each vertex begin."""
    edge_ends: IntArray
    """(E, 2) the two link nodes of a link edge, counted from 0 within the link."""
    edge_tets: IntArray
    """(E, 2) the tets on both sides, as positions within the star; -1 is outside the part."""
    n_nodes: IntArray
    """(n,) nodes of each link."""
    on_surface: BoolArray
    """(n,) whether the vertex lies on the part's surface."""


def split_fans(tets: IntArray) -> IntArray:
    """`tets` (m, 4) with one vertex number per face-connected fan: tets that meet in a vertex only share none."""
    corners = np.arange(tets.size).reshape(tets.shape)
    faces = face_table(tets)
    rows, columns = (
        np.concatenate([corners[t][tets[t] == vertex[:, None]] for vertex in faces.interior.T])
        for t in faces.interior_tets.T
    )
    graph = coo_array((np.ones(len(rows), np.int8), (rows, columns)), shape=(tets.size, tets.size))
    return connected_components(graph, directed=False)[1].astype(np.int64).reshape(tets.shape)


def links_of(vertices: IntArray) -> Links:
    """The links of all vertices of the tets `vertices` (m, 4), numbered 0..n-1."""
    n = int(vertices.max()) + 1
    star_start, star, position = _stars(vertices, n)
    faces = face_table(vertices)
    corners = np.concatenate([faces.boundary, faces.interior])
    outside = np.full(len(faces.boundary), -1)
    tets = np.concatenate([np.column_stack([faces.boundary_tets, outside]), faces.interior_tets])
    centre = corners.T.ravel()
    ends = np.concatenate([np.roll(corners, -k, axis=1)[:, 1:] for k in range(3)])
    tets = np.tile(tets, (3, 1))
    order = np.argsort(centre, kind="stable")
    centre, ends, tets = centre[order], ends[order], tets[order]
    local_ends, n_nodes = _local_ends(centre, ends, n)
    on_surface = np.zeros(n, bool)
    on_surface[faces.boundary] = True
    local_tets = np.column_stack([_position_in_star(vertices, position, tets[:, side], centre) for side in (0, 1)])
    return Links(vertices, star_start, star, _starts(centre, n), local_ends, local_tets, n_nodes, on_surface)


def _starts(sorted_owner: IntArray, n: int) -> IntArray:
    return np.searchsorted(sorted_owner, np.arange(n + 1)).astype(np.int64)


def _stars(vertices: IntArray, n: int) -> tuple[IntArray, IntArray, IntArray]:
    order = np.argsort(vertices.ravel(), kind="stable")
    start = _starts(vertices.ravel()[order], n)
    position = np.zeros(vertices.size, np.int64)
    position[order] = np.arange(vertices.size) - start[vertices.ravel()[order]]
    return start, order // 4, position.reshape(vertices.shape)


def _local_ends(centre: IntArray, ends: IntArray, n: int) -> tuple[IntArray, IntArray]:
    keys, node = np.unique(centre[:, None] * n + ends, return_inverse=True)
    first = _starts(keys // n, n)
    return node.reshape(ends.shape) - first[centre][:, None], np.diff(first)


def _position_in_star(vertices: IntArray, position: IntArray, tets: IntArray, centre: IntArray) -> IntArray:
    corner = np.argmax(vertices[tets] == centre[:, None], axis=1)
    return np.where(tets >= 0, position[tets, corner], -1)
