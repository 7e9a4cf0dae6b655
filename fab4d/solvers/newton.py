"""Damped Newton for a symmetric system with a domain guard; knows arrays and callables only."""

from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum

import numpy as np

from fab4d.mesh.tetmesh import FloatArray
from fab4d.solvers.linear import Factor, SingularMatrixError


class Status(Enum):
    """Why a solver stopped; the value is the message."""

    CONVERGED = "converged"
    MAX_ITERATIONS = "the residual is still above the tolerance after the most iterations"
    NO_STEP = "no step along the Newton direction lowers the residual inside the domain"
    SINGULAR = "the tangent is singular"


MAX_HALVINGS = 20


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
) -> Solution:
    """Solve residual(z) = 0, the stationary point of a potential.

    factor, fallback : z -> factor of the tangent; `fallback` is used where `factor` has more than `n_negative` negative
        eigenvalues, and must have `n_negative`
    advance : z, step -> z after the step; differs from z + step in second order only
    A step is halved until the residual or the potential falls; halvings because of the domain count as guarded.
    """
    at, guarded = residual(z), 0
    for iteration in range(max_iterations):
        if at.norm <= tolerance * at.scale:
            return Solution(z, Status.CONVERGED, at.norm / at.scale, iteration, guarded)
        try:
            step = -_usable(factor, fallback, z, n_negative).solve(at.r)
        except SingularMatrixError:
            return Solution(z, Status.SINGULAR, at.norm / at.scale, iteration, guarded)
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
        z, at = ahead, new
    status = Status.CONVERGED if at.norm <= tolerance * at.scale else Status.MAX_ITERATIONS
    return Solution(z, status, at.norm / at.scale, max_iterations, guarded)


def _usable(
    factor: Callable[[FloatArray], Factor],
    fallback: Callable[[FloatArray], Factor] | None,
    z: FloatArray,
    n_negative: int,
) -> Factor:
    """The factor at z, or the fallback where it has other negative eigenvalues than it should, or is singular."""
    if fallback is None:
        return factor(z)
    try:
        tangent = factor(z)
    except SingularMatrixError:
        return fallback(z)
    return fallback(z) if tangent.n_negative > n_negative else tangent


def _improves(new: Residual, old: Residual, t: float, slope: float, tolerance: float) -> bool:
    if new.norm <= max((1 - 1e-4 * t) * old.norm, tolerance * new.scale):
        return True
    # Armijo's rule, for descent directions only; far from the solution the residual may have to rise first.
    return slope < 0 and new.potential <= old.potential + 1e-4 * t * slope
