"""Gauss-Newton steps on density and held positions; every accepted iterate is in equilibrium."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np
from scipy.linalg import cho_factor, cho_solve
from scipy.sparse import csr_array, vstack

from fab4d.design.equilibria import RIG_COMPLIANCE, Equilibria, Final, Median, Pinned
from fab4d.design.forward import unload
from fab4d.design.objective import (
    DensityTerms,
    ObjectiveWeights,
    ShapeMetric,
    density_terms,
    forces_beyond,
    objective_value,
    shape_error,
    shape_metric,
    squeeze,
    stretch_excess,
)
from fab4d.design.sensitivity import Change, Linearisation, linearise
from fab4d.design.stability import softening, softening_penalty
from fab4d.mesh.tetmesh import BoolArray, FloatArray
from fab4d.solvers.threads import first_found

# Relative residual at which an iterate counts as in equilibrium; the delivered state is solved to rounding.
SEARCH_TOLERANCE = 1e-6
# That of the states on the way of unloading, which only serve to guess the next.
UNLOADING_TOLERANCE = 1e-2
# The guess of a final shape follows its median shape by linear maps, unless that moves farther than this, in L0; then
# it moves as far.
FOLLOWED_FAR = 0.1


@dataclass(frozen=True, eq=False)
class Design:
    """A density rho (m,) and the two equilibria that follow from it and the held positions."""

    rho: FloatArray
    median: Median
    final: Final


@dataclass(frozen=True, eq=False)
class Ahead:
    """Where linear algebra has the equilibria after a change: moves (K, 3) of the held positions, and what they and the
    change of the density do to x (N, 3), f (K, 3) and y (N, 3).

    near : the linear maps that tell
    """

    moves: FloatArray
    x: FloatArray
    f: FloatArray
    y: FloatArray
    near: Linearisation

    def part(self, share: float) -> "Ahead":
        """That of a share of the change."""
        return Ahead(share * self.moves, share * self.x, share * self.f, share * self.y, self.near)


def equilibrate(
    equilibria: Equilibria,
    rho: FloatArray,
    held: FloatArray,
    x: FloatArray,
    forces: FloatArray,
    y: FloatArray,
    tolerance: float = SEARCH_TOLERANCE,
    max_iterations: int = 12,
    stay: bool = False,
    near: Linearisation | None = None,
    by_unloading: bool = False,
) -> Design | None:
    """The design of rho and held positions from the guesses x, forces, y; None where an equilibrium is not found.

    Where the median shape is found moves from its guess, the guess of the final shape follows: what stiff SMP has
    frozen would else be bent in it. near : about a design near this one
    by_unloading : whether a final shape that is not found from its guess is looked for where unloading ends, which
        costs three times as much and leads to labels whose final shape lies far from those before
    """
    hot, cold = (None, None) if near is None else (near.held, Pinned(near.free, near.free_fixed))
    median = equilibria.solve_median(rho, held, x, forces, tolerance, max_iterations, stay=stay, near=hot)
    if not median.solution.converged:
        return None
    moved = median.x - x
    follow = moved if near is None or np.abs(moved).max() > FOLLOWED_FAR else near.final_follows(moved)
    y = _ahead(equilibria.free_turning.step, y, follow, lambda y: equilibria.final_gradient(rho, median, y)[1])
    final = equilibria.solve_final(rho, median, y, tolerance, max_iterations, stay=stay, near=cold)
    if by_unloading and not final.solution.converged:
        final, _, unloaded = unload(equilibria, rho, median, UNLOADING_TOLERANCE, tolerance, stay)
        return Design(rho, median, final) if unloaded == 1.0 and final.solution.converged else None
    return Design(rho, median, final) if final.solution.converged else None


TRIAL_ITERATIONS = 8
# The way past unstable states is longer.
ASTRAY_ITERATIONS = 20
# The equilibria of a step are sought from where it is predicted to lead, or from the first of these shares of the way.
SHARES_OF_CHANGE = (1.0, 0.5, 0.25, 0.125)
# Damping of the first step where nothing is known of it.
FIRST_DAMPING = 0.3
# Damping falls by the first factor after a step that was taken at once, and rises by the second after one that was not:
# a step that fails costs more than one that is held back a little.
SOFTER, STIFFER = 3.0, 5.0
# A step that is predicted to move a node farther than this, in L0, is not tried.
LARGEST_MOVE = 0.1
# A held position may move this far, in L0, at the cost of a density that changes by 1 everywhere.
HELD_STEP = 0.05
# So may the nodes of the median shape in the root mean square: where that is nearly unstable, small changes of density
# and held positions move it far along a soft mode, and its linear prediction is of no use there.
MEDIAN_STEP = 0.02
# Share of the largest entry of a Hessian that is rounding.
ROUNDED_OFF = 1e-13


@dataclass(frozen=True, eq=False)
class Model:
    """The quadratic model of the objective at a design, in drho (m,) with the held positions eliminated exactly.

    gradient_rho (m,), gradient_c (3K,) : gradient of the objective
    dy_dc (3N, 3K), df_dc (3K, 3K) : derivatives of final shape and forces with respect to the held positions
    dx_dc (3N, 3K) : derivative of the median shape with respect to the held positions
    force_rows (k, 3K), shape_rows (k, 3N) : derivatives of the active limits of forces, stretches and soft modes
    H_cc (3K, 3K) : Gauss-Newton Hessian of the held positions
    """

    lin: Linearisation
    metric: ShapeMetric
    gradient_rho: FloatArray
    gradient_c: FloatArray
    dx_dc: FloatArray
    df_dc: FloatArray
    dy_dc: FloatArray
    force_rows: FloatArray
    shape_rows: csr_array
    H_cc: FloatArray
    moved_cc: FloatArray
    terms: DensityTerms
    L: csr_array
    lam_smooth: float

    def damped(self, damping: float, volume_fractions: FloatArray) -> "DampedModel":
        """The model with Levenberg-Marquardt terms that hold back density and held positions alike."""
        k = len(self.H_cc)
        moves = 6 * damping / (len(self.dx_dc) * MEDIAN_STEP**2)
        # Rounding of a singular H_cc must not leave it indefinite, however strict the tolerance.
        least = 2 * (damping + 1e-9) / (max(k, 1) * HELD_STEP**2) + ROUNDED_OFF * np.abs(self.H_cc).max(initial=0.0)
        held = self.H_cc + least * np.eye(k) + moves * self.moved_cc
        return DampedModel(self, damping * volume_fractions, moves, cho_factor(held) if k else None)


@dataclass(frozen=True, eq=False)
class DampedModel:
    """A model, its damping of density (m,) and median shape, and the factored, damped H_cc."""

    model: Model
    damping: FloatArray
    moves: float
    held_factor: tuple | None

    def _held(self, rhs: FloatArray) -> FloatArray:
        return cho_solve(self.held_factor, rhs) if self.held_factor is not None else np.zeros(0)

    def _pull_back(self, change: Change) -> Change:
        """Gradients of the quadratic terms with respect to x, f and y at a change of these."""
        rows, shape_rows = self.model.force_rows, self.model.shape_rows
        gx = shape_rows.T @ (shape_rows @ change.x) + self.moves * change.x
        return Change(gx, rows.T @ (rows @ change.f), self.model.metric.apply(change.y))

    def _onto_held(self, g: Change) -> FloatArray:
        m = self.model
        return m.dx_dc.T @ g.x + m.df_dc.T @ g.f + m.dy_dc.T @ g.y

    def _from_held(self, dc: FloatArray) -> Change:
        m = self.model
        return Change(m.dx_dc @ dc, m.df_dc @ dc, m.dy_dc @ dc)

    def reduced_gradient(self) -> FloatArray:
        """(m,) gradient with respect to rho once the held positions have made their best step."""
        m = self.model
        response = self._from_held(-self._held(m.gradient_c))
        return m.gradient_rho + m.lin.adjoint_rho(self._pull_back(response))

    def hessian(self, v: FloatArray) -> FloatArray:
        """Damped Gauss-Newton Hessian of rho, held positions eliminated, times v (m,)."""
        m = self.model
        direct = m.lin.forward_rho(v)
        indirect = self._from_held(-self._held(self._onto_held(self._pull_back(direct))))
        g = self._pull_back(Change(direct.x + indirect.x, direct.f + indirect.f, direct.y + indirect.y))
        return m.lin.adjoint_rho(g) + (m.terms.curvature + self.damping) * v + 2 * m.lam_smooth * (m.L @ v)

    def diagonal(self) -> FloatArray:
        """(m,) the part of the Hessian's diagonal that costs nothing: the Jacobi preconditioner."""
        m = self.model
        return m.terms.curvature + self.damping + 2 * m.lam_smooth * m.L.diagonal()

    def held_step(self, drho: FloatArray) -> FloatArray:
        """(K, 3) the held-position change that minimises the model for a given drho (m,)."""
        m = self.model
        return -self._held(m.gradient_c + self._onto_held(self._pull_back(m.lin.forward_rho(drho)))).reshape(-1, 3)


def build_model(equilibria: Equilibria, weights: ObjectiveWeights, L: csr_array, design: Design) -> Model:
    """Linearise both equilibria at the design and form the quadratic model."""
    problem = equilibria.problem
    lin = linearise(equilibria, design.rho, design.median, design.final)
    error = shape_error(problem, design.final.y)
    gy = 2 * problem.area_weights[:, None] * (error.e @ error.R) / weights.error_scale**2
    beyond = forces_beyond(weights, equilibria.patches, design.median)
    stretch = stretch_excess(problem, weights, design.rho, design.median.x)
    squeezed = squeeze(problem, weights, design.median.x)
    soft = softening(equilibria, weights, design.rho, design.median, lin.held)
    shape_rows = vstack([stretch.rows, squeezed.rows, soft.rows], format="csr")
    shape_values = np.concatenate([stretch.values, squeezed.values, soft.values])
    gx, gf = (shape_rows.T @ shape_values).reshape(-1, 3), (beyond.rows.T @ beyond.values).reshape(-1, 3)
    g_rho, g_c = lin.adjoint(gx, gf, gy)
    terms = density_terms(weights, problem.volume_fractions, L, design.rho)
    metric = shape_metric(problem, design.final.y, weights.error_scale)
    dx_dc, df_dc, dy_dc = lin.held_columns()
    H = dy_dc.T @ metric.apply(dy_dc)
    for limited in (beyond.rows @ df_dc, shape_rows @ dx_dc):
        H += limited.T @ limited
    return Model(
        lin=lin,
        metric=metric,
        gradient_rho=g_rho + terms.gradient + stretch.density_gradient(problem.n_tets) + soft.density_gradient(),
        gradient_c=g_c.ravel(),
        dx_dc=dx_dc,
        df_dc=df_dc,
        dy_dc=dy_dc,
        force_rows=beyond.rows,
        shape_rows=shape_rows,
        H_cc=0.5 * (H + H.T),
        moved_cc=dx_dc.T @ dx_dc,
        terms=terms,
        L=L,
        lam_smooth=weights.lam_smooth,
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
    """The design after one Gauss-Newton step, its objective, the next damping, and whether the step was taken."""

    design: Design
    value: float
    damping: float
    accepted: bool


def gauss_newton_step(
    equilibria: Equilibria,
    weights: ObjectiveWeights,
    L: csr_array,
    design: Design,
    damping: float,
    movable: BoolArray | None = None,
    tries: int = 6,
    least_promise: float = 0.0,
    stay: bool = True,
) -> Step:
    """One Levenberg-Marquardt step on density and held positions; the damping rises until the objective falls.

    movable : (m,) tets whose density may change; None for all
    least_promise : share of the objective by which the model has to see it fall for a step to be worth its equilibria
    stay : give up a step whose way leads past unstable states; else the equilibria found beyond count too
    """
    value = evaluate(equilibria, weights, L, design)
    model = build_model(equilibria, weights, L, design)

    def tried(damping: float) -> tuple[Design, float] | None:
        damped = model.damped(damping, equilibria.problem.volume_fractions)
        drho = _density_step(damped, design.rho, movable)
        dc = damped.held_step(drho)
        # The model falls by this at most: its quadratic part takes some of it back.
        promised = -float(model.gradient_rho @ drho + model.gradient_c @ dc.ravel())
        if promised <= least_promise * value:
            return None
        trial = _trial(equilibria, model, design, np.clip(design.rho + drho, 0, 1), dc, stay)
        if trial is None:
            return None
        new = evaluate(equilibria, weights, L, trial)
        return (trial, new) if new < value else None

    dampings = np.cumprod([damping] + tries * [STIFFER])
    found = first_found([partial(tried, each) for each in dampings[:-1]], 3 * equilibria.problem.n_nodes)
    if found is None:
        return Step(design, value, dampings[-1], False)
    attempt, (trial, new) = found
    return Step(trial, new, damping / SOFTER if attempt == 0 else dampings[attempt], True)


def evaluate(equilibria: Equilibria, weights: ObjectiveWeights, L: csr_array, design: Design) -> float:
    """The objective at a design."""
    problem = equilibria.problem
    terms = density_terms(weights, problem.volume_fractions, L, design.rho)
    value = objective_value(equilibria, weights, terms, design.rho, design.median, design.final)
    return value + softening_penalty(equilibria, weights, design.rho, design.median)


def _density_step(damped: DampedModel, rho: FloatArray, movable: BoolArray | None, n_cg: int = 30) -> FloatArray:
    """Change of rho (m,) that lowers the model within 0 <= rho <= 1: CG on the free tets, again without those hit."""
    drho = np.zeros_like(rho)
    if movable is not None and not movable.any():
        return drho
    g = damped.reduced_gradient()
    free = ~((rho <= 0) & (g > 0)) & ~((rho >= 1) & (g < 0))
    if movable is not None:
        free &= movable
    diagonal = damped.diagonal()
    for _ in range(2):
        rhs = -g - damped.hessian(drho) if drho.any() else -g
        wanted = drho + _conjugate_gradients(damped.hessian, rhs, diagonal, free, n_cg, 0.05)
        drho = np.clip(rho + wanted, 0, 1) - rho
        hit = free & (drho != wanted)
        if not hit.any():
            break
        free &= ~hit
    return drho


def prescribed_step(
    equilibria: Equilibria, model: Model, design: Design, rho: FloatArray, damping: float
) -> Design | None:
    """The design with density rho (m,) and the held positions that go best with it by a model of `design`.

    None where the model goes too far to be of use, or no equilibrium is found near it.
    """
    dc = model.damped(damping, equilibria.problem.volume_fractions).held_step(rho - design.rho)
    return _trial(equilibria, model, design, rho, dc, stay=True)


def _trial(
    equilibria: Equilibria, model: Model, design: Design, rho: FloatArray, dc: FloatArray, stay: bool
) -> Design | None:
    """The equilibria after a step, from its linear prediction; None where that goes too far to be of use."""
    dx, df, dy = model.lin.forward(rho - design.rho, dc)
    if max(np.abs(dx).max(), np.abs(dy).max()) > LARGEST_MOVE:
        return None
    held = held_positions(equilibria, design.median) + dc
    guess = guessed(equilibria, design, rho, Ahead(dc, dx, df, dy, model.lin))
    most = TRIAL_ITERATIONS if stay else ASTRAY_ITERATIONS
    return equilibrate(equilibria, rho, held, *guess, max_iterations=most, stay=stay, near=model.lin)


def guessed(
    equilibria: Equilibria, design: Design, rho: FloatArray, ahead: Ahead
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Guesses of x, forces and y of the density rho (m,) near a design."""
    median, y = design.median, design.final.y
    x0 = _ahead(equilibria.held_turning.step, median.x, ahead.x, lambda x: equilibria.median_gradient(rho, x)[1])
    y0 = _ahead(equilibria.free_turning.step, y, ahead.y, lambda y: equilibria.final_gradient(rho, median, y)[1])
    return x0, median.forces + ahead.f, y0


def _ahead(
    step: Callable[[FloatArray, FloatArray], FloatArray],
    shape: FloatArray,
    change: FloatArray,
    energy: Callable[[FloatArray], float],
) -> FloatArray:
    """The shape (N, 3) after the predicted change, or after as much of it as turns no tet over.

    A single soft node may be predicted to move far through its tets, where the equilibrium is near all the same.
    """
    for share in SHARES_OF_CHANGE:
        ahead = step(shape, share * change)
        if np.isfinite(energy(ahead)):
            return ahead
    return shape


def held_positions(equilibria: Equilibria, median: Median) -> FloatArray:
    """(K, 3) the held positions at which the median's forces act."""
    return equilibria.patches.mean(median.x) + RIG_COMPLIANCE * median.forces
