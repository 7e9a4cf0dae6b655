"""Rounds of flipped labels that bring a printed design nearer to the temporary shape.

Rounding a density and mending its labels costs accuracy, which flips win back (`flips.py`). Each round of them is
judged by the equilibria of the labels that result from it, and one that comes to nothing teaches what its flips are
worth.
"""

from dataclasses import dataclass, replace

import numpy as np

from fab4d.design.equilibria import Equilibria
from fab4d.design.flips import HELD_BACK, STEPS, FlipSettings, fineness, flip, near_interface, too_far
from fab4d.design.gauss_newton import Ahead, Design, evaluate, held_positions
from fab4d.design.influence import Influence, influence
from fab4d.design.objective import ObjectiveWeights, shape_error, smoothness_matrix
from fab4d.design.paths import follow_density
from fab4d.design.reduced import Search, Watch, refit
from fab4d.errors import EquilibriumError
from fab4d.mesh.tetmesh import BoolArray, FloatArray

# So many tets near the interface, those that promise most, are candidates of a round; of many tets, in proportion more.
MOST_CANDIDATES = 3000
# A flip has to lower the predicted squared error by this share of it: less once a round has come true, more once one
# has not, for many flips at once are predicted worse than few. A round that wins at least the first share of what it
# promised has come true, one that wins less than the second has not.
FIRST_PRICE, CHEAPER, DEARER = 3e-4, 1.5, 3.0
CAME_TRUE, CAME_TO_LITTLE = 0.6, 0.3
# A round has to lower the predicted squared error, and the objective, by this share.
LEAST_ROUND_GAIN = 2e-2
# So many rounds in a row that gain less end it. Once the tolerance is met, a round is also poor after which the target
# is more than MOST_TO_GO such rounds away.
MOST_POOR, MOST_TO_GO = 3, 6
# Moves of the held positions cost HELD_BACK times as much after flips whose equilibria are not found, for these mostly
# lie too far off, and LET_GO times less after flips that come true. Beyond MOST_DAMPING it is not for these moves.
LET_GO, MOST_DAMPING = 3.0, 1e3
# Steps of the held positions after each round, and the share of the objective by which one has to promise to lower it;
# once all rounds are made, they are fitted to the end.
FOLLOWING_STEPS, FOLLOWING_PROMISE = 6, 1e-2


@dataclass(frozen=True, eq=False)
class _Labels:
    """The best labels so far and what the next round goes by.

    value : of the objective        poor : rounds in a row that gained little
    price : of a flip, in squared errors        damping : of the held positions, as a multiple of the usual one
    found : what flips do, None where that is not known yet
    """

    design: Design
    value: float
    price: float
    damping: float = 1.0
    poor: int = 0
    found: Influence | None = None


def polish_labels(
    equilibria: Equilibria, design: Design, weights: ObjectiveWeights, settings: FlipSettings, watch: Watch
) -> Design:
    """The design with labels flipped near the interface as long as that brings it nearer to X_temp.

    design : of 0/1 labels, held positions fitted to them; the result is such a design too
    """
    problem, plain = equilibria.problem, weights.of_fixed_density()
    at = _Labels(design, _objective(equilibria, plain, design), FIRST_PRICE / fineness(problem))
    for seed in range(settings.rounds):
        rms = shape_error(problem, at.design.final.y).rms
        if rms <= settings.target_rms or at.poor >= _most_poor(settings, rms):
            break
        at = _informed(equilibria, plain, at)
        if at.found is None:
            break
        after = _after_round(equilibria, plain, settings, at, at.found, rms, seed)
        if after.design is not at.design:
            watch(Search(equilibria, after.design))
        at = after
    return refit(equilibria, at.design, weights, watch) if at.design is not design else design


def _after_round(
    equilibria: Equilibria,
    plain: ObjectiveWeights,
    settings: FlipSettings,
    at: _Labels,
    found: Influence,
    rms: float,
    seed: int,
) -> _Labels:
    """The labels after a round of flips, or the same with what the next round goes by."""
    problem, smp = equilibria.problem, at.design.rho > 0.5
    flipped = settings.printable(flip(problem, found, smp, smp, settings, at.price, STEPS, seed))
    changed = (flipped != smp)[found.tets]
    settled, unchanged = found.after(changed), found.after(np.zeros_like(changed))
    promised = unchanged.squared - settled.squared
    if promised <= LEAST_ROUND_GAIN * unchanged.squared:
        return replace(at, found=found, price=at.price / DEARER, poor=at.poor + 1)
    ahead = None if too_far(settled.moves) else found.ahead(changed, settled.moves)
    trial = None if ahead is None else _changed(equilibria, at.design, flipped, plain, ahead)
    if trial is None:
        poor, damping = at.poor + (at.damping >= MOST_DAMPING), HELD_BACK * at.damping
        return replace(at, found=found.damped(HELD_BACK), price=DEARER * at.price, damping=damping, poor=poor)
    fitted = refit(equilibria, trial, plain, lambda at: None, FOLLOWING_STEPS, FOLLOWING_PROMISE)  # noqa: ARG005
    value, new_rms = _objective(equilibria, plain, fitted), shape_error(problem, fitted.final.y).rms
    far = rms <= settings.tolerance and _rounds_to_go(rms, new_rms, settings.target_rms) > MOST_TO_GO
    poor = at.poor + 1 if far or value > (1 - LEAST_ROUND_GAIN) * at.value else 0
    if value >= at.value:
        taught = _taught(equilibria, at.design, trial, found, changed)
        return replace(at, found=taught, price=DEARER * at.price, poor=poor)
    won = (at.value - value) * plain.error_scale**2 / promised
    return _Labels(fitted, value, at.price * _price_change(won), max(at.damping / LET_GO, 1.0), poor)


def _objective(equilibria: Equilibria, weights: ObjectiveWeights, design: Design) -> float:
    return evaluate(equilibria, weights, smoothness_matrix(equilibria.problem), design)


def _most_poor(settings: FlipSettings, rms: float) -> int:
    """So many poor rounds in a row end the flips at this RMS error, L0."""
    return 1 if rms <= settings.low_rms else MOST_POOR


def _rounds_to_go(before: float, after: float, target: float) -> float:
    """How many rounds that lower the error by the same share as the last lead from `after` to `target`."""
    if after <= target:
        return 0.0
    return float(np.log(after / target) / np.log(before / after)) if after < before else np.inf


def _price_change(won: float) -> float:
    """The factor of the price after a round that won this share of what it promised."""
    if won >= CAME_TRUE:
        return 1 / CHEAPER
    return 1.0 if won >= CAME_TO_LITTLE else DEARER


def _informed(equilibria: Equilibria, plain: ObjectiveWeights, at: _Labels) -> _Labels:
    """The same knowing what flips near the interface do, if there is one."""
    if at.found is not None:
        return at
    problem = equilibria.problem
    tets = np.flatnonzero(near_interface(problem, at.design.rho > 0.5))
    if not tets.size:
        return at
    most = int(MOST_CANDIDATES * fineness(problem))
    return replace(at, found=influence(equilibria, at.design, tets, plain, most).damped(at.damping))


def _changed(
    equilibria: Equilibria, design: Design, labels: BoolArray, weights: ObjectiveWeights, ahead: Ahead
) -> Design | None:
    """The design with these labels (m,), held positions following; None where it has no stable equilibrium near."""
    try:
        return follow_density(equilibria, design, labels.astype(np.float64), weights, ahead)
    except EquilibriumError:
        return None


def _taught(equilibria: Equilibria, before: Design, trial: Design, found: Influence, changed: BoolArray) -> Influence:
    """What flips do, as what the tets `changed` (k,) have led to tells."""
    view, moves = found.view, _moves(equilibria, before, trial)
    shape = view.shape(equilibria.problem, trial.final.y) - moves @ view.shape_by_held
    limits = view.limits.at(trial.median) - moves @ view.limits_by_held
    return found.taught(changed, shape, limits)


def _moves(equilibria: Equilibria, before: Design, after: Design) -> FloatArray:
    """(3K,) of the held positions from one design to another."""
    return (held_positions(equilibria, after.median) - held_positions(equilibria, before.median)).ravel()
