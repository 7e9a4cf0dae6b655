"""A bar that wants to be bent, and a profile in which the stages design it with linear elements."""

from pathlib import Path

import numpy as np
from shapes.boxes import box
from shapes.warps import Turn, ramp, rod, warped

from fab4d.io.cards import load_material, load_printer, load_rig
from fab4d.io.scene import Acceptance, SolverSettings, Weights

SIZE = (60.0, 12.0, 8.0)
PROFILE = {
    "materials": load_material("paper-corrected", Path()),
    "printer": load_printer("generic-dual-0.4", Path()),
    "rig": load_rig("bench", Path()),
    "weights": Weights(),
    "solver": SolverSettings(element="linear"),
    "acceptance": Acceptance(),
}


def bent_bar(cells: tuple[int, int, int], degrees: float) -> dict[str, np.ndarray]:
    """The artifact `mesh` of a bar of SIZE, clamped at its left end."""
    X, tets = box(SIZE, cells, "five")
    line = rod((8.0, SIZE[1] / 2, SIZE[2] / 2), (SIZE[0], SIZE[1] / 2, SIZE[2] / 2), (0, 0, 1))
    bent = warped(X, line, (Turn((0, 0, 1), degrees, lambda s: ramp(s, 0, 5)),))
    return {"X": X, "X_temp": bent, "tets": tets, "clamp": X[:, 0] <= 8.0}
