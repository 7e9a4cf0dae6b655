"""Three tapering legs on a hexagonal hub."""

import numpy as np

from fab4d.mesh.tetmesh import FloatArray, IntArray
from shapes.boxes import CORNERS, grid_cells, merged, six_tets

RADIUS, THICKNESS, REACH, TIP = 15.0, 9.0, 72.0, 0.65
ACROSS, THROUGH, ALONG = 3, 3, 27
SPOKES = np.radians([0.0, 120.0, 240.0])
DIRECTIONS = SPOKES + np.radians(30.0)
APOTHEM = RADIUS * np.sqrt(0.75)


def _block(shape: tuple[int, int, int]) -> FloatArray:
    """Corners (c, 8, 3) of the cells of the unit cube in `shape` cells."""
    return (grid_cells(shape)[:, None, :] + CORNERS) / np.array(shape)


def _in_plane(angle: float) -> FloatArray:
    return np.array([np.cos(angle), np.sin(angle), 0.0])


def _third_of_hub(number: int) -> FloatArray:
    """The rhombus between two spokes; its axes run along the spokes, away from the centre."""
    u, v, w = np.moveaxis(_block((ACROSS, ACROSS, THROUGH)), -1, 0)
    first, second = (RADIUS * _in_plane(SPOKES[k % 3]) for k in (number, number + 1))
    return u[..., None] * first + v[..., None] * second + w[..., None] * [0.0, 0.0, THICKNESS]


def _leg(number: int) -> FloatArray:
    """A leg on the edge of a rhombus that lies opposite the second spoke."""
    u, v, w = np.moveaxis(_block((ALONG, ACROSS, THROUGH)), -1, 0)
    outward, sideways = _in_plane(DIRECTIONS[number]), RADIUS * _in_plane(SPOKES[(number + 1) % 3])
    across = (v - 0.5) * (1.0 - (1.0 - TIP) * u)
    middle = (APOTHEM + REACH * u)[..., None] * outward
    return middle + across[..., None] * sideways + w[..., None] * [0.0, 0.0, THICKNESS]


def three_legs() -> tuple[FloatArray, IntArray]:
    """Vertices (n, 3), mm, and tets (m, 4); the hub is centred on the z axis and lies on z = 0."""
    X, hexes = merged(np.concatenate([part(k) for part in (_third_of_hub, _leg) for k in range(3)]))
    return X, six_tets(X, hexes)
