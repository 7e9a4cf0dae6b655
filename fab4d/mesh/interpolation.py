"""Shapes between two shapes of one tet mesh: rotations and stretches of the tets run from one to the other."""

from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_array, csr_array
from scipy.sparse.csgraph import breadth_first_order, shortest_path
from scipy.sparse.linalg import splu
from scipy.spatial.transform import Rotation

from fab4d.mesh.measures import deformation_gradients, edge_matrices, tet_volumes
from fab4d.mesh.tetmesh import BoolArray, FloatArray, IntArray
from fab4d.mesh.topology import component_labels, face_table

# Rotation vectors of neighbours that differ by more are torn: beyond a whole turn some rotations have no vector near.
_TORN = 1.0
# Layers of tets, counted from the anchor, in a section.
_LAYERS = 4


@dataclass(frozen=True, eq=False)
class Sections:
    """Connected groups of tets in layers from the anchor outward; each turns from its parent's rotation by a step.

    of_tet : (m,) section of each tet       order : (k,) sections, parents first       parents : (k,) -1 for a root
    steps : (k, 3) rotation vectors from the parent to the section, in the parent's frame; less than half a turn each
    """

    of_tet: IntArray
    order: IntArray
    parents: IntArray
    steps: FloatArray

    def turned(self, t: float) -> FloatArray:
        """(k, 3, 3) rotations of the sections when every step has come to the part t of it."""
        R = Rotation.from_rotvec(t * self.steps).as_matrix()
        for section in self.order:
            if self.parents[section] >= 0:
                R[section] = R[self.parents[section]] @ R[section]
        return R


@dataclass(frozen=True, eq=False)
class ShapePath:
    """Path of shapes from X (t = 0) to x (t = 1); call `at`.

    rotations : (m, 3) rotation vectors of the tets, or, with `sections`, of the tets within their sections
    stretches : (m, 3, 3) right stretch tensors
    """

    X: FloatArray
    x: FloatArray
    tets: IntArray
    fixed: IntArray
    rotations: FloatArray
    stretches: FloatArray
    sections: Sections | None = None

    def at(self, t: float) -> FloatArray:
        """(n, 3) the shape whose deformation gradients are closest to exp(t omega) ((1 - t) I + t S).

        The vertices `fixed` go straight from X to x.
        """
        F = Rotation.from_rotvec(t * self.rotations).as_matrix() @ ((1 - t) * np.eye(3) + t * self.stretches)
        if self.sections is not None:
            F = self.sections.turned(t)[self.sections.of_tet] @ F
        return closest_shape(self.X, self.tets, F, self.fixed, (1 - t) * self.X + t * self.x)


def shape_path(X: FloatArray, x: FloatArray, tets: IntArray, fixed: BoolArray) -> ShapePath:
    """Path from X to x (n, 3) of tets (m, 4); `fixed` (n,) vertices, one at least, anchor it.

    Source: polar interpolation of Alexa, Cohen-Or and Levin, SIGGRAPH 2000, with rotation vectors made continuous.
    Where these tear, the rotations are composed section by section from the anchor on, as those of a rod are of its
    curvature and twist.
    """
    F = deformation_gradients(X, x, tets)
    U, s, Vt = np.linalg.svd(F)
    # The corners of a curved quadratic tet may be turned inside out: the stretch is then negative, not the rotation.
    side = np.sign(np.linalg.det(U @ Vt))
    U[:, :, 2] *= side[:, None]
    s[:, 2] *= side
    R = U @ Vt
    stretches = np.swapaxes(Vt, 1, 2) @ (s[:, :, None] * Vt)
    anchored = np.flatnonzero(fixed) if fixed.any() else np.zeros(1, np.int64)
    pairs = face_table(tets).interior_tets
    omega = _continuous(Rotation.from_matrix(R).as_rotvec(), tets, pairs, anchored)
    jumps = np.linalg.norm(omega[pairs[:, 0]] - omega[pairs[:, 1]], axis=1)
    if jumps.max(initial=0.0) < _TORN or np.linalg.norm(omega, axis=1).max() < np.pi:
        return ShapePath(X, x, tets, anchored, omega, stretches)
    near_anchor = np.isin(tets, anchored).sum(axis=1) > 0
    sections, bulk = _sections(R, np.abs(tet_volumes(X, tets)), pairs, near_anchor)
    inner = Rotation.from_matrix(np.swapaxes(bulk[sections.of_tet], 1, 2) @ R).as_rotvec()
    return ShapePath(X, x, tets, anchored, inner, stretches, sections)


def _sections(R: FloatArray, V: FloatArray, pairs: IntArray, anchored: BoolArray) -> tuple[Sections, FloatArray]:
    """Sections of the tets, and the mean rotations (k, 3, 3) of these, by volume V (m,)."""
    layer = _layers(len(R), pairs, anchored) // _LAYERS
    together = layer[pairs[:, 0]] == layer[pairs[:, 1]]
    of_tet = component_labels(len(R), pairs[together])
    k = int(of_tet.max()) + 1
    mean = np.zeros((k, 3, 3))
    np.add.at(mean, of_tet, V[:, None, None] * R)
    U, _, Vt = np.linalg.svd(mean)
    U[:, :, 2] *= np.sign(np.linalg.det(U @ Vt))[:, None]
    bulk = U @ Vt
    first = np.full(k, np.iinfo(np.int64).max)
    np.minimum.at(first, of_tet, layer)
    order, parents = _tree(k, of_tet[pairs[~together]], first)
    relative = np.where((parents < 0)[:, None, None], bulk, np.swapaxes(bulk[parents], 1, 2) @ bulk)
    return Sections(of_tet, order, parents, Rotation.from_matrix(relative).as_rotvec()), bulk


def _layers(m: int, pairs: IntArray, anchored: BoolArray) -> IntArray:
    """Number of faces (m,) between each tet and the nearest `anchored` one; in pieces without one, from their first."""
    piece = component_labels(m, pairs)
    first = np.unique(piece, return_index=True)[1]
    start = anchored.copy()
    start[first] |= np.bincount(piece, anchored)[piece[first]] == 0
    graph = _graph(m + 1, np.concatenate([pairs, np.column_stack([np.full(start.sum(), m), np.flatnonzero(start)])]))
    distance = shortest_path(graph, directed=False, unweighted=True, indices=m)[:m]
    return distance.astype(np.int64) - 1


def _tree(k: int, links: IntArray, layer: IntArray) -> tuple[IntArray, IntArray]:
    """Order and parents (k,) of breadth-first trees over the links; a root is a section of the lowest layer."""
    graph = _graph(k, links)
    order, parents = [], np.full(k, -1)
    seen = np.zeros(k, bool)
    while not seen.all():
        root = int(np.argmin(np.where(seen, np.iinfo(np.int64).max, layer)))
        reached, parent = breadth_first_order(graph, root, directed=False)
        seen[reached] = True
        order.append(reached)
        parents[reached[1:]] = parent[reached[1:]]
    return np.concatenate(order).astype(np.int64), parents


def _graph(n: int, pairs: IntArray) -> csr_array:
    return coo_array((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(n, n)).tocsr()


def _continuous(omega: FloatArray, tets: IntArray, pairs: IntArray, anchored: IntArray) -> FloatArray:
    """Rotation vectors plus whole turns, each nearest to that of the tet it is reached from."""
    m = len(tets)
    graph = _graph(m, pairs)
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
