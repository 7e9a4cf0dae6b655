"""Patches: the pads through which the rig holds the part.

The area-weighted mean position of a patch is prescribed; its force is spread with the same weights, without a moment.
"""

from dataclasses import dataclass

import numpy as np
from scipy.sparse import csr_array

from fab4d.design.problem import Problem, face_nodes
from fab4d.mesh.measures import face_area_vectors
from fab4d.mesh.tetmesh import FloatArray, IntArray


@dataclass(frozen=True, eq=False)
class Patches:
    """K patches as boundary faces around their centres.

    centers : (K,) vertices         faces : (f, 3) boundary faces of all patches in turn
    offsets : (K + 1,) first face of each patch
    rows, nodes, weights : (w,) patch, node and weight of the mean position; the weights of a patch sum to 1
    """

    centers: IntArray
    faces: IntArray
    offsets: IntArray
    rows: IntArray
    nodes: IntArray
    weights: FloatArray

    @property
    def count(self) -> int:
        return len(self.centers)

    def mean(self, x: FloatArray) -> FloatArray:
        """(K, 3) mean position of each patch in the shape x (N, 3)."""
        return self.operator(len(x)) @ x

    def operator(self, n_nodes: int) -> csr_array:
        """(K, N) the weights as a matrix."""
        return csr_array((self.weights, (self.rows, self.nodes)), shape=(self.count, n_nodes))

    def spread(self, forces: FloatArray, n_nodes: int) -> FloatArray:
        """Nodal forces (N, 3) of patch forces (K, 3)."""
        return self.operator(n_nodes).T @ forces


def outward_normals(patches: Patches, x: FloatArray) -> FloatArray:
    """(K, 3) unit normals of the patches in the shape x (N, 3), out of the part."""
    areas = np.add.reduceat(face_area_vectors(x, patches.faces), patches.offsets[:-1])
    return areas / np.linalg.norm(areas, axis=1, keepdims=True)


def build_patches(problem: Problem, centers: IntArray, radius: float) -> Patches:
    """Patches of the given dimensionless radius around boundary vertices outside the clamp.

    A patch holds the boundary faces at its centre and those whose centroid is within the radius, connected to it and
    not facing away from it. Faces with a clamped corner are left out. What several patches reach is shared: each vertex
    goes to the nearest centre, and but for those at a centre, faces between two patches are left out.
    """
    usable = np.flatnonzero(~problem.clamp[problem.faces].any(axis=1))
    faces = problem.faces[usable]
    X = problem.body.X
    normals = face_area_vectors(X, faces)
    centroids = X[faces].mean(axis=1)
    incident = [(faces == center).any(axis=1) for center in centers]

    def reached(center: int, mine: IntArray) -> IntArray:
        return mine[_grow(X, faces[mine], normals[mine], centroids[mine], center, radius)]

    owner, nearest = np.full(len(X), -1), np.full(len(X), np.inf)
    for k, center in enumerate(centers):
        vertices = np.unique(faces[reached(center, np.arange(len(faces)))])
        distance = np.linalg.norm(X[vertices] - X[center], axis=1)
        nearer = distance < nearest[vertices]
        owner[vertices[nearer]], nearest[vertices[nearer]] = k, distance[nearer]
    for k, at_center in reversed(list(enumerate(incident))):
        owner[faces[at_center]] = k
    chosen = [
        reached(center, np.flatnonzero(incident[k] | (owner[faces] == k).all(axis=1)))
        for k, center in enumerate(centers)
    ]
    offsets = np.r_[0, np.cumsum([len(c) for c in chosen])].astype(np.int64)
    all_faces = faces[np.concatenate(chosen)] if len(chosen) else np.zeros((0, 3), np.int64)
    return patches_from_faces(problem, np.asarray(centers, np.int64), all_faces, offsets)


def _grow(
    X: FloatArray, faces: IntArray, normals: FloatArray, centroids: FloatArray, center: int, radius: float
) -> IntArray:
    incident = np.flatnonzero((faces == center).any(axis=1))
    direction = normals[incident].sum(axis=0)
    near = np.flatnonzero((np.linalg.norm(centroids - X[center], axis=1) <= radius) & (normals @ direction > 0))
    inside = np.union1d(incident, near)
    reached = np.asarray(np.isin(inside, incident))
    while True:
        vertices = np.unique(faces[inside[reached]])
        grown = np.asarray(np.isin(faces[inside], vertices).any(axis=1))
        if np.array_equal(grown, reached):
            return inside[reached]
        reached = grown


def patches_from_faces(problem: Problem, centers: IntArray, faces: IntArray, offsets: IntArray) -> Patches:
    """Patches of known faces (f, 3); the weights are the integrals of the shape functions over each patch."""
    if not len(centers):
        empty = np.zeros(0, np.int64)
        return Patches(empty, np.zeros((0, 3), np.int64), np.zeros(1, np.int64), empty, empty, np.zeros(0))
    nodes = face_nodes(problem, faces)
    areas = np.linalg.norm(face_area_vectors(problem.body.X, faces), axis=1)
    # The integral of a quadratic triangle's corner functions is zero, that of its mid-edge functions a third.
    local = nodes if problem.body.order == 1 else nodes[:, 3:]
    patch = np.repeat(np.arange(len(centers)), np.diff(offsets))
    keys, inverse = np.unique(np.repeat(patch, 3) * problem.n_nodes + local.ravel(), return_inverse=True)
    weights = np.bincount(inverse, np.repeat(areas / 3.0, 3))
    rows, columns = keys // problem.n_nodes, keys % problem.n_nodes
    return Patches(centers, faces, offsets, rows, columns, weights / np.bincount(rows, weights)[rows])


def spread_centers(problem: Problem, count: int, among: IntArray | None = None) -> IntArray:
    """`count` boundary vertices outside the clamp, far from it and from each other (farthest-point sampling)."""
    candidates = pad_vertices(problem) if among is None else among
    X = problem.body.X
    clamp = X[problem.clamp] if problem.clamp.any() else X[candidates].mean(axis=0)[None]
    distance = np.full(len(candidates), np.inf)
    for point in clamp:
        distance = np.minimum(distance, np.linalg.norm(X[candidates] - point, axis=1))
    centers = []
    for _ in range(min(count, len(candidates))):
        best = int(np.argmax(distance))
        centers.append(candidates[best])
        distance = np.minimum(distance, np.linalg.norm(X[candidates] - X[candidates[best]], axis=1))
    return np.array(centers, np.int64)


def pad_vertices(problem: Problem) -> IntArray:
    """Boundary vertices at which a patch may be centred: those with a face free of the clamp."""
    usable = problem.faces[~problem.clamp[problem.faces].any(axis=1)]
    return np.unique(usable)
