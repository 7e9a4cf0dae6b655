"""The points where the rig holds the part: where, which way, how hard, and where to while it cools."""

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from fab4d.mesh.measures import face_area_vectors, unit_vectors
from fab4d.mesh.tetmesh import FloatArray, IntArray
from fab4d.units import N_PER_KGF


@dataclass(frozen=True, eq=False)
class LoadPoints:
    """K pads in the frame of the printed part.

    vertex : (K,) nearest vertex            position : (K, 3) mean of the pad on the permanent shape, mm
    pad_area : (K,) mm^2                    force : (K, 3) on the part, N
    hold : (K, 3) where the mean of the pad is held while the part cools, mm
    normal : (K, 3) outward unit normal of the pad in the median shape
    """

    vertex: IntArray
    position: FloatArray
    pad_area: FloatArray
    force: FloatArray
    hold: FloatArray
    normal: FloatArray

    @property
    def count(self) -> int:
        return len(self.vertex)

    @property
    def pad_radius(self) -> FloatArray:
        """Radius (K,) of the round pad of the same area, mm."""
        return np.sqrt(self.pad_area / np.pi)

    @property
    def size(self) -> FloatArray:
        """|force| (K,), N."""
        return np.linalg.norm(self.force, axis=1)

    @property
    def direction(self) -> FloatArray:
        """Unit direction (K, 3) of the force; zero where there is none."""
        return unit_vectors(self.force)

    @property
    def azimuth(self) -> FloatArray:
        """Angle (K,) of the direction about +z from +x towards +y, degrees in (-180, 180]."""
        degrees = np.degrees(np.arctan2(self.direction[:, 1], self.direction[:, 0]))
        return np.where(degrees <= -180.0, 180.0, degrees)

    @property
    def elevation(self) -> FloatArray:
        """Angle (K,) of the direction above the xy plane, degrees."""
        return np.degrees(np.arcsin(np.clip(self.direction[:, 2], -1.0, 1.0)))

    @property
    def kgf(self) -> FloatArray:
        """|force| (K,) in kgf: the mass in kg that hung over a pulley pulls as hard."""
        return self.size / N_PER_KGF

    @property
    def travel(self) -> FloatArray:
        """Distance (K,) from the permanent to the held position, mm."""
        return np.linalg.norm(self.hold - self.position, axis=1)

    @property
    def pushes(self) -> np.ndarray:
        """(K,) whether the force points into the surface, so that a cable cannot apply it."""
        return np.sum(self.force * self.normal, axis=1) < 0.0


def load_points(state: Mapping[str, np.ndarray]) -> LoadPoints:
    """The pads of a verified state (pipeline/README.md), in the order of its patches."""
    offsets, faces = state["patch_offsets"], state["patch_faces"]
    pads = [faces[a:b] for a, b in pairwise(offsets)]
    X, x = state["nodes"], state["x"]
    areas = [np.linalg.norm(face_area_vectors(X, pad), axis=1) for pad in pads]
    means = [a @ X[pad].mean(axis=1) / a.sum() for a, pad in zip(areas, pads, strict=True)]
    return LoadPoints(
        vertex=state["patch_center"],
        position=np.reshape(means, (-1, 3)),
        pad_area=np.array([a.sum() for a in areas]),
        force=state["patch_force"],
        hold=state["patch_held"],
        normal=unit_vectors(np.reshape([face_area_vectors(x, pad).sum(axis=0) for pad in pads], (-1, 3))),
    )
