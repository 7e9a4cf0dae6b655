"""Damped Newton for a symmetric system with a domain guard; knows arrays and callables only."""

from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum

import numpy as np

from fab4d.mesh.tetmesh import FloatArray
from fab4d.solvers.linear import Factor, SingularMatrixError
from fab4d.solvers.negative_modes import descending


class Status(Enum):
    """Why a solver stopped; the value is the message."""

    CONVERGED = "converged"
    MAX_ITERATIONS = "the residual is still above the tolerance after the most iterations"
    NO_STEP = "no step along the Newton direction lowers the residual inside the domain"
    SINGULAR = "the tangent is singular"
    UNSTABLE = "the way leads past unstable states"
    ROUNDING = "rounding keeps the residual above the tolerance"


MAX_HALVINGS = 20
# A guess may be unstable where the equilibrium near it is not. Then each step leaves this share of its negative
# eigenvalues at most; ways with more lead away, nearly all of them to nothing.
STILL_NEGATIVE = 0.5
# Steps with an old factor are far cheaper than those with a new one, as long as each leaves this share of the residual
# at most.
CHORD_GAIN = 0.3
# Of a residual below this one, Newton's step leaves far less than this share, if anything but rounding is left of it.
ROUNDING_LEVEL, ROUNDING_LEFT = 1e-9, 0.5


@dataclass(frozen=True, eq=False)
class Solution:
    """z (n,), why the solver stopped, the residual norm relative to its scale, iterations, steps cut by the domain."""

    z: FloatArray
    status: Status
    residual: float
    iterations: int
    guarded: int

    @property
    def converged(self) -> bool:
        return self.status is Status.CONVERGED


@dataclass(frozen=True, eq=False)
class Residual:
    """r (n,) and potential at one z, both infinite outside the domain; `scale` is what |r| is compared with."""

    r: FloatArray
    scale: float
    potential: float

    @property
    def norm(self) -> float:
        """Euclidean norm of r, inf outside the domain."""
        # Not r @ r: BLAS wakes its threads for it, which costs more than the sum on a busy machine.
        return float(np.sqrt(np.einsum("i,i", self.r, self.r))) if np.isfinite(self.potential) else np.inf


def newton(
    residual: Callable[[FloatArray], Residual],
    factor: Callable[[FloatArray], Factor],
    z: FloatArray,
    tolerance: float,
    max_iterations: int = 25,
    fallback: Callable[[FloatArray], Factor] | None = None,
    n_negative: int = 0,
    advance: Callable[[FloatArray, FloatArray], FloatArray] = np.add,
    stay: bool = False,
    near: Factor | None = None,
) -> Solution:
    """Solve residual(z) = 0, the stationary point of a potential.

    factor, fallback : z -> factor of the tangent. Where `factor` has more than `n_negative` negative eigenvalues, the
        step is reversed along their modes; where those are many or not found, it comes from `fallback`, which must have
        `n_negative`. These belong to the last n_negative unknowns, the multipliers of constraints.
    advance : z, step -> z after the step; differs from z + step in second order only
    stay : give up where a step leaves more other negative eigenvalues than STILL_NEGATIVE of those before it: the
        stationary point that is found beyond is none near z
    near : factor of the tangent at a state near z
    A step is halved until the residual or the potential falls; halvings because of the domain count as guarded. Steps
    with the last factor, which cost far less, go between as long as each brings the residual down enough; only steps
    with a new factor count as iterations.
    """
    at, guarded = residual(z), 0
    if not np.isfinite(at.norm):
        # From outside the domain no residual tells where to go.
        return Solution(z, Status.NO_STEP, np.inf, 0, guarded)
    chord = near if near is not None and near.n_negative == n_negative else None
    most = np.inf
    for iteration in range(max_iterations):
        if chord is not None:
            z, at = _with_one_factor(residual, chord, z, at, tolerance, advance)
        if at.norm <= tolerance * at.scale:
            return Solution(z, Status.CONVERGED, at.norm / at.scale, iteration, guarded)
        try:
            step, chord, unstable = _step(factor, fallback, z, at.r, n_negative, most)
        except SingularMatrixError:
            return Solution(z, Status.SINGULAR, at.norm / at.scale, iteration, guarded)
        most = STILL_NEGATIVE * unstable if stay else np.inf
        if step is None:
            return Solution(z, Status.UNSTABLE, at.norm / at.scale, iteration, guarded)
        t, slope = 1.0, float(at.r @ step)
        for _ in range(MAX_HALVINGS):
            ahead = advance(z, t * step)
            new = residual(ahead)
            guarded += not np.isfinite(new.potential)
            if _improves(new, at, t, slope, tolerance):
                break
            t *= 0.5
        else:
            return Solution(z, Status.NO_STEP, at.norm / at.scale, iteration, guarded)
        little = new.norm > max(ROUNDING_LEFT * at.norm, tolerance * new.scale)
        rounding = little and at.norm <= ROUNDING_LEVEL * at.scale
        z, at = ahead, new
        if rounding:
            return Solution(z, Status.ROUNDING, at.norm / at.scale, iteration + 1, guarded)
    status = Status.CONVERGED if at.norm <= tolerance * at.scale else Status.MAX_ITERATIONS
    return Solution(z, status, at.norm / at.scale, max_iterations, guarded)


def _with_one_factor(
    residual: Callable[[FloatArray], Residual],
    factor: Factor,
    z: FloatArray,
    at: Residual,
    tolerance: float,
    advance: Callable[[FloatArray, FloatArray], FloatArray],
) -> tuple[FloatArray, Residual]:
    """z and its residual after steps with one factor, each of which leaves CHORD_GAIN of the residual at most."""
    while at.norm > tolerance * at.scale:
        ahead = advance(z, -factor.solve(at.r))
        new = residual(ahead)
        if new.norm > max(CHORD_GAIN * at.norm, tolerance * new.scale):
            break
        z, at = ahead, new
    return z, at


def _step(
    factor: Callable[[FloatArray], Factor],
    fallback: Callable[[FloatArray], Factor] | None,
    z: FloatArray,
    r: FloatArray,
    n_negative: int,
    most: float,
) -> tuple[FloatArray | None, Factor | None, int]:
    """Newton's step at z, changed where the tangent is singular or has more negative eigenvalues than it should; the
    factor where it is unchanged; how many more eigenvalues are negative.

    No step where more than `most` are. A singular tangent counts as one with none, and is refused if `most` is finite.
    """
    try:
        tangent = factor(z)
    except SingularMatrixError:
        if fallback is None or np.isfinite(most):
            raise
        return -fallback(z).solve(r), None, 0
    unstable = max(tangent.n_negative - n_negative, 0)
    if fallback is None or not unstable:
        return -tangent.solve(r), tangent, unstable
    if unstable > most:
        return None, None, unstable
    turned = descending(tangent, -tangent.solve(r), len(z) - n_negative, unstable)
    return -fallback(z).solve(r) if turned is None else turned, None, unstable


def _improves(new: Residual, old: Residual, t: float, slope: float, tolerance: float) -> bool:
    if new.norm <= max((1 - 1e-4 * t) * old.norm, tolerance * new.scale):
        return True
    # Armijo's rule, for descent directions only; far from the solution the residual may have to rise first.
    return slope < 0 and new.potential <= old.potential + 1e-4 * t * slope
