"""A lattice tower on four feet: legs, rings and diagonals, each one cell thick, on a footprint that narrows upwards."""

from itertools import pairwise

import numpy as np

from fab4d.mesh.tetmesh import FloatArray, IntArray
from shapes.boxes import Body, cell_corners, merged, six_tets
from shapes.implicit import capsule, filleted

HEIGHT, BAYS, LAYERS = 200.0, 12, 3
FOOT = 1  # layers below the first bay
PLATFORMS = (2, 6, 11)  # bays that end in a floor instead of a ring
SIDE = 5  # cells along a side: a leg, three of the opening, a leg


def width(z: FloatArray) -> FloatArray:
    """Width of the footprint at height z, mm."""
    return 15.0 + 61.0 * np.exp(-z / 62.0)


def strut(z: FloatArray) -> FloatArray:
    """Thickness of the struts at height z, mm."""
    return 2.0 + 0.09 * width(z)


def layer_heights() -> FloatArray:
    """Heights of the layer boundaries, mm: a foot, then bays of three leg layers and a ring, each lower than before."""
    bay = np.array([0.28, 0.28, 0.28, 0.16])
    parts = np.r_[np.full(FOOT, 0.2), np.concatenate([bay * 0.93**b for b in range(BAYS)])]
    return np.r_[0.0, np.cumsum(parts)] * HEIGHT / parts.sum()


def _layer_cells(layer: int, keep: str) -> IntArray:
    """Cells of one layer: the four `legs`, the `ring` along the sides, or the whole `floor`."""
    i, j = np.indices((SIDE, SIDE)).reshape(2, -1)
    edge_i, edge_j = i % (SIDE - 1) == 0, j % (SIDE - 1) == 0
    mask = {"legs": edge_i & edge_j, "ring": edge_i | edge_j, "floor": np.ones(SIDE * SIDE, bool)}[keep]
    return np.column_stack([i, j, np.full(SIDE * SIDE, layer)])[mask]


def _diagonal(bottom: int, side: int, rising: bool) -> FloatArray:
    """Corners (3, 8, 3) of a strut in the opening of one side, from a leg's lowest layer to the other leg's highest."""
    column = np.arange(1, SIDE - 1)
    corners = cell_corners(np.column_stack([column, np.zeros_like(column), np.full_like(column, bottom)]))
    run = (corners[..., 0] - 1.0) / (SIDE - 2)
    corners[..., 2] += (LAYERS - 1) * (run if rising else 1.0 - run)
    if side % 2:
        corners[..., 1] += SIDE - 1
    # Sides 2 and 3 lie along y: x and y change places, and the corners with them, so that cell axes stay x, y, z.
    return corners if side < 2 else corners[:, [0, 2, 1, 3, 4, 6, 5, 7]][..., [1, 0, 2]]


def _bay(number: int) -> list[FloatArray]:
    """Corners of the cells of one bay."""
    bottom = FOOT + number * (LAYERS + 1)
    legs = [_layer_cells(bottom + k, "legs") for k in range(LAYERS)]
    top = _layer_cells(bottom + LAYERS, "floor" if number in PLATFORMS else "ring")
    diagonals = [_diagonal(bottom, side, rising=(number + side) % 2 == 0) for side in range(4)]
    return [cell_corners(cells) for cells in [*legs, top]] + diagonals


def _line(index: FloatArray, z: FloatArray) -> FloatArray:
    """Coordinate of grid line `index` (0..SIDE) at height z, mm: a leg's thickness at both ends, the rest even."""
    half, thick = 0.5 * width(z), strut(z)
    inner = half - thick
    between = -inner + (index - 1.0) / (SIDE - 2) * 2.0 * inner
    return np.where(index < 0.5, -half, np.where(index > SIDE - 0.5, half, between))


def lattice_tower() -> tuple[FloatArray, IntArray]:
    """Vertices (n, 3), mm, and tets (m, 4) of the tower; its foot stands on z = 0, its axis is z."""
    foot = [cell_corners(_layer_cells(k, "legs")) for k in range(FOOT)]
    places, hexes = merged(np.concatenate(foot + [c for b in range(BAYS) for c in _bay(b)]))
    heights = layer_heights()
    z = np.interp(places[:, 2], np.arange(len(heights)), heights)
    X = np.column_stack([_line(places[:, 0], z), _line(places[:, 1], z), z])
    return X, six_tets(X, hexes)


# The tower of round struts: half width of the footprint at bottom and top, heights of its rings, mm.
BOTTOM, TOP, RINGS = 34.0, 11.0, (0.0, 52.0, 98.0, 138.0, 170.0, 196.0)

FILLET = 5.0


def _corner(z: float, i: int, j: int) -> tuple[float, float, float]:
    half = BOTTOM + (TOP - BOTTOM) * z / RINGS[-1]
    return (i * half, j * half, z)


def round_struts() -> Body:
    """A tower of four round legs, rings and one diagonal in each opening; it stands on z = 0."""
    sides = [((-1, -1), (1, -1)), ((1, -1), (1, 1)), ((1, 1), (-1, 1)), ((-1, 1), (-1, -1))]
    parts = [capsule(_corner(0.0, *a), _corner(RINGS[-1], *a), 5.5, 5.0) for a, _ in sides]
    for below, above in pairwise(RINGS):
        for number, (a, b) in enumerate(sides):
            parts.append(capsule(_corner(above, *a), _corner(above, *b), 4.8))
            ends = (a, b) if (number + RINGS.index(above)) % 2 else (b, a)
            parts.append(capsule(_corner(below, *ends[0]), _corner(above, *ends[1]), 4.8))
    whole = filleted(FILLET, *parts)
    return lambda P: np.minimum(whole(P), P[:, 2])
