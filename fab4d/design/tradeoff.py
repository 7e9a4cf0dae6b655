"""What SMP costs and what it buys: warm-started designs at other prices of SMP, and the bisection on lam_SMP."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from fab4d.design.objective import smoothness_matrix
from fab4d.design.problem import Problem
from fab4d.design.reduced import STEPS, Phase, ReducedSettings, Search, Watch, solve_reduced
from fab4d.mesh.tetmesh import BoolArray, FloatArray

# Rounding is a jump: one price too high may be bad luck, two in a row are not.
FAILURES_TO_CLOSE = 2
MOST_TRIALS = 8
# The search ends when the two prices around the limit differ, or save, by less than this share.
LEAST_CHANGE = 0.03


def search_at(
    problem: Problem, settings: ReducedSettings, start: Search, lam_SMP: float, watch: Watch
) -> tuple[Search, Search]:
    """The relaxed and the near 0/1 design at the price lam_SMP, set out from the relaxed design `start` of another."""
    relaxed = relaxed_at(problem, settings, start, lam_SMP, watch)
    return relaxed, solve_reduced(problem, settings, watch, relaxed)


def relaxed_at(problem: Problem, settings: ReducedSettings, start: Search, lam_SMP: float, watch: Watch) -> Search:
    """The design of `start` relaxed at the price lam_SMP, about to be rounded."""
    L, at = smoothness_matrix(problem), repriced(start, lam_SMP)
    while at.phase is not Phase.ROUND:
        at = STEPS[at.phase](at, settings, L)
        watch(at)
    return at


def repriced(start: Search, lam_SMP: float) -> Search:
    """The design of `start`, about to be relaxed at another price of SMP."""
    return Search(start.equilibria, start.design, start.patch_radius, lam_SMP=lam_SMP, exchanges=start.exchanges)


@dataclass(frozen=True)
class Trial:
    """What came out at the price lam_SMP: SMP share of the volume as printed, and whether that meets the goal."""

    lam_SMP: float
    smp_fraction: float
    acceptable: bool


def next_price(trials: Sequence[Trial]) -> float | None:
    """The price of SMP to try next, or None when the least SMP is bracketed; the first trial has to be acceptable.

    Doubled until FAILURES_TO_CLOSE prices in a row are too high, then the geometric mean of the dearest acceptable one
    and the cheapest one above it. Source: the paper, section 7, bisection on lam_SMP.
    """
    if len(trials) >= MOST_TRIALS or not any(trial.acceptable for trial in trials):
        return None
    low = max((trial for trial in trials if trial.acceptable), key=lambda trial: trial.lam_SMP)
    above = sorted((trial for trial in trials if trial.lam_SMP > low.lam_SMP), key=lambda trial: trial.lam_SMP)
    if low.smp_fraction == 0:
        return None
    if len(above) < FAILURES_TO_CLOSE:
        return 2 * max(trial.lam_SMP for trial in trials)
    high = above[0]
    saved = 1 - high.smp_fraction / low.smp_fraction
    if high.lam_SMP < (1 + LEAST_CHANGE) * low.lam_SMP or 0 <= saved < LEAST_CHANGE:
        return None
    return float(np.sqrt(low.lam_SMP * high.lam_SMP))


def least(trials: Sequence[Trial]) -> int:
    """Number of the acceptable trial with the least SMP. Raises ValueError when there is none."""
    acceptable = [k for k, trial in enumerate(trials) if trial.acceptable]
    return min(acceptable, key=lambda k: trials[k].smp_fraction)


def way_to(price: float) -> list[float]:
    """The prices over which `price` is reached from 1, by doubling or halving: 3 by 1, 2 and 3."""
    way = [1.0]
    while way[-1] != price:
        way.append(min(2 * way[-1], price) if price > way[-1] else max(way[-1] / 2, price))
    return way


def nearest(prices: Sequence[float], price: float) -> int:
    """Number of the price (above 0) whose ratio to `price` is nearest to 1."""
    return int(np.argmin(np.abs(np.log(np.asarray(prices) / price))))


def pareto_front(costs: FloatArray, errors: FloatArray) -> BoolArray:
    """(k,) whether no other of the k designs is as good in both cost and error, and better in one."""
    no_worse = (costs[:, None] <= costs) & (errors[:, None] <= errors)
    better = (costs[:, None] < costs) | (errors[:, None] < errors)
    dominated: BoolArray = np.any(no_worse & better, axis=0)
    return ~dominated
