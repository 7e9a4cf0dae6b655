"""Shapes between two shapes of one tet mesh: rotations and stretches of the tets run from one to the other."""

from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import breadth_first_order
from scipy.sparse.linalg import splu
from scipy.spatial.transform import Rotation

from fab4d.mesh.measures import deformation_gradients, edge_matrices, tet_volumes
from fab4d.mesh.tetmesh import BoolArray, FloatArray, IntArray
from fab4d.mesh.topology import face_table


@dataclass(frozen=True, eq=False)
class ShapePath:
    """Path of shapes from X (t = 0) to x (t = 1); call `at`.

    rotations : (m, 3) rotation vectors of the tets, continuous over the mesh, so that turns beyond 180 degrees are kept
    stretches : (m, 3, 3) right stretch tensors
    """

    X: FloatArray
    x: FloatArray
    tets: IntArray
    fixed: IntArray
    rotations: FloatArray
    stretches: FloatArray

    def at(self, t: float) -> FloatArray:
        """(n, 3) the shape whose deformation gradients are closest to exp(t omega) ((1 - t) I + t S).

        The vertices `fixed` go straight from X to x.
        """
        F = Rotation.from_rotvec(t * self.rotations).as_matrix() @ ((1 - t) * np.eye(3) + t * self.stretches)
        return closest_shape(self.X, self.tets, F, self.fixed, (1 - t) * self.X + t * self.x)


def shape_path(X: FloatArray, x: FloatArray, tets: IntArray, fixed: BoolArray) -> ShapePath:
    """Path from X to x (n, 3) of tets (m, 4); `fixed` (n,) vertices, one at least, anchor it.

    Source: polar interpolation of Alexa, Cohen-Or and Levin, SIGGRAPH 2000, with rotation vectors made continuous.
    """
    F = deformation_gradients(X, x, tets)
    U, s, Vt = np.linalg.svd(F)
    R = U @ Vt
    stretches = np.swapaxes(Vt, 1, 2) @ (s[:, :, None] * Vt)
    anchored = np.flatnonzero(fixed) if fixed.any() else np.zeros(1, np.int64)
    omega = _continuous(Rotation.from_matrix(R).as_rotvec(), tets, anchored)
    return ShapePath(X, x, tets, anchored, omega, stretches)


def _continuous(omega: FloatArray, tets: IntArray, anchored: IntArray) -> FloatArray:
    """Rotation vectors plus whole turns, each nearest to that of the tet it is reached from."""
    m = len(tets)
    pairs = face_table(tets).interior_tets
    graph = coo_array((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(m, m)).tocsr()
    graph = graph + graph.T
    omega = omega.copy()
    seen = np.zeros(m, bool)
    near_anchor = np.isin(tets, anchored).sum(axis=1)
    while not seen.all():
        root = int(np.argmax(np.where(seen, -1, near_anchor)))
        order, parents = breadth_first_order(graph, root, directed=False)
        seen[order] = True
        for tet in order[1:]:
            omega[tet] = _nearest_turn(omega[tet], omega[parents[tet]])
    return omega


def _nearest_turn(omega: FloatArray, to: FloatArray) -> FloatArray:
    angle, size = float(np.linalg.norm(omega)), float(np.linalg.norm(to))
    if size < 1.0:
        return omega
    axis = omega / angle if angle > 1e-9 else to / size
    turns = np.round((axis @ to - angle) / (2 * np.pi))
    return (angle + 2 * np.pi * turns) * axis


def closest_shape(X: FloatArray, tets: IntArray, F: FloatArray, fixed: IntArray, goal: FloatArray) -> FloatArray:
    """Shape (n, 3) with gradients closest to F (m, 3, 3), volume-weighted least squares; x[fixed] = goal[fixed]."""
    n = len(X)
    D = np.linalg.inv(edge_matrices(X, tets))
    grads = np.concatenate([-D.sum(axis=1, keepdims=True), D], axis=1)
    V = np.abs(tet_volumes(X, tets))
    K = V[:, None, None] * (grads @ np.swapaxes(grads, 1, 2))
    rows, columns = np.repeat(tets, 4, axis=1).ravel(), np.tile(tets, (1, 4)).ravel()
    A = coo_array((K.ravel(), (rows, columns)), shape=(n, n)).tocsc()
    b = np.zeros((n, 3))
    np.add.at(b, tets, V[:, None, None] * (grads @ np.swapaxes(F, 1, 2)))
    free = np.setdiff1d(np.arange(n), fixed)
    x = goal.copy()
    rhs = b[free] - A[free][:, fixed] @ x[fixed]
    x[free] = splu(A[free][:, free].tocsc()).solve(rhs)
    return x
