"""Labels that are changed so that the printed design comes nearer to the temporary shape.

What a flip of each tet at the interface does to the final shape tells which flips together lower the error, or make up
for labels that have to be changed; the held positions follow.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from fab4d.design.gauss_newton import LARGEST_MOVE, Ahead
from fab4d.design.influence import FlipEnergy, Influence
from fab4d.design.problem import Problem
from fab4d.mesh.tetmesh import BoolArray, FloatArray

# A flip has to lower the predicted squared error by this share of it where no equilibrium tells whether it comes true.
SURE_PRICE = 1e-3
# A place that is pinched is worth this share to be mended.
DEFECT_PRICE = 3e-3
# Steps of an annealing for each candidate, where labels are made to be followed and where they are compared; of fewer
# candidates than so many, each gets more in proportion, up to so many times: they take little time.
STEPS, FEW_STEPS = 400, 50
MANY_CANDIDATES, MORE_STEPS = 3000, 5
# Of more tets than this, each flip counts less, in proportion.
USUAL_TETS = 5_000
# Moves of held positions that would go too far are made so many times dearer.
HELD_BACK = 10.0

Printable = Callable[[BoolArray], BoolArray]
# Labels (m,) of least energy near given ones, by the share of the volume that may become SMP, steps and a seed.
Annealed = Callable[[BoolArray, FlipEnergy, float, int, int], BoolArray]


@dataclass(frozen=True)
class FlipSettings:
    """printable : labels near the given ones that can be printed
    annealed : labels of less energy that pinch no more than the given ones, or less

    target_rms : RMS error, L0, at which nothing more is to be won        max_smp_fraction : of the volume
    tolerance : RMS error, L0, that is accepted
    low_rms : RMS error, L0, that is low already, so that the first round that gains little ends it
    """

    printable: Printable
    annealed: Annealed
    target_rms: float
    tolerance: float = 0.0
    low_rms: float = 0.0
    max_smp_fraction: float = 1.0
    rounds: int = 15


def mended(problem: Problem, found: Influence, before: BoolArray, settings: FlipSettings) -> BoolArray:
    """Printable labels near `before` (m,), what is pinched of them mended by the flips that together cost least.

    found : what flips of `before` do. Flips that only lower the error are made with them.
    """
    # A place cannot be left as it is because flips are in doubt.
    sure = replace(found, doubt=0.0)
    price = SURE_PRICE / fineness(problem)
    return settings.printable(flip(problem, sure, before, before, settings, price, STEPS, defect_price=DEFECT_PRICE))


def compensated(
    problem: Problem, found: Influence, before: BoolArray, smp: BoolArray, settings: FlipSettings
) -> BoolArray:
    """Printable labels near `smp` (m,), a repair of the labels `before` (m,), that make up for what it costs.

    found : what flips of `before` do, at least of the tets that smp changed and of those at the interface
    """
    price = SURE_PRICE / fineness(problem)
    better = settings.printable(flip(problem, found, before, smp, settings, price, FEW_STEPS))
    return better if error_left(found, before, better) < error_left(found, before, smp) else smp


def error_left(found: Influence, before: BoolArray, smp: BoolArray) -> float:
    """The error, L0, that `found` predicts for the labels smp (m,) instead of `before` (m,), limits included."""
    return found.left((smp != before)[found.tets])


def fineness(problem: Problem) -> float:
    """How many times more tets than USUAL_TETS there are, 1 at least."""
    return max(problem.n_tets / USUAL_TETS, 1.0)


def predicted(found: Influence, before: BoolArray, smp: BoolArray) -> Ahead:
    """Where the labels smp (m,) instead of `before` (m,) lead, with the held positions that go best with them.

    They are held back until none moves farther than a linear prediction is of use.
    """
    flipped = (smp != before)[found.tets]
    while too_far(moves := found.after(flipped).moves):
        found = found.damped(HELD_BACK)
    return found.ahead(flipped, moves)


def too_far(moves: FloatArray) -> bool:
    """Whether held positions move (3K,) farther, in L0, than a linear prediction is of use."""
    return bool(np.abs(moves).max(initial=0.0) > LARGEST_MOVE)


def flip(
    problem: Problem,
    found: Influence,
    before: BoolArray,
    labels: BoolArray,
    settings: FlipSettings,
    price: float,
    steps: int,
    seed: int = 0,
    defect_price: float = 0.0,
) -> BoolArray:
    """Labels (m,) near `labels` (m,) that pinch no more and have a lower predicted error.

    before : (m,) labels that `found` is about        steps, seed : of the annealing, for each candidate
    price, defect_price : of a flip, and of a place that stays pinched, in squared errors of `labels`
    """
    energy = found.energy((labels != before)[found.tets], price, defect_price)
    room = settings.max_smp_fraction - float(problem.volume_fractions @ labels)
    more = min(max(MANY_CANDIDATES // max(len(found.tets), 1), 1), MORE_STEPS)
    return settings.annealed(labels, energy, room, more * steps, seed)


def near_interface(problem: Problem, labels: BoolArray) -> BoolArray:
    """(m,) tets with an edge between vertices of tets at the interface."""
    corners = problem.body.elements[:, :4]
    near = np.zeros(int(corners.max()) + 1, bool)
    near[corners[at_interface(problem, labels)]] = True
    return near[corners].sum(axis=1) >= 2


def at_interface(problem: Problem, labels: BoolArray) -> BoolArray:
    """(m,) tets with a face between SMP and TPE."""
    first, second = problem.neighbours.T
    between = labels[first] != labels[second]
    result = np.zeros(len(labels), bool)
    result[first[between]] = True
    result[second[between]] = True
    return result
