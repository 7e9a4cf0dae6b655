"""Labels that are changed so that the printed design comes nearer to the temporary shape.

Rounding a density and mending its labels costs accuracy. What a flip of each tet at the interface does to the final
shape tells which flips win it back together; the held positions follow. Each round of flips is judged by the equilibria
of the labels that result from it, and one that comes to nothing teaches what its flips are worth.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from fab4d.design.equilibria import Equilibria
from fab4d.design.gauss_newton import Design, evaluate
from fab4d.design.influence import Influence, influence
from fab4d.design.objective import ObjectiveWeights, shape_error, smoothness_matrix
from fab4d.design.problem import Problem
from fab4d.design.reduced import Search, Watch, change_density, refit
from fab4d.errors import EquilibriumError
from fab4d.mesh.tetmesh import BoolArray

FIRST_BATCH, LARGEST_BATCH = 40, 200
# So many tets at the interface, those that promise most, are candidates of a round.
MOST_CANDIDATES = 500
# A flip has to lower the predicted squared error by this share of it, a round by this one, and so the objective.
LEAST_GAIN, LEAST_ROUND_GAIN = 5e-4, 2e-2
# Of more tets than this, in proportion more are flipped at once, each for a smaller gain.
USUAL_TETS = 5_000
# So many rounds in a row that gain less end it.
MOST_POOR = 3
# Flips whose equilibria are farther away than steps of this share of the change go are given up, and so many times
# fewer are tried next.
SMALLEST_STEP, FEWER = 0.25, 3
# Steps of the held positions after each round; once all are made, they are fitted to the end.
FOLLOWING_STEPS = 6

Printable = Callable[[BoolArray], BoolArray]
Flippable = Callable[[BoolArray, int], bool]


@dataclass(frozen=True)
class FlipSettings:
    """printable : labels near the given ones that can be printed
    flippable : whether the flip of one tet of the given labels pinches nothing

    target_rms : RMS error, L0, at which nothing more is to be won        max_smp_fraction : of the volume
    """

    printable: Printable
    flippable: Flippable
    target_rms: float
    max_smp_fraction: float = 1.0
    rounds: int = 15


def polish_labels(
    equilibria: Equilibria, design: Design, weights: ObjectiveWeights, settings: FlipSettings, watch: Watch
) -> Design:
    """The design with labels flipped at the interface as long as that brings it nearer to X_temp.

    design : of 0/1 labels, held positions fitted to them; the result is such a design too
    """
    problem, start = equilibria.problem, design
    L = smoothness_matrix(problem)
    plain = weights.replace(lam_SMP=0.0, lam_mat=0.0, lam_round=0.0, lam_smooth=0.0)
    value = evaluate(equilibria, plain, L, design)
    finer = fineness(problem)
    batch, poor = int(FIRST_BATCH * finer), 0
    found: Influence | None = None
    for _ in range(settings.rounds):
        if not batch or poor == MOST_POOR or shape_error(problem, design.final.y).rms <= settings.target_rms:
            break
        smp = design.rho > 0.5
        if found is None:
            tets = np.flatnonzero(at_interface(problem, smp))
            found = influence(equilibria, design, tets, plain, int(MOST_CANDIDATES * finer))
        flipped = settings.printable(flip(problem, found, smp, smp, settings, batch))
        made = int((flipped != smp).sum())
        if error_left(found, smp, flipped) ** 2 >= (1 - LEAST_ROUND_GAIN) * error_left(found, smp, smp) ** 2:
            break
        trial = _changed(equilibria, design, flipped)
        if trial is None:
            batch = made // FEWER
            continue
        fitted = refit(equilibria, trial, plain, lambda at: None, iterations=FOLLOWING_STEPS)  # noqa: ARG005
        new = evaluate(equilibria, plain, L, fitted)
        poor = poor + 1 if new > (1 - LEAST_ROUND_GAIN) * value else 0
        if new < value:
            design, value, found = fitted, new, None
            batch = min(batch * 3 // 2, int(LARGEST_BATCH * finer))
            watch(Search(equilibria, design))
        else:
            seen = found.view.shape(problem, trial.final.y), found.view.limits.at(trial.median)
            found = found.taught((flipped != smp)[found.tets], *seen)
            batch = made * 2 // 3
    return refit(equilibria, design, weights, watch) if design is not start else start


def compensated(
    problem: Problem, found: Influence, before: BoolArray, smp: BoolArray, settings: FlipSettings
) -> BoolArray:
    """Printable labels near `smp` (m,), a repair of the labels `before` (m,), that make up for what it costs.

    found : what flips of `before` do, at least of the tets that smp changed and of those at the interface
    """
    better = settings.printable(flip(problem, found, before, smp, settings, len(found.tets)))
    return better if error_left(found, before, better) < error_left(found, before, smp) else smp


def error_left(found: Influence, before: BoolArray, smp: BoolArray) -> float:
    """The error, L0, that `found` predicts for the labels smp (m,) instead of `before` (m,), limits included."""
    return found.left((smp != before)[found.tets])


def fineness(problem: Problem) -> float:
    """How many times more tets than USUAL_TETS there are, 1 at least."""
    return max(problem.n_tets / USUAL_TETS, 1.0)


def _changed(equilibria: Equilibria, design: Design, labels: BoolArray) -> Design | None:
    """The design with these labels (m,) at the same held positions; None where it has no stable equilibrium near."""
    try:
        return change_density(equilibria, design, labels.astype(np.float64), SMALLEST_STEP, stay=True)
    except EquilibriumError:
        return None


def flip(
    problem: Problem, found: Influence, before: BoolArray, labels: BoolArray, settings: FlipSettings, most: int
) -> BoolArray:
    """Labels (m,) after flips at the interface, one after the other, that lower the predicted error most.

    before : (m,) labels that `found` is about        labels : (m,) to begin with        most : flips
    """
    labels, tets, volumes = labels.copy(), found.tets, problem.volume_fractions
    corners, pinching = problem.body.elements[tets, :4], np.zeros(len(tets), bool)
    least = LEAST_GAIN / fineness(problem)
    shape, beyond = found.measures((labels != before)[tets])
    slope, squared, toward = found.shape_change @ shape, float(shape @ shape), found.view.shape_by_held @ shape
    for _ in range(most):
        at = found.settled(squared, toward, beyond)
        sign = np.where((labels != before)[tets], -1.0, 1.0)
        room = settings.max_smp_fraction - volumes @ labels
        allowed = at_interface(problem, labels)[tets] & (labels[tets] | (volumes[tets] <= room)) & ~pinching
        gain = np.where(allowed, found.gains(at, slope, sign), 0.0)
        worth = np.flatnonzero(gain > least * at.squared)
        for best in worth[np.argsort(-gain[worth])]:
            if settings.flippable(labels, int(tets[best])):
                break
            pinching[best] = True
        else:
            break
        squared += float(2 * sign[best] * slope[best] + found.own[best])
        slope = slope + sign[best] * found.along(best)
        toward = toward + sign[best] * found.toward[best]
        beyond = beyond + sign[best] * found.limit_change[best]
        labels[tets[best]] = not labels[tets[best]]
        # Whether a flip pinches something depends on the tets that share a vertex with it.
        pinching &= ~np.isin(corners, corners[best]).any(axis=1)
    return labels


def at_interface(problem: Problem, labels: BoolArray) -> BoolArray:
    """(m,) tets with a face between SMP and TPE."""
    first, second = problem.neighbours.T
    between = labels[first] != labels[second]
    result = np.zeros(len(labels), bool)
    result[first[between]] = True
    result[second[between]] = True
    return result
