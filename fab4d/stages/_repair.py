"""What a repair of labels may change first, and what makes up for it."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np

from fab4d.design.equilibria import Equilibria
from fab4d.design.flips import FlipSettings, at_interface, compensated, error_left
from fab4d.design.gauss_newton import Design
from fab4d.design.influence import Influence, influence
from fab4d.design.objective import ObjectiveWeights
from fab4d.design.reduced import Search
from fab4d.io.scene import PrinterCard
from fab4d.mesh.measures import tet_volumes
from fab4d.mesh.tetmesh import BoolArray, FloatArray
from fab4d.stages.threshold import labels_for

# Of what a tet of average volume and influence costs, the share that its volume makes.
VOLUME_SHARE = 0.1
# A repair by another cost than the volume has to leave at most this share of the error predicted for that one.
CLEARLY_BETTER = 0.96
# What tets away from the interface do is not known: they cost so many times more than the average of the others.
UNSEEN = 5.0
# The search for a repair ends at one of many, by which of equal costs comes first: so many more are made, each with
# costs that are off by a random factor of this standard deviation of its logarithm; few where each takes long.
MORE_REPAIRS, SPREAD = 4, 0.5


@dataclass(frozen=True, eq=False)
class Repair:
    """What changing each tet costs (m,), and the printable labels smp (m,) that follow, flips that make up included."""

    cost: FloatArray
    smp: BoolArray


def repaired(
    mesh: Mapping[str, np.ndarray],
    printer: PrinterCard,
    settings: FlipSettings,
    found: Search,
    weights: ObjectiveWeights,
    more: int = MORE_REPAIRS,
) -> Repair:
    """The repair of a near 0/1 design that promises the smallest error, SMP within the share that settings allow.

    more : repairs by random costs

    The cost is the tet's volume or how far its flip moves the finished shape: the latter where it promises a clearly
    smaller error, for it turns TPE to SMP rather than SMP to TPE, which moves more.
    """
    X, tets, rho, problem = mesh["X"], mesh["tets"], found.design.rho, found.equilibria.problem
    volumes, before = np.abs(tet_volumes(X, tets)), found.design.rho > 0.5
    by_volume = volumes / volumes.mean()
    usual = labels_for(X, tets, rho, by_volume, printer).smp
    flips = influence_near(found.equilibria, found.design, usual, weights)
    if flips is None or not flips.change.any():
        return Repair(by_volume, usual)

    unseen = np.ones(len(tets), bool)
    unseen[flips.tets] = False

    def made(cost: FloatArray) -> tuple[float, Repair]:
        smp = labels_for(X, tets, rho, cost, printer).smp
        if (smp != before)[unseen].any():
            return np.inf, Repair(cost, smp)
        smp = compensated(problem, flips, before, smp, settings)
        return error_left(flips, before, smp), Repair(cost, smp)

    least, best = made(by_volume)
    least *= CLEARLY_BETTER
    for cost in _other_costs(by_volume, flips, more):
        left, other = made(cost)
        if left <= least and volumes[other.smp].sum() <= settings.max_smp_fraction * volumes.sum():
            least, best = left, other
    return best


def influence_near(
    equilibria: Equilibria, design: Design, smp: BoolArray, weights: ObjectiveWeights
) -> Influence | None:
    """What flips do of the tets that labels smp (m,) change in a near 0/1 design, and of those at an interface.

    None where there are none, or no points whose forces could change.
    """
    problem, before = equilibria.problem, design.rho > 0.5
    near = at_interface(problem, smp) | at_interface(problem, before) | (smp != before)
    if not equilibria.patches.count or not near.any():
        return None
    return influence(equilibria, design, np.flatnonzero(near), weights)


def _other_costs(by_volume: FloatArray, flips: Influence, more: int) -> Iterator[FloatArray]:
    known = np.sqrt((flips.change**2).sum(axis=1) + flips.unseen)
    moved = np.full(len(by_volume), UNSEEN)
    moved[flips.tets] = known / known.mean()
    by_influence = VOLUME_SHARE * by_volume + (1 - VOLUME_SHARE) * moved
    yield by_influence
    random = np.random.default_rng(0)
    for k in range(more):
        base = by_volume if k % 2 else by_influence
        yield base * np.exp(SPREAD * random.standard_normal(len(base)))
