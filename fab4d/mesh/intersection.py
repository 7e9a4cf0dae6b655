"""Where a surface passes through itself."""
# mypy: disable-error-code="no-untyped-def"

import numpy as np
from numba import njit

from fab4d.mesh.distance import LEAF_SIZE, box_tree, spatial_order
from fab4d.mesh.measures import bounding_box_diagonal, face_area_vectors
from fab4d.mesh.tetmesh import FloatArray, IntArray

# Of the diagonal: surfaces that touch or overlap by less do not count; jitter tells edges that meet edges apart.
_SHRUNK, _JITTER = 1e-6, 1e-7
MOST_PAIRS = 1000


def self_intersections(x: FloatArray, faces: IntArray, most: int = MOST_PAIRS) -> IntArray:
    """Pairs (k, 2) of triangles of the closed surface `faces` (b, 3) that pass through each other; `most` at most.

    x : (n, 3) positions, mm
    The surface is first drawn in by 1e-6 of its diagonal, so that parts of it that only touch are not reported.
    """
    used = np.flatnonzero(np.bincount(faces.ravel()))
    L0 = bounding_box_diagonal(x[used])
    normals = np.zeros_like(x)
    np.add.at(normals, faces, face_area_vectors(x, faces)[:, None, :])
    sizes = np.linalg.norm(normals, axis=1, keepdims=True)
    inward = -_SHRUNK * L0 * normals / np.where(sizes > 0, sizes, 1.0)
    jitter = _JITTER * L0 * np.random.default_rng(0).uniform(-1, 1, x.shape)
    points = x + inward + jitter
    order = spatial_order(points[faces])
    ordered = np.ascontiguousarray(faces[order])
    pairs, count = _crossings(ordered, *box_tree(points[ordered]), np.zeros((most, 2), np.int64))
    return np.sort(order[pairs[:count]], axis=1)


@njit(cache=True, inline="always")
def _volume(a, b, c, d):
    """Six times the signed volume of the tet a b c d."""
    ux, uy, uz = b[0] - a[0], b[1] - a[1], b[2] - a[2]
    vx, vy, vz = c[0] - a[0], c[1] - a[1], c[2] - a[2]
    wx, wy, wz = d[0] - a[0], d[1] - a[1], d[2] - a[2]
    return ux * (vy * wz - vz * wy) + uy * (vz * wx - vx * wz) + uz * (vx * wy - vy * wx)


@njit(cache=True)
def _pierces(p, q, tri):
    """Whether the segment p q passes through the inside of the triangle tri (3, 3)."""
    a, b, c = tri[0], tri[1], tri[2]
    if _volume(p, a, b, c) * _volume(q, a, b, c) >= 0.0:
        return False
    first, second, third = _volume(p, q, a, b), _volume(p, q, b, c), _volume(p, q, c, a)
    return (first > 0.0 and second > 0.0 and third > 0.0) or (first < 0.0 and second < 0.0 and third < 0.0)


@njit(cache=True)
def _edges_pierce(f, g, face_f, face_g):
    """Whether an edge of triangle f (3, 3) that has no vertex in common with triangle g passes through g."""
    for k in range(3):
        i, j = face_f[k], face_f[(k + 1) % 3]
        shared = False
        for vertex in face_g:
            shared = shared or vertex in (i, j)
        if not shared and _pierces(f[k], f[(k + 1) % 3], g):
            return True
    return False


@njit(cache=True)
def _crossings(faces, triangles, lower, upper, pairs):
    """Fills `pairs` with crossing triangles, and returns it with their number; each pair once."""
    stack = np.zeros(64, np.int64)
    first_leaf, count = len(lower) // 2, 0
    for f in range(len(faces)):
        low, high = np.zeros(3), np.zeros(3)
        for k in range(3):
            low[k] = min(triangles[f, 0, k], triangles[f, 1, k], triangles[f, 2, k])
            high[k] = max(triangles[f, 0, k], triangles[f, 1, k], triangles[f, 2, k])
        stack[0], size = 0, 1
        while size > 0:
            size -= 1
            node = stack[size]
            apart = False
            for k in range(3):
                apart = apart or lower[node, k] > high[k] or upper[node, k] < low[k]
            if apart:
                continue
            if node < first_leaf:
                stack[size], stack[size + 1] = 2 * node + 1, 2 * node + 2
                size += 2
                continue
            start = (node - first_leaf) * LEAF_SIZE
            for g in range(max(start, f + 1), min(start + LEAF_SIZE, len(faces))):
                if _edges_pierce(triangles[f], triangles[g], faces[f], faces[g]) or _edges_pierce(
                    triangles[g], triangles[f], faces[g], faces[f]
                ):
                    pairs[count, 0], pairs[count, 1] = f, g
                    count += 1
                    if count == len(pairs):
                        return pairs, count
    return pairs, count
