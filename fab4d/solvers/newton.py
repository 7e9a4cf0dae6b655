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
    UNSTABLE = "the equilibrium is unstable: the tangent has too many negative eigenvalues"


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


def newton(
    residual: Callable[[FloatArray], tuple[FloatArray, float]],
    factor: Callable[[FloatArray], Factor],
    z: FloatArray,
    tolerance: float,
    max_iterations: int = 25,
    fallback: Callable[[FloatArray], Factor] | None = None,
    n_negative: int = 0,
) -> Solution:
    """Solve residual(z) = 0.

    residual : z -> (r (n,), scale); r is not finite outside the domain, scale is what |r|_max is compared with
    factor, fallback : z -> factor of the tangent; `fallback` is used where `factor` has more than `n_negative` negative
        eigenvalues, and must have `n_negative`
    A step is halved until |r| falls or stays within the rounding of a converged state; each halving because of the domain
    counts as guarded.
    """
    r, scale = residual(z)
    norm, guarded = _norm(r), 0
    for iteration in range(max_iterations):
        if norm <= tolerance * scale:
            return Solution(z, Status.CONVERGED, norm / scale, iteration, guarded)
        try:
            last = factor(z)
            if fallback is not None and last.n_negative > n_negative:
                last = fallback(z)
            step = -last.solve(r)
        except SingularMatrixError:
            return Solution(z, Status.SINGULAR, norm / scale, iteration, guarded)
        t = 1.0
        for _ in range(30):
            r_new, scale_new = residual(z + t * step)
            norm_new = _norm(r_new)
            if not np.isfinite(norm_new):
                guarded += 1
            elif norm_new <= (1 - 1e-4 * t) * norm or norm_new <= tolerance * scale_new:
                break
            t *= 0.5
        else:
            return Solution(z, Status.NO_STEP, norm / scale, iteration, guarded)
        z, r, norm, scale = z + t * step, r_new, norm_new, scale_new
    status = Status.CONVERGED if norm <= tolerance * scale else Status.MAX_ITERATIONS
    return Solution(z, status, norm / scale, max_iterations, guarded)


def _norm(r: FloatArray) -> float:
    # The Euclidean norm, not the largest entry: near a held point the largest entry may rise on a good step.
    return float(np.sqrt(r @ r)) if np.all(np.isfinite(r)) else np.inf
