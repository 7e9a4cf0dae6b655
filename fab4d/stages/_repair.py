"""What a repair of labels may change first."""

from collections.abc import Mapping

import numpy as np

from fab4d.design.flips import error_modes, whole_flips
from fab4d.design.reduced import Search
from fab4d.io.scene import Goal, PrinterCard
from fab4d.mesh.measures import tet_volumes
from fab4d.stages.threshold import labels_for

# Of what a tet of average volume and influence costs, the share that its volume makes.
VOLUME_SHARE = 0.1
# Repairs by influence have to leave at most this share of the predicted error of those by volume: predictions, whole
# flips added up by their derivatives, are off by some per cent.
CLEARLY_BETTER = 0.96


def repaired(
    mesh: Mapping[str, np.ndarray], printer: PrinterCard, goal: Goal, found: Search
) -> tuple[np.ndarray, np.ndarray]:
    """What changing each tet of a near 0/1 design costs (m,), and the printable labels (m,) that follow.

    The cost is the tet's volume, or how far the flip moves the finished shape: the latter where it promises a clearly
    smaller error, and SMP within the goal's share, for it turns TPE to SMP rather than SMP to TPE, which moves more.
    """
    X, tets, rho = mesh["X"], mesh["tets"], found.design.rho
    volumes = np.abs(tet_volumes(X, tets))
    by_volume = volumes / volumes.mean()
    usual = labels_for(X, tets, rho, by_volume, printer).smp
    if not found.equilibria.patches.count:
        return by_volume, usual
    change, error = whole_flips(error_modes(found.equilibria, found.design), rho)
    moved = np.linalg.norm(change, axis=1)
    if not moved.any():
        return by_volume, usual
    by_influence = VOLUME_SHARE * by_volume + (1 - VOLUME_SHARE) * moved / moved.mean()
    other = labels_for(X, tets, rho, by_influence, printer).smp
    left, left_usual = (np.linalg.norm(error + change[smp != (rho > 0.5)].sum(axis=0)) for smp in (other, usual))
    most = 1.0 if goal.max_smp_fraction is None else goal.max_smp_fraction
    affordable = volumes[other].sum() <= most * volumes.sum()
    return (by_influence, other) if affordable and left <= CLEARLY_BETTER * left_usual else (by_volume, usual)
