"""A streamlined body with a tail fin, swimming along -x; height along z."""

import numpy as np
from scipy.interpolate import PchipInterpolator

from fab4d.mesh.tetmesh import FloatArray

LENGTH, HALF_HEIGHT, HALF_WIDTH, ROUNDING = 180.0, 21.0, 12.0, 3.0
# Shares of the largest half height and half width, by the share of the length from the nose.
_AT = [0.0, 0.04, 0.15, 0.35, 0.55, 0.75, 0.84, 0.92, 1.0]
_HEIGHT = PchipInterpolator(_AT, [0.1, 0.42, 0.78, 1.0, 0.84, 0.42, 0.36, 0.7, 1.0])
_WIDTH = PchipInterpolator(_AT, [0.1, 0.48, 0.85, 1.0, 0.8, 0.46, 0.36, 0.3, 0.28])

LOW, HIGH = (0.0, -HALF_WIDTH, -HALF_HEIGHT), (LENGTH, HALF_WIDTH, HALF_HEIGHT)


def fish(P: FloatArray) -> FloatArray:
    """Positive inside, (n,): sections with round backs and bellies, and a tail with a round end."""
    share = np.clip(P[:, 0] / LENGTH, 0.0, 1.0)
    width = HALF_WIDTH * _WIDTH(share)
    straight = np.maximum(HALF_HEIGHT * _HEIGHT(share) - width, 0.0)
    section = width - np.hypot(P[:, 1], np.maximum(np.abs(P[:, 2]) - straight, 0.0))
    ends = np.minimum(P[:, 0], LENGTH - P[:, 0])
    return ROUNDING - np.hypot(np.maximum(ROUNDING - section, 0.0), np.maximum(ROUNDING - ends, 0.0))
