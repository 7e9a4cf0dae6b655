"""Compiled edge collapses in a tet mesh of two shapes. `coarsening.py` explains them."""

from typing import Any, NamedTuple

import numpy as np
from numba import njit

from fab4d.mesh.tetmesh import BoolArray, FloatArray, IntArray

_NO_ENTRY: dict[str, Any] = {"no_cpython_wrapper": True, "no_cfunc_wrapper": True}
_inner = njit(cache=True, **_NO_ENTRY)


class Stars(NamedTuple):
    """A tet mesh with its boundary faces, and both by vertex: tets `of[first[v] : first[v + 1]]` are at vertex v."""

    tets: IntArray
    first: IntArray
    of: IntArray
    faces: IntArray
    first_face: IntArray
    face_of: IntArray


class Limits(NamedTuple):
    """What a collapse has to keep: the longest edge and the largest distance of a removed boundary vertex from the new
    surface, mm, the least turn of boundary normals as a cosine, and the least quality of tets in both shapes."""

    longest: float
    distance: float
    cosine: float
    quality: float
    quality_temp: float


@_inner
def _has(row: IntArray, v: int) -> bool:
    found = False
    for i in range(len(row)):
        found = found or row[i] == v
    return found


@_inner
def _quality(X: FloatArray, a: int, b: int, c: int, d: int) -> float:
    """Mean ratio of the tet: 1 where it is regular, 0 or less where it is flat or inverted."""
    squares, e = 0.0, np.zeros((3, 3))
    for k in range(3):
        e[0, k], e[1, k], e[2, k] = X[b, k] - X[a, k], X[c, k] - X[a, k], X[d, k] - X[a, k]
    for i in range(3):
        for k in range(3):
            squares += e[i, k] ** 2 + (e[i, k] - e[(i + 1) % 3, k]) ** 2
    volume = (
        e[0, 0] * (e[1, 1] * e[2, 2] - e[1, 2] * e[2, 1])
        - e[0, 1] * (e[1, 0] * e[2, 2] - e[1, 2] * e[2, 0])
        + e[0, 2] * (e[1, 0] * e[2, 1] - e[1, 1] * e[2, 0])
    ) / 6.0
    return 12.0 * np.sign(volume) * (3.0 * abs(volume)) ** (2.0 / 3.0) / squares


@_inner
def _tets_fit(X: FloatArray, x: FloatArray, s: Stars, v: int, u: int, limits: Limits) -> bool:
    """Whether the tets at v stay good enough in both shapes, or get no worse, when v moves to u."""
    allowed, allowed_temp = limits.quality, limits.quality_temp
    for i in range(s.first[v], s.first[v + 1]):
        a, b, c, d = s.tets[s.of[i]]
        allowed = min(allowed, _quality(X, a, b, c, d))
        allowed_temp = min(allowed_temp, _quality(x, a, b, c, d))
    for i in range(s.first[v], s.first[v + 1]):
        t = s.tets[s.of[i]]
        if _has(t, u):
            continue
        for k in range(4):
            if t[k] == v:
                continue
            length = 0.0
            for j in range(3):
                length += (X[t[k], j] - X[u, j]) ** 2
            if length > limits.longest**2:
                return False
        a, b = (u if t[0] == v else t[0]), (u if t[1] == v else t[1])
        c, d = (u if t[2] == v else t[2]), (u if t[3] == v else t[3])
        if _quality(X, a, b, c, d) < max(allowed, 1e-3) or _quality(x, a, b, c, d) < max(allowed_temp, 1e-3):
            return False
    return True


@_inner
def _links_fit(s: Stars, v: int, u: int, on_boundary: bool) -> bool:
    """The link condition: what v and u both see, vertices, edges and boundary edges, their edge sees too."""
    for i in range(s.first[v], s.first[v + 1]):
        t = s.tets[s.of[i]]
        if _has(t, u):
            continue
        for k in range(4):
            if t[k] == v:
                continue
            seen, together = False, False
            for j in range(s.first[u], s.first[u + 1]):
                other = s.tets[s.of[j]]
                if _has(other, t[k]):
                    seen = True
                    together = together or _has(other, v)
            if seen and not together:
                return False
            for m in range(k):
                if t[m] == v:
                    continue
                seen, together = False, False
                for j in range(s.first[u], s.first[u + 1]):
                    other = s.tets[s.of[j]]
                    if _has(other, t[k]) and _has(other, t[m]):
                        seen = True
                        together = together or _has(other, v)
                if seen and not together:
                    return False
    return not on_boundary or _boundary_links_fit(s, v, u)


@_inner
def _boundary_links_fit(s: Stars, v: int, u: int) -> bool:
    shared = 0
    for i in range(s.first_face[v], s.first_face[v + 1]):
        f = s.faces[s.face_of[i]]
        if _has(f, u):
            shared += 1
            continue
        for k in range(3):
            if f[k] == v:
                continue
            seen, together = False, False
            for j in range(s.first_face[u], s.first_face[u + 1]):
                other = s.faces[s.face_of[j]]
                if _has(other, f[k]):
                    seen = True
                    together = together or _has(other, v)
            if seen and not together:
                return False
    return shared == 2


@_inner
def _normal(X: FloatArray, a: int, b: int, c: int, out: FloatArray) -> float:
    """Writes the unit normal; returns twice the area."""
    for k in range(3):
        i, j = (k + 1) % 3, (k + 2) % 3
        out[k] = (X[b, i] - X[a, i]) * (X[c, j] - X[a, j]) - (X[b, j] - X[a, j]) * (X[c, i] - X[a, i])
    length = np.sqrt(out[0] ** 2 + out[1] ** 2 + out[2] ** 2)
    for k in range(3):
        out[k] /= max(length, 1e-300)
    return length


@_inner
def _surface_fits(X: FloatArray, s: Stars, v: int, u: int, limits: Limits) -> bool:
    """Whether the boundary faces at v keep their direction, and pass near v, when v moves to u."""
    before, after = np.zeros(3), np.zeros(3)
    for i in range(s.first_face[v], s.first_face[v + 1]):
        f = s.faces[s.face_of[i]]
        if _has(f, u):
            continue
        a, b, c = (u if f[0] == v else f[0]), (u if f[1] == v else f[1]), (u if f[2] == v else f[2])
        _normal(X, f[0], f[1], f[2], before)
        _normal(X, a, b, c, after)
        cosine, off = 0.0, 0.0
        for k in range(3):
            cosine += before[k] * after[k]
            off += after[k] * (X[v, k] - X[u, k])
        if cosine < limits.cosine or abs(off) > limits.distance:
            return False
    return True


@njit(cache=True)
def collapse(
    X: FloatArray,
    x: FloatArray,
    s: Stars,
    edges: IntArray,
    group: IntArray,
    limits: Limits,
    gone: BoolArray,
    changed: BoolArray,
) -> int:
    """Collapse edges in turn where the mesh stays good; returns how many.

    X, x (n, 3) : both shapes        s.tets is changed, and tets that vanish are marked in gone (m,)
    group : (n,) vertices move only to those of the same group
    changed : (n,) is set at the vertices of changed tets; these stay as they are in the same call, as their stars are
    no longer known
    """
    count = 0
    for e in range(len(edges)):
        for way in range(2):
            v, u = edges[e, way], edges[e, 1 - way]
            if changed[v] or changed[u] or group[v] != group[u]:
                continue
            on_boundary = s.first_face[v + 1] > s.first_face[v]
            if on_boundary and s.first_face[u + 1] == s.first_face[u]:
                continue
            if not _links_fit(s, v, u, on_boundary) or (on_boundary and not _surface_fits(X, s, v, u, limits)):
                continue
            if not _tets_fit(X, x, s, v, u, limits):
                continue
            for i in range(s.first[v], s.first[v + 1]):
                t = s.of[i]
                gone[t] = _has(s.tets[t], u)
                for k in range(4):
                    changed[s.tets[t, k]] = True
                    if s.tets[t, k] == v:
                        s.tets[t, k] = u
            count += 1
            break
    return count
