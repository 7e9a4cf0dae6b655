"""Irregular tet meshes of implicit bodies by isosurface stuffing.

Source: Labelle, Shewchuk, Isosurface Stuffing, ACM Trans. Graph. 26 (2007) 57. The background is a body-centred cubic
lattice. A tet of it is (0, 1, 2, 3): 0-1 joins two cell centres and 2-3 two cell corners (the long edges, k and k ^ 1),
the other four edges are short.
"""

from itertools import product

import numpy as np
from numpy.typing import ArrayLike

from fab4d.mesh.tetmesh import BoolArray, FloatArray, IntArray
from fab4d.mesh.topology import TET_EDGES
from shapes.boxes import Body, compacted, grid_cells, grid_vertices, positively_oriented

# A lattice vertex moves onto the surface when the surface cuts an edge at it nearer than this share of the edge.
NEAR_LONG, NEAR_SHORT = 0.24999, 0.41189
BISECTIONS = 40

Corner = int | tuple[int, int]
"""A vertex of a lattice tet, or the cut of its edge from a vertex inside to one outside."""


def bcc_lattice(low: FloatArray, high: FloatArray, h: FloatArray) -> tuple[FloatArray, IntArray]:
    """Vertices and tets of the lattice with cells `h` (3,) that covers the box and one cell more on every side."""
    shape = np.ceil((high - low) / h).astype(int) + 2
    start = 0.5 * (low + high) - 0.5 * shape * h
    corners = grid_vertices(*(start[a] + h[a] * np.arange(shape[a] + 1) for a in range(3)))
    centres = start + h * (grid_cells((shape[0], shape[1], shape[2])) + 0.5)
    tets = np.concatenate([_tets_across(axis, shape, len(corners)) for axis in range(3)])
    return np.vstack([corners, centres]), tets


def _tets_across(axis: int, shape: IntArray, n_corners: int) -> IntArray:
    """The four tets around each face between two cells that are neighbours along `axis`."""
    cells = grid_cells((shape[0], shape[1], shape[2]))
    cells = cells[cells[:, axis] < shape[axis] - 1]
    unit, (one, two) = np.eye(3, dtype=np.int64), [a for a in range(3) if a != axis]
    centre = n_corners + cells @ np.array([1, shape[0], shape[0] * shape[1]])
    step = np.array([1, shape[0], shape[0] * shape[1]])[axis]
    strides = np.array([1, shape[0] + 1, (shape[0] + 1) * (shape[1] + 1)])
    face = cells + unit[axis]
    edges = [(0, unit[one]), (0, unit[two]), (unit[one], unit[one] + unit[two]), (unit[two], unit[one] + unit[two])]
    rows = [np.column_stack([centre, centre + step, (face + a) @ strides, (face + b) @ strides]) for a, b in edges]
    return np.concatenate(rows)


def stuffed(body: Body, low: ArrayLike, high: ArrayLike, h: ArrayLike) -> tuple[FloatArray, IntArray]:
    """Vertices (n, 3) and tets (m, 4) of `body` inside the box low..high, from lattice cells of size `h` (mm)."""
    cell = np.broadcast_to(np.asarray(h, np.float64), 3)
    X, tets = bcc_lattice(np.asarray(low, np.float64), np.asarray(high, np.float64), cell)
    values = body(X)
    tets = tets[np.any(values[tets] > 0, axis=1)]
    X, tets = compacted(X, tets)
    return cut_lattice(body, X, tets)


def cut_lattice(body: Body, X: FloatArray, tets: IntArray) -> tuple[FloatArray, IntArray]:
    """The part of lattice tets that lies inside `body`: warp vertices onto the surface, then cut along it."""
    signs = np.sign(body(X)).astype(np.int64)
    edges, is_long = _lattice_edges(tets)
    edges, is_long = _crossing(edges, is_long, signs)
    cuts = cut_points(body, X, edges, signs)
    X, signs = moved_onto_surface(X, signs, edges, np.where(is_long, NEAR_LONG, NEAR_SHORT), cuts)
    kept = signs[edges[:, 0]] * signs[edges[:, 1]] < 0
    points, pieces = np.vstack([X, cuts[kept]]), _pieces(tets, signs, edges[kept], len(X))
    points, pieces = compacted(points, pieces)
    return points, positively_oriented(points, pieces)


def _lattice_edges(tets: IntArray) -> tuple[IntArray, BoolArray]:
    """Edges (e, 2), smaller vertex first, and whether each is a long one."""
    ends = np.sort(tets[:, TET_EDGES].reshape(-1, 2), axis=1)
    is_long = np.tile(TET_EDGES[:, 0] ^ 1 == TET_EDGES[:, 1], len(tets))
    edges, first = np.unique(ends, axis=0, return_index=True)
    return edges, is_long[first]


def _crossing(edges: IntArray, is_long: BoolArray, signs: IntArray) -> tuple[IntArray, BoolArray]:
    crossing = signs[edges[:, 0]] * signs[edges[:, 1]] < 0
    return edges[crossing], is_long[crossing]


def cut_points(body: Body, X: FloatArray, edges: IntArray, signs: IntArray) -> FloatArray:
    """The point of each edge on the surface, by bisection."""
    inner = np.where(signs[edges[:, 0]] > 0, edges[:, 0], edges[:, 1])
    inside, outside = X[inner], X[edges.sum(axis=1) - inner]
    for _ in range(BISECTIONS):
        middle = 0.5 * (inside + outside)
        positive = (body(middle) > 0)[:, None]
        inside, outside = np.where(positive, middle, inside), np.where(positive, outside, middle)
    return 0.5 * (inside + outside)


def moved_onto_surface(
    X: FloatArray, signs: IntArray, edges: IntArray, limits: FloatArray, cuts: FloatArray
) -> tuple[FloatArray, IntArray]:
    """Positions and signs after each vertex that is too near to a cut has moved onto its nearest one.

    limits : (e,) share of the edge that is too near. One vertex after the other: moving one ends its other cuts.
    """
    X, signs = X.copy(), signs.copy()
    lengths = np.linalg.norm(X[edges[:, 0]] - X[edges[:, 1]], axis=1)
    near = np.linalg.norm(cuts[:, None] - X[edges], axis=2) / lengths[:, None]
    rows, ends = np.nonzero(near < limits[:, None])
    order = np.lexsort([rows, near[rows, ends], edges[rows, ends]])
    for row, end in zip(rows[order], ends[order], strict=True):
        vertex, other = edges[row, end], edges[row, 1 - end]
        if signs[vertex] and signs[other]:
            X[vertex], signs[vertex] = cuts[row], 0
    return X, signs


def _pieces(tets: IntArray, signs: IntArray, cut_edges: IntArray, first_cut: int) -> IntArray:
    """Tets (m, 4) of the inner parts; cut k of `cut_edges` is vertex first_cut + k."""
    keys = cut_edges @ np.array([first_cut, 1])  # ascending, as the edges are sorted
    result = [np.zeros((0, 4), np.int64)]
    for pattern in product((-1, 0, 1), repeat=4):
        rows = tets[np.all(signs[tets] == pattern, axis=1)]
        result += [np.column_stack([_vertices(rows, c, keys, first_cut) for c in piece]) for piece in stencil(pattern)]
    return np.concatenate(result)


def _vertices(rows: IntArray, corner: Corner, keys: IntArray, first_cut: int) -> IntArray:
    """The vertex of each row of `rows` that `corner` stands for."""
    if isinstance(corner, int):
        return rows[:, corner]
    ends = np.sort(rows[:, list(corner)], axis=1)
    return first_cut + np.searchsorted(keys, ends @ np.array([first_cut, 1]))


def stencil(signs: tuple[int, ...]) -> list[tuple[Corner, ...]]:
    """Tets that fill the positive part of a lattice tet whose vertices have `signs`.

    A face with two positive vertices is left a quadrilateral. Its diagonal starts at the positive vertex whose cut edge
    is long, or at the lower one when both are short, so that the two tets at the face agree.
    """
    plus, minus = ([k for k in range(4) if signs[k] == side] for side in (1, -1))
    if not plus or not minus:
        return [(0, 1, 2, 3)] if plus else []
    if len(plus) == 1:
        return [tuple((plus[0], k) if k in minus else k for k in range(4))]
    if len(plus) == 3:
        return _one_outside(minus[0])
    return _two_and_two(plus, minus) if len(minus) == 2 else _two_one_and_zero(plus, minus[0])


def _one_outside(c: int) -> list[tuple[Corner, ...]]:
    others = [k for k in range(4) if k not in (c, c ^ 1)]
    top: list[Corner] = [c ^ 1, *others]
    return _prism(top, [(k, c) for k in (c ^ 1, *others)])


def _two_and_two(plus: list[int], minus: list[int]) -> list[tuple[Corner, ...]]:
    p, r = plus
    if p ^ 1 == r:
        a, b = minus
        return _prism([p, (p, a), (p, b)], [r, (r, a), (r, b)])
    q, s = p ^ 1, r ^ 1
    return _prism([(p, s), p, (p, q)], [(r, s), r, (r, q)])


def _two_one_and_zero(plus: list[int], c: int) -> list[tuple[Corner, ...]]:
    a, b = plus if plus[1] ^ 1 != c else plus[::-1]
    zero = 6 - a - b - c
    return [(zero, a, b, (b, c)), (zero, a, (b, c), (a, c))]


def _prism(top: list[Corner], bottom: list[Corner]) -> list[tuple[Corner, ...]]:
    """A prism with diagonals from the first top corner to the two other bottom ones and the second to the third."""
    (a, b, c), (a2, b2, c2) = top, bottom
    return [(a, b, c, c2), (a, b, b2, c2), (a, a2, b2, c2)]
