"""How far a deformed shape is from the wanted one: corresponding vertices, and surface to surface, in mm."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numba import njit
from scipy.spatial import cKDTree

from fab4d.mesh.rigid import best_rigid_motion
from fab4d.mesh.tetmesh import FloatArray, IntArray

LEAF_SIZE = 8
"""Triangles in a leaf of the box tree."""


@dataclass(frozen=True)
class ShapeError:
    """RMS and maximum distance of corresponding boundary vertices, and Hausdorff distance of the surfaces, mm."""

    rms: float
    max: float
    hausdorff: float


@dataclass(frozen=True)
class Displacement:
    """RMS and largest distance of boundary vertices from the permanent to the wanted shape, in the unit of these."""

    rms: float
    max: float


class BoxTree(NamedTuple):
    """Axis-parallel boxes around the triangles of a surface, a complete binary tree stored as a heap."""

    triangles: FloatArray
    """(leaves * LEAF_SIZE, 3, 3) corners, along a space-filling curve; the last one repeated as padding."""
    lower: FloatArray
    """(2 leaves - 1, 3) lower corners of the boxes; the children of box k are boxes 2 k + 1 and 2 k + 2."""
    upper: FloatArray
    """(2 leaves - 1, 3) upper corners of the boxes."""


def shape_error(y: FloatArray, X_temp: FloatArray, faces: IntArray, vertex_areas: FloatArray) -> ShapeError:
    """Distance of the shape y to the wanted shape X_temp after the best rigid motion of y.

    rms = sqrt(sum_i a_i |R y_i + t - X_temp_i|^2 / sum_i a_i), max over boundary vertices, and `hausdorff_distance`.
    y, X_temp : (n, 3), mm      faces : (b, 3) boundary triangles      vertex_areas : (n,) or (n_b,), mm^2: those of all
    vertices, or of the boundary vertices in ascending order.
    """
    on_surface = _used(faces)
    areas = vertex_areas if len(vertex_areas) == len(on_surface) else vertex_areas[on_surface]
    moved = aligned(y, X_temp, on_surface, areas)
    squared = np.sum((moved[on_surface] - X_temp[on_surface]) ** 2, axis=1)
    return ShapeError(
        rms=float(np.sqrt(areas @ squared / areas.sum())),
        max=float(np.sqrt(squared.max())),
        hausdorff=hausdorff_distance(moved, X_temp, faces),
    )


def prescribed_displacement(
    X: FloatArray, X_temp: FloatArray, vertices: IntArray, weights: FloatArray, clamped: bool
) -> Displacement:
    """How far the wanted shape X_temp (n, 3) is from the permanent one X at the boundary vertices (k,).

    weights : (k,) areas of the vertices        clamped : whether the part has a clamp, whose frame counts then; of a
    part without one the best rigid motion is taken out
    """
    start = X if clamped else aligned(X, X_temp, vertices, weights)
    squared = np.sum((X_temp[vertices] - start[vertices]) ** 2, axis=1)
    return Displacement(float(np.sqrt(weights @ squared / weights.sum())), float(np.sqrt(squared.max())))


def aligned(y: FloatArray, target: FloatArray, vertices: IntArray, weights: FloatArray) -> FloatArray:
    """All of y (n, 3) after the rigid motion that brings y[vertices] closest to target[vertices]."""
    R, t = best_rigid_motion(y[vertices], target[vertices], weights)
    return y @ R.T + t


def aligned_hausdorff_distance(a: FloatArray, b: FloatArray, faces: IntArray, vertex_areas: FloatArray) -> float:
    """dist() of the paper (section 6): `hausdorff_distance` of a to b after the best rigid motion of a, mm.

    a, b : (n, 3), mm       faces : (b, 3)       vertex_areas : (n,), mm^2
    """
    on_surface = _used(faces)
    return hausdorff_distance(aligned(a, b, on_surface, vertex_areas[on_surface]), b, faces)


def hausdorff_distance(a: FloatArray, b: FloatArray, faces: IntArray) -> float:
    """Two-sided Hausdorff distance of two surfaces with the same triangles, from the vertices of each to the other, mm.

    a, b : (n, 3), mm      faces : (b, 3)
    The distance of corresponding vertices bounds that of a vertex to the other surface: vertices are visited by falling
    bound, until no bound is above the largest distance found.
    """
    on_surface = _used(faces)
    bound = np.sum((a[on_surface] - b[on_surface]) ** 2, axis=1)
    order = np.argsort(-bound, kind="stable")
    vertices, bound = on_surface[order], bound[order]
    # Triangles that are neighbours in b are neighbours in a: one order makes tight boxes for both.
    ordered = faces[spatial_order(b[faces])]
    one_way = _largest_distance(a[vertices], bound, 0.0, *box_tree(b[ordered]))
    return float(np.sqrt(_largest_distance(b[vertices], bound, one_way, *box_tree(a[ordered]))))


def surface_distances(points: FloatArray, b: FloatArray, faces: IntArray) -> FloatArray:
    """Distance (k,) of each point (k, 3) to the surface with vertices b (n, 3) and triangles `faces`, mm."""
    tree = box_tree(b[faces[spatial_order(b[faces])]])
    return np.sqrt(_distances(np.ascontiguousarray(points, dtype=np.float64), *tree))


def largest_surface_distance(points: FloatArray, b: FloatArray, faces: IntArray) -> float:
    """The largest of `surface_distances`, mm, without computing most of them.

    The distance to the nearest vertex of the surface bounds that to the surface.
    """
    bound = cKDTree(b[_used(faces)]).query(points)[0] ** 2
    order = np.argsort(-bound, kind="stable")
    tree = box_tree(b[faces[spatial_order(b[faces])]])
    return float(np.sqrt(_largest_distance(points[order], bound[order], 0.0, *tree)))


def box_tree(triangles: FloatArray) -> BoxTree:
    """The box tree of triangles (b, 3, 3), b > 0, in the order given: triangles that follow each other share boxes."""
    n_leaves = 1 << max(0, int(np.ceil(np.log2(len(triangles) / LEAF_SIZE))))
    padding = np.broadcast_to(triangles[-1], (n_leaves * LEAF_SIZE - len(triangles), 3, 3))
    corners = np.concatenate([triangles, padding])
    return BoxTree(corners, *_boxes(corners, n_leaves))


def spatial_order(triangles: FloatArray) -> IntArray:
    """Order (b,) that visits triangles (b, 3, 3) along a space-filling curve."""
    return np.argsort(_morton_codes(triangles[:, 0] + triangles[:, 1] + triangles[:, 2]), kind="stable")


def _morton_codes(points: FloatArray) -> IntArray:
    """Position (k,) of points (k, 3) along the Z-order curve of their bounding box, 20 bits an axis."""
    low = points.min(axis=0)
    size = float(np.max(points.max(axis=0) - low)) or 1.0
    cells = ((points - low) / size * (2**20 - 1)).astype(np.int64)
    for shift, mask in (
        (32, 0x1F00000000FFFF),
        (16, 0x1F0000FF0000FF),
        (8, 0x100F00F00F00F00F),
        (4, 0x10C30C30C30C30C3),
        (2, 0x1249249249249249),
    ):
        cells = (cells | (cells << shift)) & mask
    return cells[:, 0] | (cells[:, 1] << 1) | (cells[:, 2] << 2)


def _used(faces: IntArray) -> IntArray:
    """The vertices of `faces`, ascending; `np.unique` takes four times as long."""
    return np.flatnonzero(np.bincount(faces.ravel()))


@njit(cache=True)
def _boxes(corners, n_leaves):  # type: ignore[no-untyped-def]
    """Boxes of the leaves of `corners` (n_leaves * LEAF_SIZE, 3, 3) and of everything above them, as a heap."""
    lower = np.full((2 * n_leaves - 1, 3), np.inf)
    upper = np.full((2 * n_leaves - 1, 3), -np.inf)
    for i in range(len(corners)):
        node = n_leaves - 1 + i // LEAF_SIZE
        for c in range(3):
            for k in range(3):
                lower[node, k] = min(lower[node, k], corners[i, c, k])
                upper[node, k] = max(upper[node, k], corners[i, c, k])
    for node in range(n_leaves - 2, -1, -1):
        for k in range(3):
            lower[node, k] = min(lower[2 * node + 1, k], lower[2 * node + 2, k])
            upper[node, k] = max(upper[2 * node + 1, k], upper[2 * node + 2, k])
    return lower, upper


@njit(cache=True)
def _segment_distance2(p, a, b):  # type: ignore[no-untyped-def]
    """Squared distance of point p to the segment a b, all (3,)."""
    length2 = along = 0.0
    for k in range(3):
        length2 += (b[k] - a[k]) ** 2
        along += (p[k] - a[k]) * (b[k] - a[k])
    t = min(max(along / length2, 0.0), 1.0) if length2 > 0.0 else 0.0
    total = 0.0
    for k in range(3):
        total += (p[k] - a[k] - t * (b[k] - a[k])) ** 2
    return total


@njit(cache=True)
def _triangle_distance2(p, tri):  # type: ignore[no-untyped-def]
    """Squared distance of point p (3,) to the triangle tri (3, 3), which may be degenerate."""
    ux, uy, uz = tri[1, 0] - tri[0, 0], tri[1, 1] - tri[0, 1], tri[1, 2] - tri[0, 2]
    vx, vy, vz = tri[2, 0] - tri[0, 0], tri[2, 1] - tri[0, 1], tri[2, 2] - tri[0, 2]
    wx, wy, wz = p[0] - tri[0, 0], p[1] - tri[0, 1], p[2] - tri[0, 2]
    nx, ny, nz = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
    n2 = nx * nx + ny * ny + nz * nz
    # Barycentric coordinates of the projection, times n2: Ericson, Real-Time Collision Detection (2005), section 3.4.
    s = (wy * vz - wz * vy) * nx + (wz * vx - wx * vz) * ny + (wx * vy - wy * vx) * nz
    t = (uy * wz - uz * wy) * nx + (uz * wx - ux * wz) * ny + (ux * wy - uy * wx) * nz
    if n2 > 0.0 and s >= 0.0 and t >= 0.0 and s + t <= n2:
        return (wx * nx + wy * ny + wz * nz) ** 2 / n2
    return min(
        _segment_distance2(p, tri[0], tri[1]),
        _segment_distance2(p, tri[1], tri[2]),
        _segment_distance2(p, tri[2], tri[0]),
    )


@njit(cache=True)
def _box_distance2(p, lower, upper):  # type: ignore[no-untyped-def]
    """Squared distance of point p to an axis-parallel box; zero inside."""
    total = 0.0
    for k in range(3):
        gap = max(lower[k] - p[k], p[k] - upper[k], 0.0)
        total += gap * gap
    return total


@njit(cache=True)
def _nearest(p, best, enough, stack, triangles, lower, upper):  # type: ignore[no-untyped-def]
    """Squared distance of p to the triangles, at most `best`; the search ends once it is at most `enough`."""
    first_leaf = len(lower) // 2
    stack[0] = 0
    size = 1
    while size > 0 and best > enough:
        size -= 1
        node = stack[size]
        if _box_distance2(p, lower[node], upper[node]) >= best:
            continue
        if node >= first_leaf:
            start = (node - first_leaf) * LEAF_SIZE
            for k in range(start, start + LEAF_SIZE):
                best = min(best, _triangle_distance2(p, triangles[k]))
            continue
        left, right = 2 * node + 1, 2 * node + 2
        if _box_distance2(p, lower[left], upper[left]) < _box_distance2(p, lower[right], upper[right]):
            left, right = right, left
        stack[size], stack[size + 1] = left, right
        size += 2
    return best


@njit(cache=True)
def _largest_distance(points, bound, floor, triangles, lower, upper):  # type: ignore[no-untyped-def]
    """max(floor, largest squared distance of points to the triangles); `bound` (falling) is above each distance."""
    stack = np.zeros(64, np.int64)
    largest = floor
    for i in range(len(points)):
        if bound[i] <= largest:
            break
        largest = max(largest, _nearest(points[i], bound[i], largest, stack, triangles, lower, upper))
    return largest


@njit(cache=True)
def _distances(points, triangles, lower, upper):  # type: ignore[no-untyped-def]
    """Squared distance of each point to the triangles."""
    stack = np.zeros(64, np.int64)
    result = np.zeros(len(points))
    for i in range(len(points)):
        result[i] = _nearest(points[i], np.inf, 0.0, stack, triangles, lower, upper)
    return result
