"""The reduced solver: density and held positions as unknowns, every iterate in equilibrium (solver.md section 1)."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from enum import Enum

import numpy as np
from scipy.sparse import csr_array

from fab4d.design.equilibria import Equilibria, Final, Median
from fab4d.design.exchange import exchanged
from fab4d.design.forward import load
from fab4d.design.gauss_newton import (
    FIRST_DAMPING,
    Design,
    build_model,
    evaluate,
    gauss_newton_step,
    held_positions,
)
from fab4d.design.objective import ObjectiveWeights, shape_error, smoothness_matrix, stretch_excess
from fab4d.design.patches import Patches, build_patches, spread_centers
from fab4d.design.paths import toward_density
from fab4d.design.problem import Problem
from fab4d.errors import EquilibriumError
from fab4d.mesh.measures import face_area_vectors
from fab4d.mesh.tetmesh import BoolArray, FloatArray, IntArray

START_DENSITY = 0.6
UNDECIDED = (1e-3, 1 - 1e-3)
LARGEST_DAMPING = 30.0
FIRST_LAM_ROUND = 0.02
# Points are exchanged after this many relaxed steps, so many times at most, and not where the error is below this share
# of the tolerance.
EXCHANGE_AFTER, EXCHANGED, GOOD_ENOUGH = 3, 4, 0.25
STEPS_AFTER_EXCHANGE = 2
# Larger pads are taken where the pull on a small one is more than this share of the TPE's shear modulus: it dents the
# surface and creases it at the rim.
LARGEST_TRACTION = 0.25
# While rounding, the error counts 1 at this multiple of the relaxed one, if that is below the tolerance, but not below
# the second share of it: for errors that are asked to be far smaller than anybody needs, labels turn fine-grained, and
# print worse.
ROUNDING_LOSS, LEAST_SCALE = 1.5, 0.25
# While there is too much SMP, its price grows by this power of the growth of lam_round; below the limit it falls again,
# for a price that drives SMP far below costs accuracy.
DEARER = 0.86
# So many rounding steps in a row that come to nothing end it: the equilibria turn unstable on its way. These are steps
# that are not taken, or taken with the largest damping and less than this share of the undecided tets decided.
MOST_STUCK, LEAST_DECIDED = 3, 0.02
# Of what is left then, this share is rounded at a time, or so many tets, or this share of all, with as many tries of a
# step that follows.
DECIDED_SHARE, FEWEST_DECIDED, LEAST_SHARE, DECIDED_TRIES = 0.5, 4, 1e-2, 3
# Densities are rounded in steps of at least this share of the way. Where these end before, the step that follows may
# clear the way for others, but not so many times in a row.
DECIDED_STEP, MOST_BARRED = 0.1, 3
# Where no equilibrium leads to more of them, this share of tets may stay undecided: printing rounds them.
LEFT_UNDECIDED = 0.02
# Held at fewer points, a part without a clamp can turn about the line through them.
FEWEST_FREE_POINTS = 3
# A fit of the held positions ends with a step that gains less than the first share of the objective, and tries no step
# that promises less than the second.
SLOW_REFIT, LEAST_PROMISE, REFIT_TRIES = 1e-2, 1e-3, 12
# The smallest number of points is looked for from here.
FIRST_COUNT = 4


@dataclass(frozen=True, eq=False)
class ReducedSettings:
    """Number of the patches and the radii (L0) to choose from, the objective, how long each phase may go on, and the
    factor by which lam_round grows in each step.

    nearly : where the tolerance is missed by up to this factor, relaxing goes on with steps past unstable states
    centers : (n_points,) vertices at which points are held first; None spreads them over the body
    """

    n_points: int
    patch_radii: tuple[float, ...]
    weights: ObjectiveWeights
    max_smp_fraction: float = 1.0
    relax_iterations: int = 15
    round_iterations: int = 40
    undecided_fraction: float = 2e-4
    round_growth: float = 1.6
    nearly: float = 1.5
    centers: IntArray | None = None


class Phase(Enum):
    """What the solver does next."""

    RELAX = "relax"
    EXCHANGE = "exchange"
    ROUND = "round"
    DONE = "done"


@dataclass(frozen=True, eq=False)
class Search:
    """The whole state of the solver between two steps: going on from it gives the same bits as never having stopped.

    patch_radius : L0        phase : of the next step
    dearer : the price of SMP while rounding, in lam_SMP
    iteration, slow : steps of this phase, and how many of the last gained little, or while rounding were stuck
    exchanges : how often points were exchanged; EXCHANGED when no more is to be gained that way
    accepted : whether the last step found a better design        relaxed_rms : RMS error, L0, before rounding began
    stay : whether steps whose way leads past unstable states are given up
    """

    equilibria: Equilibria
    design: Design
    patch_radius: float = 0.0
    phase: Phase = Phase.RELAX
    lam_SMP: float = 0.0
    dearer: float = 1.0
    lam_round: float = 0.0
    damping: float = FIRST_DAMPING
    iteration: int = 0
    slow: int = 0
    exchanges: int = 0
    accepted: bool = True
    relaxed_rms: float = np.inf
    stay: bool = True

    @property
    def rms(self) -> float:
        """RMS error of the design, L0."""
        return shape_error(self.equilibria.problem, self.design.final.y).rms


Watch = Callable[[Search], None]


def solve_reduced(problem: Problem, settings: ReducedSettings, watch: Watch, start: Search | None = None) -> Search:
    """A near 0/1 design that brings the final shape to X_temp with `n_points` held patches.

    start : the state of an interrupted run, to go on from
    Raises EquilibriumError when no equilibrium near X_temp is found with so few patches.
    """
    L = smoothness_matrix(problem)
    at = relaxed(problem, settings, watch, start)
    while at.phase is not Phase.DONE:
        at = STEPS[at.phase](at, settings, L)
        watch(at)
    return decided(at, settings, watch) or at


def relaxed(problem: Problem, settings: ReducedSettings, watch: Watch, start: Search | None = None) -> Search:
    """The best relaxed design: as `solve_reduced`, but only as far as rounding."""
    L = smoothness_matrix(problem)
    at = start
    if at is None:
        at = first_search(problem, settings)
        watch(at)
    while at.phase in (Phase.RELAX, Phase.EXCHANGE):
        at = STEPS[at.phase](at, settings, L)
        watch(at)
    return at


def fewest_points(problem: Problem, settings: ReducedSettings, enough: float, watch: Watch) -> int:
    """The fewest points, `settings.n_points` at most, whose relaxed design has an RMS error of at most `enough`, L0.

    By doubling and bisection, so it is the smallest if more points are never worse. The most if none is enough.
    """

    def meets(count: int) -> bool:
        try:
            found = relaxed(problem, replace(settings, n_points=count), watch)
        except EquilibriumError:
            return False
        return found.relaxed_rms <= enough

    most = settings.n_points
    low, high = 0, min(FIRST_COUNT, most)
    while not meets(high):
        if high == most:
            return most
        low, high = high, min(2 * high, most)
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (low, middle) if meets(middle) else (middle, high)
    return high


# -- start


def first_search(problem: Problem, settings: ReducedSettings) -> Search:
    """The points held where the wanted shape has them, everything else relaxed from X_temp.

    With the smallest patches whose pull stretches no material too far and whose traction is below LARGEST_TRACTION, or
    else the largest. Raises EquilibriumError when no equilibrium near X_temp is found with so few patches.
    """
    if not problem.clamp.any() and settings.n_points < FEWEST_FREE_POINTS:
        msg = f"a part without a clamp needs {FEWEST_FREE_POINTS} points at least: give one or raise [goal] max_forces"
        raise EquilibriumError(msg)
    rho = np.full(problem.n_tets, START_DENSITY)
    x = np.where(problem.clamp[:, None], problem.body.X, problem.X_temp)
    centers = spread_centers(problem, settings.n_points) if settings.centers is None else settings.centers
    needed = 0.0
    for radius in settings.patch_radii:
        if radius < needed and radius != settings.patch_radii[-1]:
            continue
        equilibria, median = _held_at_target(problem, centers, radius, rho, x)
        traction = largest_traction(equilibria.patches, problem, median)
        if traction <= LARGEST_TRACTION and not len(stretch_excess(problem, settings.weights, rho, median.x).tets):
            break
        # The forces grow with the pads, so that none smaller than this will do.
        needed = radius * np.sqrt(traction / LARGEST_TRACTION)
    final = equilibria.solve_final(rho, median, median.x, max_iterations=100)
    if not final.solution.converged:
        msg = f"the first design finds no final shape ({final.solution.status.value}): check the temporary shape"
        raise EquilibriumError(msg)
    return Search(equilibria, Design(rho, median, final), radius, lam_SMP=settings.weights.lam_SMP)


def largest_traction(patches: Patches, problem: Problem, median: Median) -> float:
    """The largest mean traction of a patch, in mu_TPE."""
    if not patches.count:
        return 0.0
    areas = np.linalg.norm(face_area_vectors(problem.body.X, patches.faces), axis=1)
    pulls = np.linalg.norm(median.forces, axis=1)
    return float((pulls / np.add.reduceat(areas, patches.offsets[:-1])).max())


def _held_at_target(
    problem: Problem, centers: IntArray, radius: float, rho: FloatArray, x: FloatArray
) -> tuple[Equilibria, Median]:
    """Patches held where X_temp has them and the median shape near x.

    Where Newton does not find it from there, with four times as many held first; else where loading from the permanent
    shape ends.
    """
    equilibria = Equilibria(problem, build_patches(problem, centers, radius))
    median = _relaxed(equilibria, rho, x)
    if not median.solution.converged:
        dense = equilibria.with_patches(spread_patches(problem, 4 * len(centers), radius))
        median = _relaxed(equilibria, rho, _relaxed(dense, rho, x).x)
    if not median.solution.converged:
        median, _, loaded = load(equilibria, rho, x, np.zeros((equilibria.patches.count, 3)))
        if loaded < 1.0 or not median.solution.converged:
            msg = (
                f"no equilibrium near the temporary shape with {equilibria.patches.count} points held "
                f"({median.solution.status.value}): allow more points ([goal] max_forces)"
            )
            raise EquilibriumError(msg)
    return equilibria, median


def at_rest(problem: Problem) -> Search:
    """The part of TPE alone, with nothing held: it stays in its permanent shape."""
    equilibria = Equilibria(problem, build_patches(problem, np.zeros(0, np.int64), 0.0))
    rho, X = np.zeros(problem.n_tets), problem.body.X
    median = equilibria.solve_median(rho, np.zeros((0, 3)), X, np.zeros((0, 3)))
    design = Design(rho, median, equilibria.solve_final(rho, median, X))
    return Search(equilibria, design, phase=Phase.DONE)


def _relaxed(equilibria: Equilibria, rho: FloatArray, x: FloatArray) -> Median:
    """The median shape reached from x with the patches held where X_temp has them."""
    patches = equilibria.patches
    held = patches.mean(equilibria.problem.X_temp)
    return equilibria.solve_median(rho, held, x, np.zeros((patches.count, 3)), max_iterations=100)


def spread_patches(problem: Problem, count: int, radius: float) -> Patches:
    """`count` patches spread over the body, or as many as it has room for."""
    return build_patches(problem, spread_centers(problem, count), radius)


# -- phases


def relax_step(at: Search, settings: ReducedSettings, L: csr_array) -> Search:
    """Gauss-Newton on the relaxed density until the objective falls by less than 2 % in two steps running.

    Where that nearly meets the tolerance, once more with steps past unstable states.
    """
    weights = settings.weights.replace(lam_SMP=at.lam_SMP)
    value = evaluate(at.equilibria, weights, L, at.design)
    step = gauss_newton_step(at.equilibria, weights, L, at.design, at.damping, stay=at.stay)
    slow = at.slow + 1 if step.value > 0.98 * value else 0
    after = replace(at, design=step.design, damping=step.damping, accepted=step.accepted, slow=slow)
    if at.exchanges < EXCHANGED and (not step.accepted or slow == 2 or at.iteration + 1 == EXCHANGE_AFTER):
        return replace(after, phase=Phase.EXCHANGE, iteration=at.iteration + 1)
    if not step.accepted or slow == 2 or at.iteration + 1 >= settings.relax_iterations:
        rms = shape_error(at.equilibria.problem, step.design.final.y).rms
        if at.stay and weights.error_scale < rms <= settings.nearly * weights.error_scale:
            damping = min(step.damping, LARGEST_DAMPING)
            return replace(after, stay=False, damping=damping, iteration=0, slow=0, exchanges=EXCHANGED - 1)
        rounding = replace(after, phase=Phase.ROUND, lam_round=FIRST_LAM_ROUND, damping=FIRST_DAMPING, relaxed_rms=rms)
        return replace(rounding, iteration=0, slow=0)
    return replace(after, iteration=at.iteration + 1)


def exchange_step(at: Search, settings: ReducedSettings, L: csr_array) -> Search:
    """Hold other points where that promises a lower objective and keeps it; relaxing goes on with either."""
    weights = settings.weights.replace(lam_SMP=at.lam_SMP)
    done = replace(at, phase=Phase.RELAX, exchanges=EXCHANGED, slow=0)
    if at.rms <= GOOD_ENOUGH * weights.error_scale:
        return done
    model, value = build_model(at.equilibria, weights, L, at.design), evaluate(at.equilibria, weights, L, at.design)
    for equilibria, moved in exchanged(at.equilibria, weights, model, at.design, at.patch_radius):
        design, damping = moved, FIRST_DAMPING
        for _ in range(STEPS_AFTER_EXCHANGE):
            step = gauss_newton_step(equilibria, weights, L, design, damping, stay=at.stay)
            design, damping = step.design, step.damping
        if evaluate(equilibria, weights, L, design) < value:
            after = replace(at, equilibria=equilibria, design=design, phase=Phase.RELAX, damping=damping)
            return replace(after, iteration=0, slow=0, exchanges=at.exchanges + 1, accepted=True)
    return done


def round_step(at: Search, settings: ReducedSettings, L: csr_array) -> Search:
    """Raise lam_round until all but a few densities are 0 or 1, held positions following, or steps come to nothing."""
    dearer = _dearer(at, settings)
    weights = _rounding_weights(replace(at, dearer=dearer), settings)
    step = gauss_newton_step(at.equilibria, weights, L, at.design, at.damping, stay=at.stay)
    before, left = undecided_fraction(at.design.rho), undecided_fraction(step.design.rho)
    stuck = not step.accepted or (step.damping >= LARGEST_DAMPING and left > (1 - LEAST_DECIDED) * before)
    slow = at.slow + 1 if stuck else 0
    finished = (
        left <= settings.undecided_fraction or at.iteration + 1 == settings.round_iterations or slow == MOST_STUCK
    )
    return replace(
        at,
        design=step.design,
        phase=Phase.DONE if finished else Phase.ROUND,
        dearer=dearer,
        lam_round=settings.round_growth * at.lam_round,
        damping=min(step.damping, LARGEST_DAMPING),
        iteration=at.iteration + 1,
        slow=slow,
        accepted=step.accepted,
    )


def _dearer(at: Search, settings: ReducedSettings) -> float:
    """How many times dearer SMP is in the next rounding step than before rounding."""
    too_much = at.equilibria.problem.volume_fractions @ at.design.rho > settings.max_smp_fraction
    factor = settings.round_growth**DEARER
    return factor * at.dearer if too_much else max(at.dearer / factor, 1.0)


def _rounding_weights(at: Search, settings: ReducedSettings) -> ObjectiveWeights:
    # Where the relaxed design is far better than it has to be, rounding may not spend all of that.
    tolerance = settings.weights.error_scale
    scale = float(np.clip(ROUNDING_LOSS * at.relaxed_rms, LEAST_SCALE * tolerance, tolerance))
    return settings.weights.replace(error_scale=scale, lam_SMP=at.dearer * at.lam_SMP, lam_round=at.lam_round)


STEPS = {Phase.RELAX: relax_step, Phase.EXCHANGE: exchange_step, Phase.ROUND: round_step}


def undecided_fraction(rho: FloatArray) -> float:
    """Share of tets whose density is neither 0 nor 1."""
    return float(np.mean(_undecided(rho)))


def _undecided(rho: FloatArray) -> BoolArray:
    return (rho > UNDECIDED[0]) & (rho < UNDECIDED[1])


def decided(at: Search, settings: ReducedSettings, watch: Watch) -> Search | None:
    """The state with all its densities rounded, as it is where the share that `settings` allow or less is undecided.

    None where no equilibrium holds them.
    """
    if undecided_fraction(at.design.rho) <= settings.undecided_fraction:
        return at
    return decided_by_and_by(at, settings, watch)


def decided_by_and_by(at: Search, settings: ReducedSettings, watch: Watch) -> Search | None:
    """The surest densities rounded first; the others and the held positions make up for it.

    watch : is shown the state after each step
    Where no equilibrium leads on, the last few stay undecided; None where they are more than LEFT_UNDECIDED. Densities
    that are nearly 0 or 1 stay so where they cannot all be.
    """
    equilibria, weights = at.equilibria, _rounding_weights(at, settings).replace(lam_round=0.0)
    L, barred, clear = smoothness_matrix(equilibria.problem), 0, weights.lam_stable > 0
    while (left := np.flatnonzero(_undecided(at.design.rho))).size and barred < MOST_BARRED:
        count = max(int(DECIDED_SHARE * len(left)), FEWEST_DECIDED, int(LEAST_SHARE * equilibria.problem.n_tets))
        sure, unsure = np.split(left[np.argsort(-np.abs(at.design.rho[left] - 0.5), kind="stable")], [count])
        rho, movable = at.design.rho.copy(), np.zeros(len(at.design.rho), bool)
        rho[sure], movable[unsure] = np.round(rho[sure]), True
        design, done = toward_density(equilibria, at.design, rho, DECIDED_STEP, stay=clear)
        barred = 0 if done == 1.0 else barred + 1
        step = gauss_newton_step(equilibria, weights, L, design, at.damping, movable, DECIDED_TRIES, stay=at.stay)
        damping = min(step.damping, LARGEST_DAMPING)
        at = replace(at, design=step.design, damping=damping, iteration=at.iteration + 1, accepted=True)
        watch(at)
    if undecided_fraction(at.design.rho) > LEFT_UNDECIDED:
        return None
    design, done = toward_density(equilibria, at.design, np.round(at.design.rho), DECIDED_STEP)
    found = replace(at, design=design if done == 1.0 else at.design, phase=Phase.DONE)
    watch(found)
    return found


# -- refit


def refit(
    equilibria: Equilibria,
    design: Design,
    weights: ObjectiveWeights,
    watch: Watch,
    iterations: int = 12,
    least_promise: float = LEAST_PROMISE,
) -> Design:
    """Held positions that are best for the design's fixed density; the density does not move.

    least_promise : share of the objective by which a step has to promise to lower it
    """
    problem = equilibria.problem
    weights = weights.of_fixed_density()
    L = smoothness_matrix(problem)
    fixed = np.zeros(problem.n_tets, bool)
    damping, value = FIRST_DAMPING, evaluate(equilibria, weights, L, design)
    for _ in range(iterations):
        step = gauss_newton_step(equilibria, weights, L, design, damping, fixed, REFIT_TRIES, least_promise)
        if not step.accepted:
            break
        slow = step.value > (1 - SLOW_REFIT) * value
        design, damping, value = step.design, step.damping, step.value
        watch(Search(equilibria, design, phase=Phase.DONE))
        if slow:
            break
    return design


def polished(equilibria: Equilibria, design: Design, tolerance: float = 1e-11) -> Design:
    """The same design with both equilibria solved as far as rounding allows."""
    median: Median = equilibria.solve_median(
        design.rho, held_positions(equilibria, design.median), design.median.x, design.median.forces, tolerance
    )
    final: Final = equilibria.solve_final(design.rho, median, design.final.y, tolerance)
    return replace(design, median=median, final=final)
