"""Tet meshes from hexahedral cells.

A hexahedron is eight vertices in bit order: corner k lies at (k & 1, k >> 1 & 1, k >> 2) of the cell's own axes.
"""

from collections.abc import Callable
from itertools import permutations

import numpy as np
from numpy.typing import ArrayLike

from fab4d.mesh.measures import tet_volumes
from fab4d.mesh.tetmesh import BoolArray, FloatArray, IntArray

Body = Callable[[FloatArray], FloatArray]
"""Maps points (n, d) to values (n,), positive inside."""

CORNERS = np.array([[k & 1, k >> 1 & 1, k >> 2] for k in range(8)])
# One tet for each order in which the three axes can be walked from corner 0 to corner 7 (Kuhn's division).
SIX_TETS = np.array([[0, 1 << a, (1 << a) + (1 << b), 7] for a, b, _ in permutations(range(3))])
# A tet on every second corner and one cut off at each of the others; neighbours must alternate between the two.
FIVE_TETS = np.array(
    [
        [[0, 3, 5, 6], [1, 0, 3, 5], [2, 0, 3, 6], [4, 0, 5, 6], [7, 3, 5, 6]],
        [[1, 2, 4, 7], [0, 1, 2, 4], [3, 1, 2, 7], [5, 1, 4, 7], [6, 2, 4, 7]],
    ]
)


def grid_vertices(xs: FloatArray, ys: FloatArray, zs: FloatArray) -> FloatArray:
    """Vertices (n, 3) of the grid with lines at xs, ys, zs; x runs fastest."""
    z, y, x = np.meshgrid(zs, ys, xs, indexing="ij")
    return np.column_stack([x.ravel(), y.ravel(), z.ravel()])


def grid_cells(shape: tuple[int, int, int]) -> IntArray:
    """Cell numbers (c, 3) along x, y, z of a grid of `shape` cells; x runs fastest."""
    k, j, i = np.indices(shape[::-1]).reshape(3, -1)
    return np.column_stack([i, j, k])


def grid_hexes(shape: tuple[int, int, int]) -> IntArray:
    """Hexahedra (c, 8) of a grid of `shape` cells, in the vertex order of `grid_vertices`."""
    strides = np.array([1, shape[0] + 1, (shape[0] + 1) * (shape[1] + 1)])
    return (grid_cells(shape) @ strides)[:, None] + CORNERS @ strides


def positively_oriented(X: FloatArray, tets: IntArray) -> IntArray:
    """`tets` with the last two vertices swapped where the volume is negative."""
    flipped = tets.copy()
    negative = tet_volumes(X, tets) < 0
    flipped[negative, 2], flipped[negative, 3] = tets[negative, 3], tets[negative, 2]
    return flipped


def six_tets(X: FloatArray, hexes: IntArray) -> IntArray:
    """Six tets for each hexahedron. Faces match when neighbours run their axes the same way along the shared face."""
    return positively_oriented(X, hexes[:, SIX_TETS].reshape(-1, 4))


def five_tets(X: FloatArray, hexes: IntArray, cells: IntArray) -> IntArray:
    """Five tets for each hexahedron; `cells` (c, 3) are the cell numbers, whose parity chooses the division."""
    parity = cells.sum(axis=1) % 2
    return positively_oriented(X, hexes[np.arange(len(hexes))[:, None, None], FIVE_TETS[parity]].reshape(-1, 4))


def compacted(X: FloatArray, cells: IntArray) -> tuple[FloatArray, IntArray]:
    """Without the vertices that no cell uses."""
    used, inverse = np.unique(cells, return_inverse=True)
    return X[used], inverse.reshape(cells.shape)


def box(size: tuple[float, float, float], shape: tuple[int, int, int], division: str) -> tuple[FloatArray, IntArray]:
    """A box from the origin to `size` in `shape` cells, each divided into `five` or `six` tets."""
    X = grid_vertices(*(np.linspace(0.0, length, n + 1) for length, n in zip(size, shape, strict=True)))
    hexes = grid_hexes(shape)
    return X, six_tets(X, hexes) if division == "six" else five_tets(X, hexes, grid_cells(shape))


def merged(corners: FloatArray) -> tuple[FloatArray, IntArray]:
    """Vertices and hexahedra (c, 8) of cells given by `corners` (c, 8, 3); corners equal to 1e-6 become one vertex."""
    places, inverse = np.unique(np.round(corners.reshape(-1, 3), 6), axis=0, return_inverse=True)
    first = np.zeros(len(places), np.int64)
    first[inverse.ravel()[::-1]] = np.arange(len(inverse.ravel()))[::-1]
    return corners.reshape(-1, 3)[first], inverse.reshape(-1, 8)


def cell_corners(cells: IntArray) -> FloatArray:
    """Corners (c, 8, 3) of unit cells at the cell numbers `cells` (c, 3)."""
    return (cells[:, None, :] + CORNERS).astype(np.float64)


def filled(body: Body, low: ArrayLike, high: ArrayLike, cell: ArrayLike) -> tuple[FloatArray, IntArray]:
    """Five tets for each of the cells (size `cell`, mm) of the box low..high whose centre lies inside `body`."""
    start, size = np.asarray(low, np.float64), np.broadcast_to(np.asarray(cell, np.float64), 3)
    n = np.ceil((np.asarray(high) - start) / size - 1e-9).astype(int)
    shape = (int(n[0]), int(n[1]), int(n[2]))
    cells = grid_cells(shape)
    inside = without_edge_contacts((body(start + size * (cells + 0.5)) > 0).reshape(shape[::-1])).ravel()
    X = grid_vertices(*(start[a] + size[a] * np.arange(n[a] + 1) for a in range(3)))
    X, hexes = compacted(X, grid_hexes(shape)[inside])
    return X, five_tets(X, hexes, cells[inside])


def without_edge_contacts(inside: BoolArray) -> BoolArray:
    """`inside` with cells added until no two cells touch along an edge alone."""
    grown = inside.copy()
    for axis in range(3):
        planes = np.moveaxis(grown, axis, 0)
        a, b, c, d = planes[:, :-1, :-1], planes[:, 1:, :-1], planes[:, :-1, 1:], planes[:, 1:, 1:]
        rising, falling = a & d & ~b & ~c, b & c & ~a & ~d
        b |= rising
        a |= falling
    return grown if np.array_equal(grown, inside) else without_edge_contacts(grown)
