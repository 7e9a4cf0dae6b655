"""Which flips of labels a printed design is refined with, and how far."""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from fab4d.design.flips import FlipSettings
from fab4d.design.problem import Problem
from fab4d.fabrication.annealing import annealer
from fab4d.io.scene import Goal, PrinterCard
from fab4d.mesh.measures import tet_volumes
from fab4d.stages._bring_up import OUT_OF_REACH
from fab4d.stages._coarse import MANY_TETS
from fab4d.stages.threshold import labels_for

# Labels are flipped until the error is at most this multiple of that of the relaxed design, and meets the tolerance if
# that design comes within the same multiple of it.
ALLOWED_LOSS = 1.15
# A round of flips takes minutes on more than MANY_TETS: there held positions are first fitted to where loading ends,
# clear of unstable states unless they miss the tolerance there, and flips end at this share of the tolerance, or after
# a few. So they do where the relaxed design is out of reach of the tolerance, and in quadratic elements that are too
# many to round in: there the first is the tolerance itself.
GOOD_ENOUGH, FEW_ROUNDS = 0.5, 5
# At this share of the tolerance flips end with the first round that gains little; with more than MANY_DOFS unknowns,
# where each round takes about a minute, at the tolerance.
LOW_ERROR, MANY_DOFS = 0.15, 40_000


def fit_flips(
    problem: Problem, mesh: Mapping[str, np.ndarray], printer: PrinterCard, goal: Goal, relaxed_rms: float, limit: float
) -> FlipSettings:
    """The flips of stage refit in the elements of `problem`.

    relaxed_rms, limit : RMS error of the relaxed design and the tolerance, L0
    """
    settings = flip_settings(mesh, printer, goal, flipped_down_to(relaxed_rms, limit, problem.n_tets))
    low = LOW_ERROR if 3 * problem.n_nodes <= MANY_DOFS else 1.0
    few = problem.n_tets > MANY_TETS or relaxed_rms > OUT_OF_REACH * limit
    rounds = FEW_ROUNDS if few else settings.rounds
    return replace(settings, tolerance=limit, low_rms=low * limit, rounds=rounds)


def flipped_down_to(relaxed_rms: float, tolerance: float, n_tets: int) -> float:
    """The RMS error at which labels need no more flips, in the unit of the other two."""
    allowed = ALLOWED_LOSS * relaxed_rms
    if n_tets > MANY_TETS:
        allowed = max(allowed, GOOD_ENOUGH * tolerance)
    return min(allowed, tolerance) if relaxed_rms <= ALLOWED_LOSS * tolerance else allowed


def flip_settings(mesh: Mapping[str, np.ndarray], printer: PrinterCard, goal: Goal, target_rms: float) -> FlipSettings:
    """Flips that keep the labels printable and within the goal's share of SMP, down to the RMS error target_rms, L0."""
    X, tets = mesh["X"], mesh["tets"]
    volumes = np.abs(tet_volumes(X, tets))
    return FlipSettings(
        printable=lambda smp: labels_for(X, tets, smp.astype(np.float64), volumes, printer).smp,
        annealed=annealer(tets, volumes / volumes.sum()),
        target_rms=target_rms,
        max_smp_fraction=1.0 if goal.max_smp_fraction is None else goal.max_smp_fraction,
    )
