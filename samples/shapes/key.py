"""A flat key: a bow with a hole, a shaft along x and five teeth, some of which bend out of the plane."""

import numpy as np

from fab4d.mesh.tetmesh import FloatArray
from shapes.implicit import capsule, difference, union
from shapes.warps import Turn, bump, moved_together, rod, warped

THICKNESS, ROOT, START = 6.0, -6.0, -8.0
# Middle along the shaft, tip and turn (degrees) of each tooth.
TEETH = ((62.0, -26.0, 70.0), (75.0, -32.0, -60.0), (88.0, -22.0, 0.0), (101.0, -30.0, -75.0), (114.0, -26.0, 60.0))
TOOTH_WIDTH = 7.0
LOW, HIGH = (-24.0, -34.0), (122.0, 24.0)
CLAMP = ((-25.0, -25.0, -1.0), (20.4, 25.0, THICKNESS + 1.0))


def _rectangle(low: tuple[float, float], high: tuple[float, float], P: FloatArray) -> FloatArray:
    return np.min([P - low, np.asarray(high) - P], axis=(0, 2))


def _teeth(P: FloatArray) -> FloatArray:
    half = TOOTH_WIDTH / 2
    return np.max([_rectangle((x - half, tip), (x + half, 0.0), P) for x, tip, _ in TEETH], axis=0)


def outline(P: FloatArray) -> FloatArray:
    """Positive inside, (n,), for points (n, 2)."""
    bow = difference(capsule((0, -1), (0, 1), 22), capsule((-6, -1), (-6, 1), 8))
    shaft = capsule((16, 0), (114, 0), -ROOT)
    return np.asarray(union(bow, shaft, _teeth)(P))


def teeth_bent(X: FloatArray) -> FloatArray:
    """Positions (n, 3) with the teeth turned about the shaft's direction."""
    moved = []
    for x, tip, degrees in TEETH:
        line = rod((x, START, THICKNESS / 2), (x, tip, THICKNESS / 2), (0, 0, 1))
        bent = warped(X, line, (Turn((0, 0, 1), degrees, bump(0, line.length, 0.3)),))
        moved.append(np.where((np.abs(X[:, 0] - x) < 6.0)[:, None], bent, X))
    return moved_together(X, *moved)
