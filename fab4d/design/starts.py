"""Random points to begin a search with: it descends from where its points are first, and may end lower from others."""

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


def random_centers(problem: Problem, count: int, seed: int) -> IntArray:
    """(count,) boundary vertices outside the clamp, far from each other among some chosen at random."""
    usable = pad_vertices(problem)
    size = min(len(usable), max(int(CHOSEN_SHARE * len(usable)), 3 * count))
    return spread_centers(problem, count, np.random.default_rng(seed).choice(usable, size, replace=False))


def beginnings(problem: Problem, settings: ReducedSettings, watch: Watch, most: int = BEGINNINGS) -> Iterator[Search]:
    """The relaxed designs that `most` sets of random points lead to, but for those that lead to none."""
    for seed in range(most):
        centers = random_centers(problem, settings.n_points, seed)
        try:
            yield relaxed(problem, replace(settings, centers=centers), watch)
        except EquilibriumError:
            continue
