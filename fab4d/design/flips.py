"""Single labels that are changed so that the printed design comes nearer to the temporary shape.

Rounding a density and mending its labels costs accuracy. Sensitivities of the error's smooth part with respect to every
density cost a few back-substitutions, and tell which flips at the interface win it back together; the held positions
follow. Each round of flips is judged by the equilibria of the labels that result from it.
"""

from collections.abc import Callable
from dataclasses import dataclass
from itertools import combinations_with_replacement

import numpy as np
from scipy.linalg import qr

from fab4d.design.equilibria import Equilibria
from fab4d.design.gauss_newton import Design, evaluate
from fab4d.design.objective import ObjectiveWeights, rigid_modes, shape_error, smoothness_matrix
from fab4d.design.problem import Problem
from fab4d.design.reduced import Search, Watch, change_density, refit
from fab4d.design.sensitivity import linearise
from fab4d.errors import EquilibriumError
from fab4d.mesh.tetmesh import BoolArray, FloatArray, IntArray

# The error is followed in polynomials of this degree, and in the error's own direction.
MODE_DEGREE = 3
FIRST_BATCH, LARGEST_BATCH = 40, 200
# A flip has to lower the predicted squared error by this share of it, a round the objective by this one.
LEAST_GAIN, LEAST_ROUND_GAIN = 1e-3, 1e-2
# Of more tets than this, in proportion more are flipped at once, each for a smaller gain.
USUAL_TETS = 5_000
# A whole flip changes the shape by another amount than the derivative says: less when stiff SMP comes in, more when it
# goes. The first guesses are corrected by each round.
FIRST_FACTORS = (0.25, 1.0)
FACTOR_BOUNDS = ((0.03, 0.6), (0.3, 4.0))
HELD_RIDGE = 1e-4
# Flips whose equilibria are farther away than steps of this share of the change go are given up.
# Then so many times fewer are tried.
SMALLEST_STEP, FEWER_AFTER_FAILURE = 0.25, 5
# Steps of the held positions after each round; once all are made, they are fitted to the end.
FOLLOWING_STEPS = 2

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
    rounds: int = 8


@dataclass(frozen=True, eq=False)
class ErrorModes:
    """The error as amplitudes (q,) of modes, and how density and held positions change them.

    directions (3N, q) : gradients of the amplitudes with respect to the final shape
    by_density (m, q), by_held (3K, q) : of the amplitudes with respect to rho and to the held positions
    """

    directions: FloatArray
    amplitudes: FloatArray
    by_density: FloatArray
    by_held: FloatArray


def polish_labels(
    equilibria: Equilibria, design: Design, weights: ObjectiveWeights, settings: FlipSettings, watch: Watch
) -> Design:
    """The design with labels flipped at the interface as long as that brings it nearer to X_temp.

    design : of 0/1 labels, held positions fitted to them; the result is such a design too
    """
    L, start = smoothness_matrix(equilibria.problem), design
    plain = weights.replace(lam_SMP=0.0, lam_mat=0.0, lam_round=0.0, lam_smooth=0.0)
    value = evaluate(equilibria, plain, L, design)
    finer = fineness(equilibria.problem)
    factors, batch, poor = np.array(FIRST_FACTORS), int(FIRST_BATCH * finer), 0
    modes: ErrorModes | None = None
    for _ in range(settings.rounds):
        if not batch or poor == 2 or shape_error(equilibria.problem, design.final.y).rms <= settings.target_rms:
            break
        modes = error_modes(equilibria, design) if modes is None else modes
        flips = choose_flips(equilibria.problem, modes, design.rho, factors, settings, batch)
        if not len(flips):
            break
        trial = _flipped(equilibria, design, flips, plain, settings)
        if trial is None:
            batch //= FEWER_AFTER_FAILURE
            continue
        printed, fitted = trial
        factors = _corrected(factors, modes, design, printed, equilibria.problem)
        new = evaluate(equilibria, plain, L, fitted)
        poor = poor + 1 if new > (1 - LEAST_ROUND_GAIN) * value else 0
        batch = min(batch * 3 // 2, int(LARGEST_BATCH * finer)) if new < value else max(batch // 3, 1)
        if new < value:
            design, value, modes = fitted, new, None
            watch(Search(equilibria, design))
    return refit(equilibria, design, weights, watch) if design is not start else start


def fineness(problem: Problem) -> float:
    """How many times more tets than USUAL_TETS there are, 1 at least."""
    return max(problem.n_tets / USUAL_TETS, 1.0)


def _flipped(
    equilibria: Equilibria, design: Design, flips: IntArray, weights: ObjectiveWeights, settings: FlipSettings
) -> tuple[Design, Design] | None:
    """The design with these tets flipped and made printable, before and after fitting the held positions."""
    labels = design.rho > 0.5
    labels[flips] = ~labels[flips]
    try:
        rho = settings.printable(labels).astype(np.float64)
        printed = change_density(equilibria, design, rho, SMALLEST_STEP, stay=True)
    except EquilibriumError:
        return None
    return printed, refit(equilibria, printed, weights, lambda at: None, iterations=FOLLOWING_STEPS)  # noqa: ARG005


# -- sensitivities


def error_modes(equilibria: Equilibria, design: Design) -> ErrorModes:
    """Amplitudes of the error of the final shape and their sensitivities."""
    problem, error = equilibria.problem, shape_error(equilibria.problem, design.final.y)
    e = (error.e @ error.R).ravel()
    weights = np.repeat(problem.area_weights, 3)
    outer = np.flatnonzero(weights)
    root = np.sqrt(weights[outer])[:, None]
    modes = np.column_stack([e / np.abs(e).max(), _polynomials(problem.body.X, MODE_DEGREE)])[outer]
    rigid, _ = np.linalg.qr(root * rigid_modes(design.final.y).reshape(-1, 6)[outer])
    basis = root * modes
    for _ in range(2):  # twice is enough for orthogonality to rounding
        basis -= rigid @ (rigid.T @ basis)
    # The fields are not independent on the few vertices of a coarse mesh.
    basis, r, _ = qr(basis, mode="economic", pivoting=True)
    size = np.abs(np.diag(r))
    basis = basis[:, size > 1e-6 * size[0]]
    directions = np.zeros((len(e), basis.shape[1]))
    directions[outer] = root * basis
    lin = linearise(equilibria, design.rho, design.median, design.final)
    by_density, by_held = lin.adjoint_many(directions)
    return ErrorModes(directions, directions.T @ e, by_density, by_held)


def _polynomials(X: FloatArray, degree: int) -> FloatArray:
    """(3N, q) vector fields: each monomial of X (N, 3) up to the degree in each of the three components."""
    centred = (X - X.mean(axis=0)) / np.abs(X - X.mean(axis=0)).max()
    powers = [c for d in range(degree + 1) for c in combinations_with_replacement(range(3), d)]
    monomials = np.column_stack([centred[:, c].prod(axis=1) if c else np.ones(len(X)) for c in map(list, powers)])
    return np.kron(monomials, np.eye(3))


# -- choice


def choose_flips(
    problem: Problem, modes: ErrorModes, rho: FloatArray, factors: FloatArray, settings: FlipSettings, most: int
) -> IntArray:
    """Tets at the interface whose flips, one after the other, lower the predicted error most, held positions following.

    factors : (2,) how much of the derivative a whole flip to SMP and one to TPE is worth
    """
    labels = rho > 0.5
    tets = np.flatnonzero(at_interface(problem, labels))
    change, residual = _predicted(modes, tets, np.where(labels[tets], -factors[1], factors[0]))
    own, usable = (change**2).sum(axis=1), np.ones(len(tets), bool)
    chosen, least = list[int](), LEAST_GAIN / fineness(problem)
    volumes = problem.volume_fractions[tets]
    while len(chosen) < most:
        room = settings.max_smp_fraction - problem.volume_fractions @ labels
        allowed = usable & at_interface(problem, labels)[tets] & (labels[tets] | (volumes <= room))
        gain = np.where(allowed, -2 * change @ residual - own, 0.0)
        worth = np.flatnonzero(gain > least * (residual @ residual))
        ranked = worth[np.argsort(-gain[worth])]
        best = next((k for k in ranked if settings.flippable(labels, int(tets[k]))), None)
        if best is None:
            break
        chosen.append(tets[best])
        residual = residual + change[best]
        labels[tets[best]], usable[best] = not labels[tets[best]], False
    return np.array(chosen, np.int64)


def whole_flips(modes: ErrorModes, rho: FloatArray) -> tuple[FloatArray, FloatArray]:
    """What another material in each tet alone does to the error, held positions following.

    rho : (m,) near 0/1. Returns the change (m, q) of the error's amplitudes by each flip, and the amplitudes (q,).
    """
    to_smp, to_tpe = FIRST_FACTORS
    return _predicted(modes, np.arange(len(rho)), np.where(rho > 0.5, -to_tpe, to_smp))


def _predicted(modes: ErrorModes, tets: IntArray, by: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Changes (k, q) of the amplitudes when the density of `tets` changes `by` (k,), and the amplitudes (q,), both
    without what the held positions take away."""
    change, follow = modes.by_density[tets] * by[:, None], _held_follow(modes.by_held)
    rest = modes.amplitudes - follow @ (modes.by_held @ modes.amplitudes)
    return change - (change @ modes.by_held.T) @ follow.T, rest


def _held_follow(by_held: FloatArray) -> FloatArray:
    """(q, 3K) maps H^T v to the part of v (q,) that held positions take away: H^T (H H^T + ridge)^-1."""
    k = len(by_held)
    # A part all of TPE comes back to its permanent shape wherever it was held.
    if not by_held.any():
        return by_held.T
    gram = by_held @ by_held.T
    return np.linalg.solve(gram + HELD_RIDGE * np.trace(gram) / k * np.eye(k), by_held).T


def at_interface(problem: Problem, labels: BoolArray) -> BoolArray:
    """(m,) tets with a face between SMP and TPE."""
    first, second = problem.neighbours.T
    between = labels[first] != labels[second]
    result = np.zeros(len(labels), bool)
    result[first[between]] = True
    result[second[between]] = True
    return result


def _corrected(factors: FloatArray, modes: ErrorModes, before: Design, after: Design, problem: Problem) -> FloatArray:
    """Factors halfway to those that explain what the flips really changed."""
    error = shape_error(problem, after.final.y)
    moved = modes.directions.T @ (error.e @ error.R).ravel() - modes.amplitudes
    step = (after.rho - before.rho)[:, None] * modes.by_density
    columns = np.column_stack([step[after.rho > before.rho].sum(axis=0), step[after.rho < before.rho].sum(axis=0)])
    found = np.linalg.lstsq(columns, moved, rcond=None)[0]
    low, high = np.transpose(FACTOR_BOUNDS)
    return np.clip(0.5 * (factors + found), low, high)
