"""What a repair of labels may change first."""

from collections.abc import Mapping

import numpy as np

from fab4d.design.flips import error_modes, influence, predicted_error
from fab4d.design.reduced import Search
from fab4d.io.scene import Goal, PrinterCard
from fab4d.mesh.measures import tet_volumes
from fab4d.stages.threshold import labels_for

# Of what a tet of average volume and influence costs, the share that its volume makes.
VOLUME_SHARE = 0.1
# Repairs by influence have to leave at most this share of the predicted error of those by volume: predictions, whole
# flips added up by their derivatives, are off by some per cent.
CLEARLY_BETTER = 0.96


def repair_cost(mesh: Mapping[str, np.ndarray], printer: PrinterCard, goal: Goal, found: Search) -> np.ndarray:
    """(m,) what changing each tet of a near 0/1 design costs: its volume, or how far that moves the finished shape.

    The latter where it promises a clearly smaller error, and SMP within the goal's share: it turns TPE to SMP rather
    than SMP to TPE, which moves the shape more.
    """
    X, tets, rho = mesh["X"], mesh["tets"], found.design.rho
    volumes = np.abs(tet_volumes(X, tets))
    by_volume = volumes / volumes.mean()
    if not found.equilibria.patches.count:
        return by_volume
    modes = error_modes(found.equilibria, found.design)
    by_influence = VOLUME_SHARE * by_volume + (1 - VOLUME_SHARE) * influence(modes, rho)
    usual, other = (labels_for(X, tets, rho, cost, printer).smp for cost in (by_volume, by_influence))
    most = 1.0 if goal.max_smp_fraction is None else goal.max_smp_fraction
    affordable = volumes[other].sum() <= most * volumes.sum()
    better = predicted_error(modes, rho, other) <= CLEARLY_BETTER * predicted_error(modes, rho, usual)
    return by_influence if affordable and better else by_volume
