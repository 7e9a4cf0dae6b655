"""A coarser mesh of the same body in both its shapes, on some of its vertices, and in which of its tets points are.

Edges are collapsed onto one of their ends, the shortest first, as long as the link condition keeps the topology, tets
keep their quality in both shapes, and the surface stays where it is.
"""

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from fab4d.mesh._coarsening_kernels import Limits, Stars, collapse
from fab4d.mesh.measures import edge_matrices
from fab4d.mesh.tetmesh import BoolArray, FloatArray, IntArray
from fab4d.mesh.topology import cells_by_vertex, face_table, unique_edges

# In units of the mean edge that the wanted number of tets would have.
LONGEST_EDGE, LARGEST_DISTANCE = 2.0, 0.07
LEAST_COSINE = 0.5
# Mean ratios of tets in both shapes. The next, lower ones are taken when a pass collapses less than this share of the
# vertices.
QUALITIES, LEAST_PROGRESS = ((0.5, 0.3), (0.4, 0.2), (0.3, 0.1)), 0.02
# Tets near a point among which the one around it is looked for.
NEAREST = 24


@dataclass(frozen=True, eq=False)
class CoarseMesh:
    """vertices (n_c,): those of the fine mesh that are left, ascending; tets (m_c, 4): with numbers among these."""

    vertices: IntArray
    tets: IntArray


def coarsened(X: FloatArray, x: FloatArray, tets: IntArray, clamp: BoolArray, n_tets: int) -> CoarseMesh:
    """About `n_tets` tets instead of tets (m, 4), or more where walls and curvature need them.

    X, x (n, 3) : both shapes, mm        clamp : (n,) vertices that are only merged with each other
    """
    tets, group = tets.copy(), clamp.astype(np.int64)
    ends = unique_edges(tets)[0]
    mean = float(np.linalg.norm(X[ends[:, 0]] - X[ends[:, 1]], axis=1).mean())
    size = mean * (len(tets) / n_tets) ** (1 / 3)
    for quality, quality_temp in QUALITIES:
        limits = Limits(LONGEST_EDGE * size, LARGEST_DISTANCE * size, LEAST_COSINE, quality, quality_temp)
        changed, progress = np.ones(len(X), np.bool_), np.inf
        while len(tets) > n_tets and progress > LEAST_PROGRESS:
            edges = unique_edges(tets)[0]
            # What did not fit before does not fit now, where nothing has changed since.
            edges = edges[changed[edges].any(axis=1)]
            lengths = np.linalg.norm(X[edges[:, 0]] - X[edges[:, 1]], axis=1)
            gone, changed = np.zeros(len(tets), np.bool_), np.zeros(len(X), np.bool_)
            order = np.argsort(lengths, kind="stable")
            count = collapse(X, x, _stars(tets, len(X)), edges[order], group, limits, gone, changed)
            tets = tets[~gone]
            progress = count / len(np.unique(tets))
    vertices, numbers = np.unique(tets, return_inverse=True)
    return CoarseMesh(vertices, numbers.reshape(-1, 4))


def _stars(tets: IntArray, n: int) -> Stars:
    faces = np.ascontiguousarray(face_table(tets).boundary)
    return Stars(tets, *cells_by_vertex(tets, n), faces, *cells_by_vertex(faces, n))


def nearest_tets(X: FloatArray, tets: IntArray, points: FloatArray) -> IntArray:
    """The tet (p,) of the mesh of X (n, 3) and tets (m, 4) around each of the points (p, 3), or nearest to it.

    That is the one in which the smallest barycentric coordinate is largest.
    """
    D = np.linalg.inv(edge_matrices(X, tets))
    near = cKDTree(X[tets].mean(axis=1)).query(points, k=min(NEAREST, len(tets)))[1].reshape(len(points), -1)
    best, inside = near[:, 0].copy(), np.full(len(points), -np.inf)
    for tet in near.T:
        rest = np.einsum("pij,pj->pi", D[tet], points - X[tets[tet, 0]])
        here = np.minimum(rest.min(axis=1), 1.0 - rest.sum(axis=1))
        better = here > inside
        best[better], inside[better] = tet[better], here[better]
    return best.astype(np.int64)
