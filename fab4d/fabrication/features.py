"""The smallest feature that a printer can lay down, and the removal of what is thinner from labels.

The feature is an ellipsoid: about two lines wide and two layers high. A tet keeps its label when most of it lies in
ellipsoids that fit into its own material (a morphological opening, by vote of the tet's sample points).
"""

import numpy as np

from fab4d.fabrication._thickness_kernels import ENOUGH, RADIUS, Solid, covered_points
from fab4d.mesh.measures import tet_volumes
from fab4d.mesh.tetmesh import BoolArray, FloatArray, IntArray
from fab4d.mesh.topology import TET_FACES, face_table

MAX_ROUNDS = 3


def without_thin_places(
    X: FloatArray, tets: IntArray, smp: BoolArray, feature_xy: float, feature_z: float
) -> BoolArray:
    """Labels (m,) in which places of either material thinner than the feature went to the other one.

    X : (n, 3), mm        feature_xy, feature_z : mm, z is the build direction

    Tets that hold a whole feature themselves are never changed, nor are places where the part itself is thinner.
    """
    scaled = X / np.array([feature_xy, feature_xy, feature_z])
    incentres, inradii = _incircles(scaled, tets)
    narrow = inradii < RADIUS
    result = np.array(smp, dtype=bool)
    if not narrow.any():
        return result
    points = _sample_points(scaled, tets, incentres)
    neighbours = tet_neighbours(tets)
    thick_part = _mostly_covered(scaled, tets, neighbours, points, narrow, np.ones(len(tets), bool))
    changeable = narrow & thick_part
    for _ in range(MAX_ROUNDS):
        before = result.copy()
        for label in (True, False):
            inside = result == label
            thick = _mostly_covered(scaled, tets, neighbours, points, changeable, inside)
            result[changeable & inside & ~thick] = not label
        if np.array_equal(before, result):
            break
    return result


def thin_places(X: FloatArray, tets: IntArray, smp: BoolArray, feature_xy: float, feature_z: float) -> BoolArray:
    """Tets (m,) of either material that lie in places thinner than the feature, those of a thin part included.

    X : (n, 3), mm        feature_xy, feature_z : mm, z is the build direction
    """
    scaled = X / np.array([feature_xy, feature_xy, feature_z])
    incentres, inradii = _incircles(scaled, tets)
    narrow = inradii < RADIUS
    thin = np.zeros(len(tets), bool)
    if not narrow.any():
        return thin
    points, neighbours = _sample_points(scaled, tets, incentres), tet_neighbours(tets)
    for label in (True, False):
        inside = np.asarray(smp) == label
        thin |= narrow & inside & ~_mostly_covered(scaled, tets, neighbours, points, narrow, inside)
    return thin


def tet_neighbours(tets: IntArray) -> IntArray:
    """The tet (m, 4) across the face opposite to each corner, -1 at the surface."""
    faces = face_table(tets)
    neighbours = np.full(tets.shape, -1)
    for this, other in (faces.interior_tets.T, faces.interior_tets.T[::-1]):
        opposite = ~(tets[this][:, :, None] == faces.interior[:, None, :]).any(axis=2)
        neighbours[this, np.argmax(opposite, axis=1)] = other
    return neighbours


def _mostly_covered(
    X: FloatArray, tets: IntArray, neighbours: IntArray, points: FloatArray, tested: BoolArray, inside: BoolArray
) -> BoolArray:
    m = len(tets)
    # Where no ball fits anyhow, each one would be searched through the whole part.
    if not inside.any() or np.ptp(X[tets[inside]], axis=(0, 1)).min() < 2 * ENOUGH:
        return np.zeros(m, bool)
    solid = Solid(X, tets, neighbours, inside, np.zeros(m + 1, np.int64), np.zeros(m, np.int64))
    return covered_points(points, tested, solid).mean(axis=1) >= 0.5


def _incircles(X: FloatArray, tets: IntArray) -> tuple[FloatArray, FloatArray]:
    """Centres (m, 3) and radii (m,) of the inscribed spheres."""
    corners = X[tets[:, TET_FACES]]
    areas = 0.5 * np.linalg.norm(
        np.cross(corners[:, :, 1] - corners[:, :, 0], corners[:, :, 2] - corners[:, :, 0]), axis=2
    )
    total = areas.sum(axis=1)
    centres = np.einsum("mi,mix->mx", areas, X[tets]) / total[:, None]
    return centres, 3 * np.abs(tet_volumes(X, tets)) / total


def _sample_points(X: FloatArray, tets: IntArray, incentres: FloatArray) -> FloatArray:
    """(m, 5, 3): the centre of the inscribed sphere, which has most room, and points halfway to the corners."""
    halfway = 0.5 * (X[tets] + incentres[:, None])
    return np.ascontiguousarray(np.concatenate([incentres[:, None], halfway], axis=1))
