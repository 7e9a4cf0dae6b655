"""Labels that are changed so that the printed design comes nearer to the temporary shape.

Rounding a density and mending its labels costs accuracy. What a flip of each tet at the interface does to the final
shape tells which flips win it back together; the held positions follow. Each round of flips is judged by the equilibria
of the labels that result from it, and one that comes to nothing teaches what its flips are worth.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from fab4d.design.equilibria import Equilibria
from fab4d.design.gauss_newton import LARGEST_MOVE, Ahead, Design, evaluate, held_positions
from fab4d.design.influence import FlipEnergy, Influence, influence
from fab4d.design.objective import ObjectiveWeights, shape_error, smoothness_matrix
from fab4d.design.paths import follow_density
from fab4d.design.problem import Problem
from fab4d.design.reduced import Search, Watch, refit
from fab4d.errors import EquilibriumError
from fab4d.mesh.tetmesh import BoolArray, FloatArray

# So many tets near the interface, those that promise most, are candidates of a round.
MOST_CANDIDATES = 1500
# A flip has to lower the predicted squared error by this share of it: less once a round has come true, more once one
# has not, for many flips at once are predicted worse than few. A round that wins at least the first share of what it
# promised has come true, one that wins less than the second has not.
FIRST_PRICE, CHEAPER, DEARER = 3e-4, 1.5, 3.0
CAME_TRUE, CAME_TO_LITTLE = 0.6, 0.3
# By so much where no equilibrium tells whether it comes true.
SURE_PRICE = 1e-3
# A place that is pinched is worth this share to be mended.
DEFECT_PRICE = 3e-3
# A round has to lower the predicted squared error, and the objective, by this share.
LEAST_ROUND_GAIN = 2e-2
# Steps of the annealing for each candidate, in a round and where labels are compared.
STEPS, FEW_STEPS = 2000, 300
# Of more tets than this, in proportion more are candidates, each for a smaller gain.
USUAL_TETS = 5_000
# So many rounds in a row that gain less end it. Once the tolerance is met, a round is also poor after which the target
# is more than MOST_TO_GO such rounds away, and fewer end it.
MOST_POOR, POOR_AFTER, MOST_TO_GO = 3, 2, 6
# Moves of the held positions cost HELD_BACK times as much after flips whose equilibria are not found, for these mostly
# lie too far off, and LET_GO times less after flips that come true. Beyond MOST_DAMPING it is not for these moves.
HELD_BACK, LET_GO, MOST_DAMPING = 10.0, 3.0, 1e3
# Flips whose equilibria are farther away than steps of this share of the change go are given up.
SMALLEST_STEP = 0.25
# Steps of the held positions after each round; once all are made, they are fitted to the end.
FOLLOWING_STEPS = 6

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

    def most_poor(self, rms: float) -> int:
        """So many poor rounds in a row end the flips at this RMS error, L0."""
        if rms <= self.low_rms:
            return 1
        return POOR_AFTER if rms <= self.tolerance else MOST_POOR


def polish_labels(
    equilibria: Equilibria, design: Design, weights: ObjectiveWeights, settings: FlipSettings, watch: Watch
) -> Design:
    """The design with labels flipped near the interface as long as that brings it nearer to X_temp.

    design : of 0/1 labels, held positions fitted to them; the result is such a design too
    """
    problem, start = equilibria.problem, design
    L = smoothness_matrix(problem)
    plain = weights.replace(lam_SMP=0.0, lam_mat=0.0, lam_round=0.0, lam_smooth=0.0)
    value = evaluate(equilibria, plain, L, design)
    finer = fineness(problem)
    price, poor, damping = FIRST_PRICE / finer, 0, 1.0
    found: Influence | None = None
    for seed in range(settings.rounds):
        rms = shape_error(problem, design.final.y).rms
        if rms <= settings.target_rms or poor >= settings.most_poor(rms):
            break
        smp = design.rho > 0.5
        if found is None:
            tets = np.flatnonzero(near_interface(problem, smp))
            if not tets.size:
                break
            found = influence(equilibria, design, tets, plain, int(MOST_CANDIDATES * finer)).damped(damping)
        flipped = settings.printable(flip(problem, found, smp, smp, settings, price, STEPS, seed))
        changed = (flipped != smp)[found.tets]
        settled, unchanged = found.after(changed), found.after(np.zeros_like(changed))
        if settled.squared >= (1 - LEAST_ROUND_GAIN) * unchanged.squared:
            price, poor = price / DEARER, poor + 1
            continue
        ahead = None if _too_far(settled.moves) else found.ahead(changed, settled.moves)
        trial = None if ahead is None else _changed(equilibria, design, flipped, plain, ahead)
        if trial is None:
            price, poor = DEARER * price, poor + (damping >= MOST_DAMPING)
            found, damping = found.damped(HELD_BACK), HELD_BACK * damping
            continue
        fitted = refit(equilibria, trial, plain, lambda at: None, iterations=FOLLOWING_STEPS)  # noqa: ARG005
        new, new_rms = evaluate(equilibria, plain, L, fitted), shape_error(problem, fitted.final.y).rms
        far = rms <= settings.tolerance and _rounds_to_go(rms, new_rms, settings.target_rms) > MOST_TO_GO
        poor = poor + 1 if far or new > (1 - LEAST_ROUND_GAIN) * value else 0
        if new < value:
            won = (value - new) * plain.error_scale**2 / (unchanged.squared - settled.squared)
            price, damping = price * _price_change(won), max(damping / LET_GO, 1.0)
            design, value, found = fitted, new, None
            watch(Search(equilibria, design))
        else:
            view, moves = found.view, _moves(equilibria, design, trial)
            shape = view.shape(problem, trial.final.y) - moves @ view.shape_by_held
            limits = view.limits.at(trial.median) - moves @ view.limits_by_held
            found, price = found.taught(changed, shape, limits), DEARER * price
    return refit(equilibria, design, weights, watch) if design is not start else start


def _price_change(won: float) -> float:
    """The factor of the price after a round that won this share of what it promised."""
    if won >= CAME_TRUE:
        return 1 / CHEAPER
    return 1.0 if won >= CAME_TO_LITTLE else DEARER


def _rounds_to_go(before: float, after: float, target: float) -> float:
    """How many rounds that lower the error by the same share as the last lead from `after` to `target`."""
    if after <= target:
        return 0.0
    return float(np.log(after / target) / np.log(before / after)) if after < before else np.inf


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
    while _too_far(moves := found.after(flipped).moves):
        found = found.damped(HELD_BACK)
    return found.ahead(flipped, moves)


def _too_far(moves: FloatArray) -> bool:
    return bool(np.abs(moves).max(initial=0.0) > LARGEST_MOVE)


def _changed(
    equilibria: Equilibria, design: Design, labels: BoolArray, weights: ObjectiveWeights, ahead: Ahead
) -> Design | None:
    """The design with these labels (m,), held positions following; None where it has no stable equilibrium near."""
    try:
        return follow_density(equilibria, design, labels.astype(np.float64), weights, ahead, SMALLEST_STEP)
    except EquilibriumError:
        return None


def _moves(equilibria: Equilibria, before: Design, after: Design) -> FloatArray:
    """(3K,) of the held positions from one design to another."""
    return (held_positions(equilibria, after.median) - held_positions(equilibria, before.median)).ravel()


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
    return settings.annealed(labels, energy, room, steps, seed)


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
