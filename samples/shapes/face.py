"""A round face: an outline with two eyes and a mouth, and the mouth's opening."""

import numpy as np

from fab4d.mesh.tetmesh import FloatArray
from shapes.warps import ramp

RADIUS, THICKNESS = 55.0, 5.0
EYES = ((-19.0, 17.0), (19.0, 17.0))
EYE_AXES = (6.0, 9.0)
MOUTH_CENTRE, MOUTH_RADIUS, MOUTH_HALF_ANGLE, MOUTH_HALF_WIDTH = (0.0, 8.0), 30.0, np.radians(58.0), 4.5
# The lip below the mouth moves by GAPE; the part that moves spans +-REACH and bends, DEPTH deep, about the height CHIN.
GAPE, REACH, CHIN, DEPTH = 5.0, 40.0, -38.0, 16.0


def _mouth_distance(P: FloatArray) -> FloatArray:
    """Distance (n,) to the mouth's arc."""
    x, y = (P - MOUTH_CENTRE).T
    angle = np.clip(np.arctan2(x, -y), -MOUTH_HALF_ANGLE, MOUTH_HALF_ANGLE)
    return np.hypot(x - MOUTH_RADIUS * np.sin(angle), y + MOUTH_RADIUS * np.cos(angle))


def face(P: FloatArray) -> FloatArray:
    """Positive inside, (n,), for points (n, 2)."""
    inside = np.minimum(RADIUS - np.hypot(*P.T), _mouth_distance(P) - MOUTH_HALF_WIDTH)
    for eye in EYES:
        inside = np.minimum(inside, EYE_AXES[0] * (np.hypot(*((P - eye) / EYE_AXES).T) - 1.0))
    return inside


def mouth_opened(X: FloatArray) -> FloatArray:
    """Positions (n, 3) after the lower lip has bent down in the plane, as a beam between the corners of the mouth."""
    x, y = X[:, 0], X[:, 1]
    u = np.clip(x / REACH, -1.0, 1.0)
    radius = np.hypot(x - MOUTH_CENTRE[0], y - MOUTH_CENTRE[1])
    below = ramp(radius, MOUTH_RADIUS - 8.0, MOUTH_RADIUS + 8.0) * (1.0 - ramp(y, -18.0, 6.0))
    offset = 0.5 * DEPTH * np.tanh((y - CHIN) / (0.5 * DEPTH))
    drop = -GAPE * (1.0 - u**2) ** 2
    slope = GAPE * 4.0 * u * (1.0 - u**2) / REACH
    return X + below[:, None] * np.column_stack([-offset * slope, drop, np.zeros_like(x)])
