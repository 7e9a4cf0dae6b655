"""A flat flower of five petals, and its closing: the petals rise from the middle."""

import numpy as np

from fab4d.mesh.tetmesh import FloatArray
from shapes.warps import Turn, bump, moved_together, rod, warped

THICKNESS, MIDDLE_RADIUS, TIP, PETAL_WIDTH, START = 5.0, 22.0, 85.0, 34.0, 24.0
ANGLES = np.radians(90.0 + 72.0 * np.arange(5))
LOW, HIGH = (-TIP, -TIP), (TIP, TIP)
CLAMP = ((-17.3, -17.3, -1.0), (17.3, 17.3, THICKNESS + 1.0))


def outline(P: FloatArray) -> FloatArray:
    """Positive inside, (n,), for points (n, 2): a disc and five ellipses."""
    inside = MIDDLE_RADIUS - np.hypot(*P.T)
    for angle in ANGLES:
        along = P @ [np.cos(angle), np.sin(angle)]
        across = P @ [-np.sin(angle), np.cos(angle)]
        centre, half = 0.5 * (TIP + 12.0), 0.5 * (TIP - 12.0)
        petal = 0.5 * PETAL_WIDTH * (1.0 - np.hypot((along - centre) / half, across / (0.5 * PETAL_WIDTH)))
        inside = np.maximum(inside, petal)
    return inside


def closed(X: FloatArray) -> FloatArray:
    """Positions (n, 3) with the petals turned up by 75 degrees."""
    petals = []
    for angle in ANGLES:
        x, y = np.cos(angle), np.sin(angle)
        line = rod((START * x, START * y, THICKNESS / 2), (TIP * x, TIP * y, THICKNESS / 2), (0, 0, 1))
        raised = warped(X, line, (Turn((0, 0, 1), 75, bump(0, line.length, 0.3)),))
        own = np.abs(np.angle(np.exp(1j * (np.arctan2(X[:, 1], X[:, 0]) - angle)))) < np.pi / 5
        petals.append(np.where(own[:, None], raised, X))
    return moved_together(X, *petals)
