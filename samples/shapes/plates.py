"""Flat plates of any outline: near-equilateral triangles in the plane, thickened to prisms and tets."""

import numpy as np
from numpy.typing import ArrayLike

from fab4d.mesh.tetmesh import FloatArray, IntArray
from shapes.boxes import Body, compacted, positively_oriented
from shapes.stuffing import cut_points, moved_onto_surface

# A lattice vertex moves onto the outline when the outline cuts an edge at it nearer than this share of the edge.
NEAR = 0.4


def triangle_lattice(low: FloatArray, high: FloatArray, h: float) -> tuple[FloatArray, IntArray]:
    """Vertices (n, 2) and triangles of side `h` that cover the box and one row more on every side."""
    rise = h * np.sqrt(0.75)
    columns, rows = (int(np.ceil(n)) + 3 for n in (high - low) / [h, rise])
    j, i = np.indices((rows + 1, columns + 1)).reshape(2, -1)
    start = 0.5 * (low + high) - 0.5 * np.array([columns * h, rows * rise])
    X = start + np.column_stack([h * (i + 0.5 * (j % 2)), rise * j])
    a = (np.arange(columns) + (columns + 1) * np.arange(rows)[:, None]).ravel()
    b, c, d = a + 1, a + columns + 1, a + columns + 2
    even = (np.repeat(np.arange(rows), columns) % 2 == 0)[:, None]
    lower = np.where(even, np.column_stack([a, b, c]), np.column_stack([a, b, d]))
    upper = np.where(even, np.column_stack([b, d, c]), np.column_stack([a, d, c]))
    return X, np.concatenate([lower, upper])


def outline_triangles(body: Body, low: ArrayLike, high: ArrayLike, h: float) -> tuple[FloatArray, IntArray]:
    """Vertices (n, 2) and triangles of the plane region where `body` is positive, from triangles of side `h`, mm."""
    X, triangles = triangle_lattice(np.asarray(low, np.float64), np.asarray(high, np.float64), h)
    signs = np.sign(body(X)).astype(np.int64)
    edges = np.unique(np.sort(triangles[:, [[0, 1], [1, 2], [0, 2]]].reshape(-1, 2), axis=1), axis=0)
    edges = edges[signs[edges[:, 0]] * signs[edges[:, 1]] < 0]
    cuts = cut_points(body, X, edges, signs)
    X, signs = moved_onto_surface(X, signs, edges, np.full(len(edges), NEAR), cuts)
    cut_edges = signs[edges[:, 0]] * signs[edges[:, 1]] < 0
    pieces = _pieces(triangles, signs, edges[cut_edges], len(X))
    return compacted(np.vstack([X, cuts[cut_edges]]), pieces)


def _pieces(triangles: IntArray, signs: IntArray, cut_edges: IntArray, first_cut: int) -> IntArray:
    """Triangles of the inner parts; cut k of `cut_edges` is vertex first_cut + k."""
    cut_of = {(a, b): first_cut + k for k, (a, b) in enumerate(cut_edges.tolist())}
    result = triangles[np.all(signs[triangles] >= 0, axis=1) & np.any(signs[triangles] > 0, axis=1)].tolist()
    mixed = triangles[np.any(signs[triangles] > 0, axis=1) & np.any(signs[triangles] < 0, axis=1)]
    for corners in mixed.tolist():
        result += _cut_triangle(corners, signs, cut_of)
    return np.array(result)


def _cut_triangle(corners: list[int], signs: IntArray, cut_of: dict[tuple[int, int], int]) -> list[list[int]]:
    """The inner part of a triangle with vertices on both sides: one triangle or two."""

    def cut(a: int, b: int) -> int:
        return cut_of[min(a, b), max(a, b)]

    plus = [v for v in corners if signs[v] > 0]
    minus = [v for v in corners if signs[v] < 0]
    if len(plus) == 1:
        return [[v if signs[v] >= 0 else cut(plus[0], v) for v in corners]]
    (a, b), c = plus, minus[0]
    return [[a, b, cut(b, c)], [a, cut(b, c), cut(a, c)]]


def thickened(X: FloatArray, triangles: IntArray, thickness: float, layers: int) -> tuple[FloatArray, IntArray]:
    """Tets of the plate from z = 0 to `thickness`: three for each triangle and layer."""
    n = len(X)
    points = np.vstack([np.column_stack([X, np.full(n, thickness * k / layers)]) for k in range(layers + 1)])
    a, b, c = np.sort(triangles, axis=1).T
    prism = np.concatenate(
        [np.column_stack(t) for t in ((a, b, c, c + n), (a, b, b + n, c + n), (a, a + n, b + n, c + n))]
    )
    tets = np.concatenate([prism + n * k for k in range(layers)])
    return points, positively_oriented(points, tets)
