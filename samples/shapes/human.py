"""A standing figure 180 mm tall, arms spread along x, and its pose: all four limbs bend differently."""

import numpy as np

from fab4d.mesh.tetmesh import FloatArray
from shapes.implicit import capsule, union
from shapes.warps import Turn, bump, moved_together, rod, warped

LOW, HIGH = (-84.0, -27.0, 0.0), (84.0, 18.0, 180.0)
SHOULDER, ARM_START, REACH = 134.0, 34.0, 82.0
HIP, LEG_START, SOLE = 15.0, 78.0, 0.0

_TORSO = [capsule((x, 0, 102), (x, 0, 130), 16) for x in (-10, 10)]
_HEAD = [capsule((0, 0, 140), (0, 0, 155), 8), capsule((0, 0, 163), (0, 0, 167), 13)]
_ARMS = [capsule((s * 18, 0, SHOULDER), (s * 75, 0, SHOULDER), 9.5, 7) for s in (-1, 1)]
_LEGS = [capsule((s * HIP, 0, 98), (s * HIP, 0, 9), 11.5, 8.5) for s in (-1, 1)]
_FEET = [capsule((s * HIP, 2, 8), (s * HIP, -18, 8), 8) for s in (-1, 1)]
body = union(*_TORSO, *_HEAD, *_ARMS, *_LEGS, *_FEET)

CLAMP = ((-28.0, -19.0, 91.1), (28.0, 19.0, 120.3))


def _arm(X: FloatArray, side: int, *turns: Turn) -> FloatArray:
    return warped(X, rod((side * ARM_START, 0, SHOULDER), (side * REACH, 0, SHOULDER), (0, 0, 1)), turns)


def _leg(X: FloatArray, side: int, *turns: Turn) -> FloatArray:
    line = rod((side * HIP, 0, LEG_START), (side * HIP, 0, SOLE), (0, -1, 0))
    return np.where((side * X[:, 0] > 0)[:, None], warped(X, line, turns), X)


def posed(X: FloatArray) -> FloatArray:
    """Positions (n, 3): one arm raised, one bent forward, one leg stepping, one stretched back."""
    up, forward = (0, 0, 1), (0, 1, 0)
    raised = _arm(X, 1, Turn(up, 75, bump(0, 46, 0.3)))
    bent = _arm(X, -1, Turn(forward, -80, bump(4, 44, 0.3)), Turn(up, -20, bump(0, 40, 0.3)))
    step = _leg(X, 1, Turn(up, 55, bump(0, 36, 0.3)), Turn(up, -55, bump(32, 64, 0.3)))
    back = _leg(X, -1, Turn(up, -35, bump(0, 50, 0.3)))
    return moved_together(X, raised, bent, step, back)
