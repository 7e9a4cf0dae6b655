"""Pictures of triangles by depth buffer: which face each pixel sees, and how deep it is."""

from typing import NamedTuple

import numpy as np
from numba import njit

from fab4d.mesh.measures import face_area_vectors
from fab4d.mesh.tetmesh import FloatArray, IntArray


class DepthImage(NamedTuple):
    """What each pixel (height, width) sees; row 0 is at the top."""

    depth: FloatArray
    """Coordinate towards the viewer, mm; -inf where nothing is."""
    face: IntArray
    """Face number, or -1."""


def render(points: FloatArray, faces: IntArray, width: int, height: int) -> DepthImage:
    """Depth image of triangles (b, 3).

    points : (n, 3) pixel column, pixel row (down), coordinate towards the viewer
    """
    depth = np.full((height, width), -np.inf)
    face = np.full((height, width), -1, np.int64)
    _fill(np.ascontiguousarray(points[faces], dtype=np.float64), depth, face)
    return DepthImage(depth, face)


def shading(points: FloatArray, faces: IntArray, light: FloatArray) -> FloatArray:
    """Brightness (b,) in 0.45..1 of faces lit from direction `light` (3,), a unit vector; both sides alike."""
    normals = face_area_vectors(points, faces)
    lengths = np.linalg.norm(normals, axis=1)
    return 0.45 + 0.55 * np.abs(normals @ light) / np.where(lengths > 0, lengths, 1.0)


@njit(cache=True)
def _fill(triangles, depth, face):  # type: ignore[no-untyped-def]
    """Write triangles (b, 3, 3) into the depth and face buffers; pixel centres are at half numbers."""
    height, width = depth.shape
    for f in range(len(triangles)):
        (x0, y0, z0), (x1, y1, z1), (x2, y2, z2) = triangles[f, 0], triangles[f, 1], triangles[f, 2]
        area = (x1 - x0) * (y2 - y0) - (x2 - x0) * (y1 - y0)
        if area == 0.0:
            continue
        for row in range(max(0, int(min(y0, y1, y2) - 0.5)), min(height, int(max(y0, y1, y2) + 1.5))):
            for column in range(max(0, int(min(x0, x1, x2) - 0.5)), min(width, int(max(x0, x1, x2) + 1.5))):
                px, py = column + 0.5, row + 0.5
                b = ((px - x0) * (y2 - y0) - (x2 - x0) * (py - y0)) / area
                c = ((x1 - x0) * (py - y0) - (px - x0) * (y1 - y0)) / area
                if b < 0.0 or c < 0.0 or b + c > 1.0:
                    continue
                z = z0 + b * (z1 - z0) + c * (z2 - z0)
                if z > depth[row, column]:
                    depth[row, column] = z
                    face[row, column] = f
