"""How a part stands on the printer: its frame turned so that a chosen direction points up."""

import numpy as np

from fab4d.mesh.tetmesh import FloatArray

Z = np.array([0.0, 0.0, 1.0])


def printer_axes(up: tuple[float, float, float]) -> FloatArray:
    """Axes of the printer in the part's frame, rows of a rotation (3, 3): the third is `up`, a unit vector.

    Where `up` points down the part is turned upside down about x, then as little as needed. Along an axis of the part
    the entries are exact, so that coordinates only change places and signs.
    Source: Rodrigues' formula, R = I + [v]x + [v]x^2 / (1 + c), with v = up x z and c = up . z.
    """
    x, y, c = up
    if c < 0.0:
        return printer_axes((x, -y, -c)) * np.array([1.0, -1.0, -1.0]) + 0.0
    cross = np.array([[0.0, 0.0, -x], [0.0, 0.0, -y], [x, y, 0.0]])
    axes = np.eye(3) + cross + cross @ cross / (1.0 + c)
    axes[2] = up
    return axes + 0.0


def standing(X: FloatArray, up: tuple[float, float, float]) -> FloatArray:
    """Positions X (n, 3) of the part's frame as the printer sees them, turned about the origin."""
    return X @ printer_axes(up).T
