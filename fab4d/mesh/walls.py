"""How thick a tet mesh is under each boundary face, and how many elements span that."""

from dataclasses import dataclass

import numpy as np

from fab4d.mesh.measures import edge_matrices, face_area_vectors
from fab4d.mesh.tetmesh import FloatArray, IntArray
from fab4d.mesh.topology import FaceTable, face_table

# A wall's far side faces away from the near side within 45 degrees: a cut across an edge of the part is no wall.
OPPOSITE = -0.7
# Fewer elements across a wall are worth a warning: two of an irregular mesh. Small details, of this share of the walls'
# area, may have fewer.
FEWEST_ELEMENTS, COARSE_SHARE = 1.9, 0.05
# Narrow margin inside which a ray through an edge counts as inside a tet.
_MARGIN = 1e-9


@dataclass(frozen=True, eq=False)
class Walls:
    """Boundary faces with another face opposite to them.

    faces : (w, 3) vertices          areas : (w,) mm^2          thickness : (w,) mm to the far side
    elements : (w,) thickness over the mean extent, in that direction, of the tets on the way: so many span it
    """

    faces: IntArray
    areas: FloatArray
    thickness: FloatArray
    elements: FloatArray

    def thin_share(self, elements: float) -> float:
        """Share of the walls' area that fewer than `elements` span."""
        return float(self.areas[self.elements < elements].sum() / self.areas.sum()) if len(self.areas) else 0.0

    def fewest(self, share: float) -> float:
        """Elements that all but the given `share` of the walls' area have at least; inf without a wall."""
        if not len(self.areas):
            return np.inf
        order = np.argsort(self.elements, kind="stable")
        covered = np.cumsum(self.areas[order]) / self.areas.sum()
        return float(self.elements[order[min(int(np.searchsorted(covered, share)), len(order) - 1)]])

    def thinnest_place(self, X: FloatArray) -> FloatArray:
        """(3,) middle of the wall face that the fewest elements span, mm; the part's own without a wall."""
        return X[self.faces[self.elements.argmin()]].mean(axis=0) if len(self.areas) else X.mean(axis=0)


def walls(X: FloatArray, tets: IntArray) -> Walls:
    """Walls of the part X (n, 3), tets (m, 4), measured along the inward normal from each boundary face's centroid."""
    table = face_table(tets)
    vectors = face_area_vectors(X, table.boundary)
    areas = np.linalg.norm(vectors, axis=1)
    normals = vectors / areas[:, None]
    leaving, far, size = _far_faces(X, tets, table, X[table.boundary].mean(axis=1), -normals)
    opposite = np.flatnonzero((leaving >= 0) & (np.einsum("bi,bi->b", normals, normals[leaving]) < OPPOSITE))
    return Walls(table.boundary[opposite], areas[opposite], far[opposite], far[opposite] / size[opposite])


def _far_faces(
    X: FloatArray, tets: IntArray, table: FaceTable, origins: FloatArray, directions: FloatArray
) -> tuple[IntArray, FloatArray, FloatArray]:
    """Where rays that enter through each boundary face leave: boundary face (-1: lost), distance, mean tet extent.

    Every ray goes from tet to tet: the face with the least exit distance is crossed next.
    """
    behind = _neighbours(tets, table)
    inverse = np.linalg.inv(edge_matrices(X, tets))
    # Gradients of the four barycentric coordinates; a coordinate that falls to zero is a face that is crossed.
    gradients = np.concatenate([-inverse.sum(axis=1, keepdims=True), inverse], axis=1)
    tet = table.boundary_tets.copy()
    n = len(tet)
    leaving, distance, total, count = np.full(n, -1), np.zeros(n), np.zeros(n), np.zeros(n)
    going = np.arange(n)
    for _ in range(len(tets)):
        if not len(going):
            break
        at = tet[going]
        rate = np.einsum("rfi,ri->rf", gradients[at], directions[going])
        start = np.einsum("rfi,ri->rf", gradients[at], origins[going] - X[tets[at, 0]])
        start[:, 0] += 1.0
        # A ray that lies in a face neither nears nor leaves it: 0 / 0, which is not taken.
        with np.errstate(divide="ignore", invalid="ignore"):
            exit_at = np.where(rate < -_MARGIN * np.abs(rate).max(axis=1, keepdims=True), -start / rate, np.inf)
        face = exit_at.argmin(axis=1)
        reached = exit_at[np.arange(len(going)), face]
        distance[going] = np.maximum(distance[going], reached)
        total[going] += np.ptp(np.einsum("rci,ri->rc", X[tets[at]], directions[going]), axis=1)
        count[going] += 1
        beyond = behind[at, face]
        out = beyond < 0
        leaving[going[out]] = -beyond[out] - 1
        tet[going] = np.maximum(beyond, 0)
        going = going[~out]
    return leaving, distance, total / np.maximum(count, 1)


def _neighbours(tets: IntArray, table: FaceTable) -> IntArray:
    """(m, 4) the tet behind each local face (opposite corner i), or -1 - b for boundary face b."""
    behind = np.zeros((len(tets), 4), np.int64)
    opposite = [tets.sum(axis=1)[owner] - faces.sum(axis=1) for owner, faces in _owned(table)]
    (owner, _), (first, _), (second, _) = _owned(table)
    behind[owner, _local(tets, owner, opposite[0])] = -1 - np.arange(len(owner))
    behind[first, _local(tets, first, opposite[1])] = second
    behind[second, _local(tets, second, opposite[2])] = first
    return behind


def _owned(table: FaceTable) -> tuple[tuple[IntArray, IntArray], ...]:
    first, second = table.interior_tets.T
    return (table.boundary_tets, table.boundary), (first, table.interior), (second, table.interior)


def _local(tets: IntArray, owner: IntArray, vertex: IntArray) -> IntArray:
    """Place of the vertex among the corners of its tet."""
    place: IntArray = (tets[owner] == vertex[:, None]).argmax(axis=1)
    return place
