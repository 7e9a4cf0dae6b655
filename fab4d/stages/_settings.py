"""The settings of the search, from a scene."""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from fab4d.design.problem import Problem
from fab4d.design.reduced import ReducedSettings
from fab4d.io.scene import Goal, RigCard
from fab4d.stages._coarse import MANY_TETS
from fab4d.stages._design import objective_weights

# Factors of lam_smooth and lam_SMP, tried in turn until the printed labels meet the tolerance: smoother interfaces lose
# less when labels are repaired, and more SMP holds the shape better.
ATTEMPTS = ((1.0, 1.0), (2.5, 0.4), (6.0, 0.2))
# Above this share of SMP the search makes it dearer, even if the goal names no limit.
USUAL_SMP_FRACTION = 0.5
# The share of SMP settles about the search's limit, which is this much of the goal's.
WITHIN_LIMIT = 0.97
# Where MANY_TETS are searched, for no coarser mesh does, they are rounded in about half the steps, none of which leads
# past unstable states: that takes many times longer.
FAST_GROWTH = 2.5


def search_settings(
    problem: Problem, profile: Mapping[str, Any], attempt: int = 0, n_points: int | None = None
) -> ReducedSettings:
    """The solver's settings for one of the ATTEMPTS, with `most_points` if no number is given.

    profile : sections goal, rig, weights and materials
    """
    goal: Goal = profile["goal"]
    rig: RigCard = profile["rig"]
    weights = objective_weights(problem, goal, profile["weights"], rig, profile["materials"])
    (smooth, smp), limit = ATTEMPTS[attempt], goal.max_smp_fraction
    settings = ReducedSettings(
        n_points=most_points(goal, rig) if n_points is None else n_points,
        patch_radii=tuple(radius / problem.length for radius in rig.patch_radii),
        weights=weights.replace(lam_smooth=smooth * weights.lam_smooth, lam_SMP=smp * weights.lam_SMP),
        max_smp_fraction=USUAL_SMP_FRACTION if limit is None else WITHIN_LIMIT * limit,
    )
    fast = replace(settings, round_growth=FAST_GROWTH, nearly=1.0)
    return fast if problem.n_tets > MANY_TETS else settings


def most_points(goal: Goal, rig: RigCard) -> int:
    """The number of points asked for, or else the most that the rig has."""
    return rig.max_points if goal.max_forces is None else min(goal.max_forces, rig.max_points)
