"""Gauss-Newton steps on density and held positions; every accepted iterate is in equilibrium."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from scipy.sparse import csr_array

from fab4d.design.equilibria import RIG_COMPLIANCE, Equilibria, Final, Median
from fab4d.design.objective import (
    ObjectiveWeights,
    density_terms,
    force_excess,
    objective_value,
    shape_error,
    shape_metric,
)
from fab4d.design.sensitivity import Linearisation, linearise
from fab4d.mesh.tetmesh import BoolArray, FloatArray
from fab4d.solvers.linear import SingularMatrixError


@dataclass(frozen=True, eq=False)
class Design:
    """A density rho (m,), held positions c (K, 3), and the two equilibria that follow."""

    rho: FloatArray
    held: FloatArray
    median: Median
    final: Final


def equilibrate(
    equilibria: Equilibria,
    rho: FloatArray,
    held: FloatArray,
    x: FloatArray,
    forces: FloatArray,
    y: FloatArray,
    tolerance: float = 1e-8,
    max_iterations: int = 12,
) -> Design | None:
    """The design of rho and held positions from the guesses x, forces, y; None where an equilibrium is not found."""
    median = equilibria.solve_median(rho, held, x, forces, tolerance, max_iterations)
    if not median.solution.converged:
        return None
    final = equilibria.solve_final(rho, median, y, tolerance, max_iterations)
    return Design(rho, held, median, final) if final.solution.converged else None


@dataclass(frozen=True, eq=False)
class Model:
    """The quadratic model of the objective at a design, held positions eliminated exactly."""

    lin: Linearisation
    gradient_rho: FloatArray
    gradient_c: FloatArray
    dy_dc: FloatArray
    df_dc: FloatArray
    force_rows: FloatArray
    """(k, 3K) rows of the active force limits: d(excess)/df, scaled by sqrt(2 limit)."""
    metric: Callable[[FloatArray], FloatArray]
    H_cc: FloatArray
    curvature: FloatArray
    L: csr_array
    lam_smooth: float

    def hessian_rho(self, v: FloatArray, damping: FloatArray) -> FloatArray:
        """Schur complement of the held positions in the damped Gauss-Newton Hessian, times v (m,)."""
        zero = np.zeros((self.lin.n_patches, 3))
        dx, df, dy = self.lin.forward(v, zero)
        gy, gf = self.metric(dy.ravel()), self.force_rows.T @ (self.force_rows @ df.ravel())
        dc = -np.linalg.solve(self.H_cc, self.dy_dc.T @ gy + self.df_dc.T @ gf) if len(self.H_cc) else zero.ravel()
        dy2, df2 = dy.ravel() + self.dy_dc @ dc, df.ravel() + self.df_dc @ dc
        gy, gf = self.metric(dy2), self.force_rows.T @ (self.force_rows @ df2)
        g_rho, _ = self.lin.adjoint(np.zeros_like(dx), gf.reshape(-1, 3), gy.reshape(-1, 3))
        return g_rho + (self.curvature + damping) * v + 2 * self.lam_smooth * (self.L @ v)

    def held_step(self, drho: FloatArray) -> FloatArray:
        """The held-position change (K, 3) that minimises the model for a given drho (m,)."""
        if not len(self.H_cc):
            return np.zeros((0, 3))
        _, df, dy = self.lin.forward(drho, np.zeros((self.lin.n_patches, 3)))
        coupling = self.dy_dc.T @ self.metric(dy.ravel()) + self.df_dc.T @ (
            self.force_rows.T @ (self.force_rows @ df.ravel())
        )
        return -np.linalg.solve(self.H_cc, self.gradient_c.ravel() + coupling).reshape(-1, 3)


def build_model(
    equilibria: Equilibria, weights: ObjectiveWeights, L: csr_array, design: Design, damping_c: float
) -> Model:
    """Linearise both equilibria at the design and form the quadratic model."""
    problem = equilibria.problem
    lin = linearise(equilibria, design.rho, design.median, design.final)
    error = shape_error(problem, design.final.y)
    gy = (2 * problem.area_weights[:, None] * (error.e @ error.R)) / weights.error_scale**2
    f = design.median.forces
    size = np.linalg.norm(f, axis=1)
    excess = force_excess(f, weights.max_force)
    active = np.flatnonzero(excess > 0)
    rows = np.zeros((len(active), f.size))
    for row, p in enumerate(active):
        rows[row, 3 * p : 3 * p + 3] = np.sqrt(2 * weights.limit) * f[p] / (size[p] * weights.max_force)
    gf = (rows.T @ (np.sqrt(2 * weights.limit) * excess[active])).reshape(-1, 3)
    g_rho, g_c = lin.adjoint(np.zeros_like(gy), gf, gy)
    terms = density_terms(weights, problem.volume_fractions, L, design.rho)
    metric = shape_metric(problem, design.final.y, weights.error_scale).apply
    _, df_dc, dy_dc = lin.held_columns()
    force_part = rows @ df_dc
    H = dy_dc.T @ metric(dy_dc) + force_part.T @ force_part
    H = 0.5 * (H + H.T)
    H += damping_c * np.diag(np.diag(H).mean() * np.ones(len(H))) if len(H) else 0.0
    return Model(
        lin, g_rho + terms.gradient, g_c, dy_dc, df_dc, rows, metric, H, terms.curvature, L, weights.lam_smooth
    )


def _conjugate_gradients(
    apply: Callable[[FloatArray], FloatArray], b: FloatArray, diagonal: FloatArray, free: BoolArray, n: int, tol: float
) -> FloatArray:
    """x with A x = b on the free entries, at most n steps, Jacobi preconditioner; stops on negative curvature."""
    x, r = np.zeros_like(b), np.where(free, b, 0.0)
    z = r / diagonal
    p, rz = z, r @ z
    target = tol**2 * rz
    for _ in range(n):
        Ap = np.where(free, apply(p), 0.0)
        curvature = p @ Ap
        if curvature <= 0:
            break
        alpha = rz / curvature
        x, r = x + alpha * p, r - alpha * Ap
        z = r / diagonal
        rz, last = r @ z, rz
        if rz <= target:
            break
        p = z + (rz / last) * p
    return x


@dataclass(frozen=True, eq=False)
class Step:
    """What one Gauss-Newton step ended in."""

    design: Design
    value: float
    damping: float
    accepted: bool


def gauss_newton_step(
    equilibria: Equilibria,
    weights: ObjectiveWeights,
    L: csr_array,
    design: Design,
    value: float,
    damping: float,
    movable: BoolArray | None = None,
    cg_iterations: int = 30,
    tries: int = 6,
) -> Step:
    """One damped step; the damping falls after a good prediction and rises until the objective falls.

    movable : (m,) tets whose density may change; None for all
    """
    problem = equilibria.problem
    v = problem.volume_fractions
    model = build_model(equilibria, weights, L, design, damping_c=1e-6)
    smooth_diagonal = 2 * weights.lam_smooth * L.diagonal()
    for _ in range(tries):
        damp = damping * v
        # gradient with the held positions eliminated
        g = model.gradient_rho.copy()
        if len(model.H_cc):
            dc0 = -np.linalg.solve(model.H_cc, model.gradient_c.ravel())
            gy, gf = model.metric(model.dy_dc @ dc0), model.force_rows.T @ (model.force_rows @ (model.df_dc @ dc0))
            g += model.lin.adjoint(np.zeros((problem.n_nodes, 3)), gf.reshape(-1, 3), gy.reshape(-1, 3))[0]
        free = ~((design.rho <= 0) & (g > 0)) & ~((design.rho >= 1) & (g < 0))
        if movable is not None:
            free &= movable
        drho = np.zeros_like(design.rho)
        for _ in range(2):
            diagonal = model.curvature + damp + smooth_diagonal
            rhs = -g - (model.hessian_rho(drho, damp) if drho.any() else 0.0)
            drho = drho + _conjugate_gradients(
                lambda p, damp=damp: model.hessian_rho(p, damp), rhs, diagonal, free, cg_iterations, 0.05
            )
            clipped = np.clip(design.rho + drho, 0, 1) - design.rho
            hit = free & (clipped != drho)
            drho = clipped
            if not hit.any():
                break
            free &= ~hit
        dc = model.held_step(drho)
        trial = _trial(equilibria, model, design, drho, dc)
        if trial is not None:
            terms = density_terms(weights, v, L, trial.rho)
            new = objective_value(problem, weights, terms, trial.median, trial.final)
            if new < value:
                return Step(trial, new, damping / 3, True)
        damping *= 4
    return Step(design, value, damping, False)


def _trial(equilibria: Equilibria, model: Model, design: Design, drho: FloatArray, dc: FloatArray) -> Design | None:
    dx, df, dy = model.lin.forward(drho, dc)
    held = design.median.x
    c = equilibria.patches.mean(held) + RIG_COMPLIANCE * design.median.forces + dc
    body = equilibria.problem.body
    x, f, y = design.median.x + dx, design.median.forces + df, design.final.y + dy
    del body
    try:
        trial = equilibrate(equilibria, design.rho + drho, c, x, f, y)
        if trial is None:
            trial = equilibrate(equilibria, design.rho + drho, c, design.median.x, design.median.forces, design.final.y)
    except SingularMatrixError:
        return None
    return trial


def held_of(equilibria: Equilibria, median: Median) -> FloatArray:
    """Held positions (K, 3) at which the median's forces act."""
    return equilibria.patches.mean(median.x) + RIG_COMPLIANCE * median.forces


def snapped(design: Design, rho: FloatArray) -> Design:
    """The design with another density, equilibria not yet solved."""
    return replace(design, rho=rho)
