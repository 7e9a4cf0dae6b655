"""Straight-sided 10-node tets made from 4-node tets."""

import numpy as np

from fab4d.mesh.tetmesh import FloatArray, IntArray
from fab4d.mesh.topology import unique_edges


def quadratic_tets(tets: IntArray, n_vertices: int) -> tuple[IntArray, IntArray]:
    """Connectivity (m, 10) in VTK node order, and the edges (e, 2) whose midpoints are nodes n_vertices + k."""
    edges, tet_edges = unique_edges(tets)
    return np.hstack([tets, n_vertices + tet_edges]), edges


def with_midpoints(X: FloatArray, edges: IntArray) -> FloatArray:
    """Vertex values (n, ...) followed by their means over `edges` (e, 2): (n + e, ...)."""
    return np.concatenate([X, 0.5 * (X[edges[:, 0]] + X[edges[:, 1]])])
