"""Other points to begin a search with: it descends from where its points are first, and may end lower from others."""

import math
from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from fab4d.design.patches import pad_vertices, spread_centers
from fab4d.design.problem import Problem
from fab4d.design.reduced import ReducedSettings, Search, Watch, relaxed
from fab4d.errors import EquilibriumError
from fab4d.mesh.tetmesh import IntArray

BEGINNINGS = 8
# Points are spread over this share of the vertices, chosen at random.
CHOSEN_SHARE = 0.25
# The second half of the beginnings mixes the points of two of so many best ends: what some of them hold well, others
# need not find again. Points are spread over so many times as many of the two.
PARENTS, CROSSED_AMONG = 6, 1.4


def random_centers(problem: Problem, count: int, seed: int) -> IntArray:
    """(count,) boundary vertices outside the clamp, far from each other among some chosen at random."""
    usable = pad_vertices(problem)
    size = min(len(usable), max(int(CHOSEN_SHARE * len(usable)), 3 * count))
    return spread_centers(problem, count, np.random.default_rng(seed).choice(usable, size, replace=False))


def crossed_centers(problem: Problem, one: IntArray, other: IntArray, chance: np.random.Generator) -> IntArray:
    """(K,) of the centers `one` and `other` (K,) of two designs, far from each other among some chosen by `chance`."""
    among = np.union1d(one, other)
    size = min(len(among), math.ceil(CROSSED_AMONG * len(one)))
    return spread_centers(problem, len(one), chance.choice(among, size, replace=False))


def beginnings(problem: Problem, settings: ReducedSettings, watch: Watch, most: int = BEGINNINGS) -> Iterator[Search]:
    """The relaxed designs that `most` sets of points lead to, but for those that lead to none.

    The first half of the sets is random, the others are crossed from the best that they, and those before, ended with.
    """
    ends = list[Search]()
    for seed in range(most):
        centers = random_centers(problem, settings.n_points, seed)
        if 2 * seed >= most and len(ends) > 1:
            centers = _crossed(problem, ends, seed)
        try:
            at = relaxed(problem, replace(settings, centers=centers), watch)
        except EquilibriumError:
            continue
        ends.append(at)
        yield at


def _crossed(problem: Problem, ends: list[Search], seed: int) -> IntArray:
    best = sorted(ends, key=lambda at: at.relaxed_rms)[:PARENTS]
    chance = np.random.default_rng(seed)
    one, other = chance.choice(np.array([at.equilibria.patches.centers for at in best]), 2, replace=False)
    return crossed_centers(problem, one, other, chance)
