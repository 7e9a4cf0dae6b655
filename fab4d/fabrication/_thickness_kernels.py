"""Compiled search for balls that fit into one material of a tet mesh, walking from tet to tet."""

from typing import NamedTuple

import numpy as np
from numba import njit

from fab4d.mesh.tetmesh import BoolArray, FloatArray, IntArray

Point = tuple[float, float, float]
RADIUS, ENOUGH = 0.5, 0.9 * 0.5
# A ball of the material also stands for the corner of a box around it.
CORNER_REACH = np.sqrt(3.0)
FIRST_STEP, LAST_STEP = 0.25, 0.02


class Solid(NamedTuple):
    """A tet mesh scaled so that the smallest feature is 1, and the material that balls must stay in."""

    X: FloatArray
    tets: IntArray
    neighbours: IntArray
    """(m, 4) the tet across the face opposite to each corner, -1 outside."""
    inside: BoolArray
    stamp: IntArray
    """(m + 1,) the last entry counts."""
    stack: IntArray


@njit(cache=True)
def _at(X: FloatArray, i: int) -> Point:
    return X[i, 0], X[i, 1], X[i, 2]


@njit(cache=True)
def _dot(a: Point, b: Point) -> float:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@njit(cache=True)
def _add(a: Point, s: float, b: Point) -> Point:
    """a + s b."""
    return a[0] + s * b[0], a[1] + s * b[1], a[2] + s * b[2]


@njit(cache=True)
def _squared_distance(a: Point, b: Point) -> float:
    gap = _add(a, -1.0, b)
    return _dot(gap, gap)


@njit(cache=True)
def _nearest_on_segment(p: Point, a: Point, b: Point) -> Point:
    along = _add(b, -1.0, a)
    t = _dot(_add(p, -1.0, a), along) / _dot(along, along)
    return _add(a, min(1.0, max(0.0, t)), along)


@njit(cache=True)
def nearest_on_triangle(p: Point, a: Point, b: Point, c: Point) -> Point:
    """The point of triangle a, b, c that is nearest to p: its foot if that lies inside, else on the nearest edge."""
    u, v, w = _add(b, -1.0, a), _add(c, -1.0, a), _add(p, -1.0, a)
    uu, uv, vv, wu, wv = _dot(u, u), _dot(u, v), _dot(v, v), _dot(w, u), _dot(w, v)
    area = uu * vv - uv * uv
    s, t = vv * wu - uv * wv, uu * wv - uv * wu
    if area > 0 and s >= 0 and t >= 0 and s + t <= area:
        return _add(_add(a, s / area, u), t / area, v)
    best = _nearest_on_segment(p, a, b)
    for q in (_nearest_on_segment(p, b, c), _nearest_on_segment(p, c, a)):
        if _squared_distance(p, q) < _squared_distance(p, best):
            best = q
    return best


@njit(cache=True)
def _nearest_on_face(p: Point, tet: int, corner: int, solid: Solid) -> Point:
    v = solid.tets[tet]
    a, b, c = v[(corner + 1) % 4], v[(corner + 2) % 4], v[(corner + 3) % 4]
    return nearest_on_triangle(p, _at(solid.X, a), _at(solid.X, b), _at(solid.X, c))


@njit(cache=True)
def _clearance(p: Point, start: int, solid: Solid) -> tuple:
    """Distance of p from the nearest wall (at most RADIUS) and the point of the wall there."""
    solid.stamp[-1] += 1
    stamp = solid.stamp[-1]
    solid.stack[0], solid.stamp[start] = start, stamp
    count, done, clearance, wall = 1, 0, RADIUS, p
    while done < count:
        tet = solid.stack[done]
        done += 1
        for corner in range(4):
            other = solid.neighbours[tet, corner]
            if other >= 0 and solid.stamp[other] == stamp:
                continue
            q = _nearest_on_face(p, tet, corner, solid)
            distance = np.sqrt(_squared_distance(p, q))
            if distance >= clearance:
                continue
            if other < 0 or not solid.inside[other]:
                clearance, wall = distance, q
            else:
                solid.stamp[other] = stamp
                solid.stack[count] = other
                count += 1
    return clearance, wall


@njit(cache=True)
def _connected(p: Point, start: int, radius: float, solid: Solid) -> int:
    """Gather in solid.stack the tets of the material that are nearer to p than `radius` and joined to `start` there."""
    solid.stamp[-1] += 1
    stamp = solid.stamp[-1]
    solid.stack[0], solid.stamp[start] = start, stamp
    count, done = 1, 0
    while done < count:
        tet = solid.stack[done]
        done += 1
        for corner in range(4):
            other = solid.neighbours[tet, corner]
            if other < 0 or solid.stamp[other] == stamp or not solid.inside[other]:
                continue
            if _squared_distance(p, _nearest_on_face(p, tet, corner, solid)) < radius * radius:
                solid.stamp[other] = stamp
                solid.stack[count] = other
                count += 1
    return count


@njit(cache=True)
def _height(p: Point, tet: int, corner: int, solid: Solid) -> float:
    """Signed volume factor of p over the face opposite to `corner`, positive on the tet's side."""
    v = solid.tets[tet]
    a = _at(solid.X, v[(corner + 1) % 4])
    b = _add(_at(solid.X, v[(corner + 2) % 4]), -1.0, a)
    c = _add(_at(solid.X, v[(corner + 3) % 4]), -1.0, a)
    normal = b[1] * c[2] - b[2] * c[1], b[2] * c[0] - b[0] * c[2], b[0] * c[1] - b[1] * c[0]
    side = _dot(_add(_at(solid.X, v[corner]), -1.0, a), normal)
    return _dot(_add(p, -1.0, a), normal) * np.sign(side)


@njit(cache=True)
def _walk(p: Point, tet: int, solid: Solid) -> int:
    """The tet of the same material that holds p, found by crossing faces from `tet`; -1 when a wall is in between."""
    for _ in range(200):
        worst, lowest = -1, 0.0
        for corner in range(4):
            height = _height(p, tet, corner, solid)
            if height < lowest:
                worst, lowest = corner, height
        if worst < 0:
            return tet
        tet = solid.neighbours[tet, worst]
        if tet < 0 or not solid.inside[tet]:
            return -1
    return -1


@njit(cache=True)
def _climb(p: Point, tet: int, solid: Solid) -> tuple:
    """Move p away from its nearest wall while that gives room for a larger ball: centre, its tet, clearance."""
    clearance, wall = _clearance(p, tet, solid)
    step = FIRST_STEP
    while clearance < RADIUS and clearance > 0 and step > LAST_STEP:
        trial = _add(p, step / clearance, _add(p, -1.0, wall))
        home = _walk(trial, tet, solid)
        if home >= 0:
            larger, next_wall = _clearance(trial, home, solid)
            if larger > clearance:
                p, tet, clearance, wall = trial, home, larger, next_wall
                continue
        step *= 0.5
    return p, tet, clearance


@njit(cache=True)
def covered_points(points: FloatArray, tested: BoolArray, solid: Solid) -> BoolArray:
    """Which of the points (m, k, 3) of the tets `tested` lie in a ball of the material that is large enough.

    The centres are searched from the points themselves, so every ball found covers its neighbours too.
    """
    m, k, _ = points.shape
    covered = np.zeros((m, k), np.bool_)
    for tet in range(m):
        for i in range(k):
            if tested[tet] and solid.inside[tet] and not covered[tet, i]:
                centre, home, clearance = _climb(_at(points[tet], i), tet, solid)
                if clearance >= ENOUGH:
                    _cover(centre, home, clearance, points, covered, solid)
    return covered


@njit(cache=True)
def _cover(centre: Point, home: int, radius: float, points: FloatArray, covered: BoolArray, solid: Solid) -> None:
    """Mark the points near the ball, as far as a box around it would reach, that are connected to it."""
    count = _connected(centre, home, CORNER_REACH * radius, solid)
    limit = (CORNER_REACH * radius) ** 2 * (1 + 1e-9)
    for tet in solid.stack[:count]:
        for i in range(points.shape[1]):
            covered[tet, i] = covered[tet, i] or _squared_distance(_at(points[tet], i), centre) <= limit
