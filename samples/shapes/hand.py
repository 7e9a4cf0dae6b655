"""A flat hand, fingers along y, and its closing: every finger curls towards +z."""

import numpy as np

from fab4d.mesh.tetmesh import FloatArray
from shapes.implicit import capsule, rounded_box, union
from shapes.warps import Turn, bump, moved_together, rod, section_coordinates, warped

LOW, HIGH = (-78.0, 0.0, 0.0), (40.0, 160.0, 18.0)
MIDDLE, KNUCKLE, START = 9.0, 68.0, 80.0
# Place across the palm and tip of each finger, mm.
FINGERS = ((-31.5, 140.0), (-10.5, 150.0), (10.5, 144.0), (31.5, 128.0))
RADIUS, THUMB_RADIUS = 6.8, 7.0
THUMB_ROOT, THUMB_TIP = np.array([-26.0, 22.0, MIDDLE]), np.array([-70.0, 66.0, MIDDLE])
THUMB_LINE = (THUMB_TIP - THUMB_ROOT) / np.linalg.norm(THUMB_TIP - THUMB_ROOT)
THUMB_START, THUMB_CLEAR = 32.0, 12.0  # along the thumb and across it: what lies there is clear of the palm

_PALM = rounded_box((-39, 0, 0), (39, 78, 2 * MIDDLE), 7.5)
_FINGERS = [capsule((x, KNUCKLE, MIDDLE), (x, tip, MIDDLE), RADIUS) for x, tip in FINGERS]
body = union(_PALM, *_FINGERS, capsule(THUMB_ROOT, THUMB_TIP, THUMB_RADIUS))

CLAMP = ((-40.0, -1.0, -1.0), (40.0, 31.2, 19.0))


def _finger(X: FloatArray, x: float, tip: float, degrees: float) -> FloatArray:
    line = rod((x, START, MIDDLE), (x, tip + RADIUS, MIDDLE), (0, 0, 1))
    curled = warped(X, line, (Turn((0, 0, 1), degrees, bump(0, line.length, 0.2)),))
    return np.where((np.abs(X[:, 0] - x) < 10.0)[:, None] & (X[:, 1:2] > START), curled, X)


def _thumb(X: FloatArray, degrees: float) -> FloatArray:
    line = rod(THUMB_ROOT + THUMB_START * THUMB_LINE, THUMB_TIP + THUMB_RADIUS * THUMB_LINE, (0, 0, 1))
    curled = warped(X, line, (Turn((0, 0, 1), degrees, bump(0, line.length, 0.2)),))
    across = np.abs(section_coordinates(X, line)[:, 2:])
    return np.where(across < THUMB_CLEAR, curled, X)


def closed(X: FloatArray) -> FloatArray:
    """Positions (n, 3) with the fingers curled by 100 to 130 degrees and the thumb by 70."""
    turns = (130.0, 130.0, 125.0, 100.0)
    fingers = [_finger(X, x, tip, turn) for (x, tip), turn in zip(FINGERS, turns, strict=True)]
    return moved_together(X, *fingers, _thumb(X, 70.0))
