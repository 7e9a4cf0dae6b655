"""The two equilibria of model.md section 2: the held, hot median shape and the free, cold final shape."""

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from scipy.sparse import csr_array

from fab4d.design.patches import Patches
from fab4d.design.problem import Problem
from fab4d.design.turning import Turning
from fab4d.elasticity import _kernels as kernels
from fab4d.elasticity.pattern import DirichletMask, SymmetricPattern, build_pattern, dirichlet_mask
from fab4d.materials.cards import Moduli
from fab4d.mesh.tetmesh import FloatArray, IntArray
from fab4d.solvers.linear import Analysis, Factor, analyse
from fab4d.solvers.newton import Residual, Solution, newton

# Compliance of the rig, dimensionless: W x + RIG_COMPLIANCE f = held. It is some 1e-5 of the compliance of a patch of
# the part, and keeps the KKT matrix quasi-definite, which a factorisation without pivoting between supernodes needs.
# The equilibrium is exact whatever it is.
RIG_COMPLIANCE = 1e-4


@dataclass(frozen=True, eq=False)
class Median:
    """The median shape x (N, 3) held at its patches, and the forces (K, 3) on the part there."""

    x: FloatArray
    forces: FloatArray
    solution: Solution
    gradients: FloatArray
    """(m, nq, nn, 3) shape-function gradients with respect to x."""


@dataclass(frozen=True, eq=False)
class Final:
    """The free final shape y (N, 3)."""

    y: FloatArray
    solution: Solution


def mixed_moduli(problem: Problem, rho: FloatArray) -> tuple[FloatArray, FloatArray]:
    """mu, kappa (m,) of the hot mixture: psi is linear in the moduli."""
    hot, tpe = problem.rubbery, problem.tpe
    return rho * hot.mu + (1 - rho) * tpe.mu, rho * hot.kappa + (1 - rho) * tpe.kappa


def spread_vertices(X: FloatArray) -> IntArray:
    """Three well-spread nodes: a far one, the one farthest from it, the one farthest from their line."""
    a = int(np.argmax(np.linalg.norm(X - X.mean(axis=0), axis=1)))
    b = int(np.argmax(np.linalg.norm(X - X[a], axis=1)))
    axis = (X[b] - X[a]) / np.linalg.norm(X[b] - X[a])
    rel = X - X[a]
    c = int(np.argmax(np.linalg.norm(rel - np.outer(rel @ axis, axis), axis=1)))
    return np.array([a, b, c])


def three_two_one(x: FloatArray) -> IntArray:
    """Six dofs that fix the rigid modes of the shape x (N, 3): three of one node, two of another, one of a third."""
    a, b, c = spread_vertices(x)
    along = np.argsort(-np.abs(x[b] - x[a]))
    main, second, third = along
    # With a fixed, b may move along the line a-b only; c stops the turn about that line.
    normal_to_plane = np.abs(np.cross(x[b] - x[a], x[c] - x[a]))
    last = int(np.argmax(np.where(np.arange(3) == main, -1.0, normal_to_plane)))
    return np.array([3 * a, 3 * a + 1, 3 * a + 2, 3 * b + second, 3 * b + third, 3 * c + last])


@dataclass(frozen=True, eq=False)
class Pinned:
    """A factor that moves all but the dofs `fixed`; a body that balances itself has no force there either."""

    factor: Factor
    fixed: IntArray

    @property
    def n_negative(self) -> int:
        return self.factor.n_negative

    def solve(self, b: FloatArray) -> FloatArray:
        b = b.copy()
        b[self.fixed] = 0.0
        return self.factor.solve(b)

    def solve_many(self, B: FloatArray) -> FloatArray:
        B = B.copy()
        B[self.fixed] = 0.0
        return self.factor.solve_many(B)


class Equilibria:
    """Solves both equilibria of one problem with one set of patches; patterns and symbolic factors are built once."""

    def __init__(self, problem: Problem, patches: Patches) -> None:
        self.problem = problem
        self.patches = patches
        self.operator = patches.operator(problem.n_nodes)

    @cached_property
    def held_pattern(self) -> SymmetricPattern:
        p = self.patches
        return build_pattern(self.problem.body.elements, self.problem.n_nodes, p.rows, p.nodes, p.count)

    @cached_property
    def held_analysis(self) -> Analysis:
        return analyse(self.held_pattern.indptr, self.held_pattern.indices)

    @cached_property
    def held_mask(self) -> DirichletMask:
        nodes = np.flatnonzero(self.problem.clamp)
        return dirichlet_mask(self.held_pattern, (3 * nodes[:, None] + np.arange(3)).ravel())

    @cached_property
    def free_pattern(self) -> SymmetricPattern:
        return build_pattern(self.problem.body.elements, self.problem.n_nodes)

    @cached_property
    def free_analysis(self) -> Analysis:
        return analyse(self.free_pattern.indptr, self.free_pattern.indices)

    def free_mask(self, y: FloatArray) -> DirichletMask:
        """The six dofs to fix about the shape y (N, 3): those of another shape may leave it free to turn."""
        fixed = three_two_one(y)
        key = tuple(fixed.tolist())
        if key not in self._free_masks:
            self._free_masks[key] = dirichlet_mask(self.free_pattern, fixed)
        return self._free_masks[key]

    @cached_property
    def _free_masks(self) -> dict[tuple[int, ...], DirichletMask]:
        return {}

    def with_patches(self, patches: Patches) -> "Equilibria":
        """The same problem with other patches; what does not depend on them is kept."""
        other = Equilibria(self.problem, patches)
        for name in ("free_pattern", "free_analysis", "_free_masks", "block_structure", "free_turning"):
            if name in self.__dict__:
                other.__dict__[name] = self.__dict__[name]
        return other

    def with_moduli(self, **phases: Moduli) -> "Equilibria":
        """The same with other moduli (`Problem.with_moduli`); all patterns are kept."""
        other = Equilibria(self.problem.with_moduli(**phases), self.patches)
        other.__dict__.update({name: self.__dict__[name] for name in set(self.__dict__) - set(other.__dict__)})
        return other

    @cached_property
    def held_turning(self) -> Turning:
        """Bends steps of the median shape."""
        return Turning(self.problem.body, np.flatnonzero(self.problem.clamp), self.operator)

    @cached_property
    def free_turning(self) -> Turning:
        """Bends steps of the final shape."""
        return Turning(self.problem.body, np.zeros(0, np.int64), csr_array((0, self.problem.n_nodes)))

    @cached_property
    def block_structure(self) -> tuple[IntArray, IntArray, IntArray, IntArray]:
        """Sorting of the element blocks (a, b) by nodes: order, first of each sum, column nodes, row starts."""
        elements, n_nodes = self.problem.body.elements, self.problem.n_nodes
        keys = (elements[:, :, None] * n_nodes + elements[:, None, :]).ravel()
        order = np.argsort(keys, kind="stable")
        starts = np.flatnonzero(np.r_[True, np.diff(keys[order]) > 0])
        unique = keys[order][starts]
        return order, starts, unique % n_nodes, np.searchsorted(unique // n_nodes, np.arange(n_nodes + 1))

    # -- median
    def median_gradient(self, rho: FloatArray, x: FloatArray) -> tuple[FloatArray, float, float]:
        """dW_med/dx (N, 3), W_med and min det F."""
        body = self.problem.body
        g = np.zeros_like(x)
        energy, smallest = kernels.gradient(
            body.elements, body.dN, body.weights, *mixed_moduli(self.problem, rho), x - body.X, g
        )
        return g, energy, smallest

    def median_tangent(self, rho: FloatArray, x: FloatArray, spd: bool = False) -> FloatArray:
        """Values of the KKT matrix [[K, -W^T], [-W, -RIG_COMPLIANCE I]] in the held pattern, clamp decoupled."""
        body, pattern = self.problem.body, self.held_pattern
        data = np.zeros(pattern.nnz)
        assemble = kernels.tangent_spd if spd else kernels.tangent
        assemble(
            body.elements, body.dN, body.weights, *mixed_moduli(self.problem, rho), x - body.X,
            pattern.rank, pattern.indptr, data,
        )  # fmt: skip
        data[pattern.coupling] = -self.patches.weights[:, None]
        data[pattern.indptr[3 * pattern.n_nodes : -1]] = -RIG_COMPLIANCE
        self.held_mask.apply(data, 1.0)
        return data

    def solve_median(
        self,
        rho: FloatArray,
        held: FloatArray,
        x: FloatArray,
        forces: FloatArray,
        tolerance: float = 1e-9,
        max_iterations: int = 25,
        extra: FloatArray | None = None,
        stay: bool = False,
        near: Factor | None = None,
    ) -> Median:
        """Median shape with the patch means at `held` (K, 3), from the guess x, forces.

        extra : (N, 3) additional nodal forces on the part, for load paths        stay, near : see `newton`
        The tolerance is relative to the largest nodal element force.
        """
        n, shape = 3 * self.problem.n_nodes, x.shape
        fixed = self.held_mask.fixed
        W = self.operator

        def residual(z: FloatArray) -> Residual:
            x_z, f_z = z[:n].reshape(shape), z[n:].reshape(-1, 3)
            g, energy, _ = self.median_gradient(rho, x_z)
            applied = W.T @ f_z if extra is None else W.T @ f_z + extra
            gap = held - W @ x_z
            r = np.concatenate([(g - applied).ravel(), (gap - RIG_COMPLIANCE * f_z).ravel()])
            scale = max(float(np.sqrt(g.ravel() @ g.ravel())), 1e-6)
            r[fixed] = 0.0
            work = 0.0 if extra is None else float((extra * x_z).sum())
            return Residual(r, scale, energy + float((gap**2).sum()) / (2 * RIG_COMPLIANCE) - work)

        def factor(z: FloatArray) -> Factor:
            return self.held_analysis.factor(self.median_tangent(rho, z[:n].reshape(shape)))

        def fallback(z: FloatArray) -> Factor:
            return self.held_analysis.factor(self.median_tangent(rho, z[:n].reshape(shape), spd=True))

        def advance(z: FloatArray, step: FloatArray) -> FloatArray:
            ahead = self.held_turning.step(z[:n].reshape(shape), step[:n].reshape(shape))
            return np.concatenate([ahead.ravel(), z[n:] + step[n:]])

        z = np.concatenate([x.ravel(), forces.ravel()])
        solution = newton(
            residual, factor, z, tolerance, max_iterations, fallback, 3 * self.patches.count, advance, stay, near
        )
        x = solution.z[:n].reshape(shape)
        gradients = np.zeros_like(self.problem.body.dN)
        kernels.deformed_gradients(self.problem.body.elements, self.problem.body.dN, x - self.problem.body.X, gradients)
        return Median(x, solution.z[n:].reshape(-1, 3), solution, gradients)

    # -- final
    def _final_terms(
        self, rho: FloatArray, median: Median, y: FloatArray, unloaded: float = 1.0
    ) -> list[tuple[Any, ...]]:
        """Kernel arguments of the glassy and the TPE term; zero moduli mark elements without that material.

        unloaded : share of the TPE that pulls back; the rest is taken as stress-free in the median shape
        """
        body, glassy, tpe = self.problem.body, self.problem.glassy, self.problem.tpe
        pull, still = unloaded * (1 - rho), (1 - unloaded) * (1 - rho)
        from_median = rho * glassy.mu + still * tpe.mu, rho * glassy.kappa + still * tpe.kappa
        return [
            (body.elements, median.gradients, body.weights, *from_median, y - median.x),
            (body.elements, body.dN, body.weights, pull * tpe.mu, pull * tpe.kappa, y - body.X),
        ]

    def final_gradient(
        self, rho: FloatArray, median: Median, y: FloatArray, unloaded: float = 1.0
    ) -> tuple[FloatArray, float]:
        """dW_fin/dy (N, 3) and W_fin (inf where an element is inverted)."""
        g, total = np.zeros_like(y), 0.0
        for element_loop in self._final_terms(rho, median, y, unloaded):
            total += kernels.gradient(*element_loop, g)[0]
        return g, total

    def final_tangent(
        self, rho: FloatArray, median: Median, y: FloatArray, spd: bool = False, unloaded: float = 1.0
    ) -> FloatArray:
        """Values of d2W_fin/dy2 in the free pattern, the dofs of `free_mask` decoupled."""
        pattern = self.free_pattern
        data = np.zeros(pattern.nnz)
        assemble = kernels.tangent_spd if spd else kernels.tangent
        for element_loop in self._final_terms(rho, median, y, unloaded):
            assemble(*element_loop, pattern.rank, pattern.indptr, data)
        self.free_mask(y).apply(data, 1.0)
        return data

    def solve_final(
        self,
        rho: FloatArray,
        median: Median,
        y: FloatArray,
        tolerance: float = 1e-9,
        max_iterations: int = 25,
        unloaded: float = 1.0,
        stay: bool = False,
        near: Factor | None = None,
    ) -> Final:
        """Final shape after unloading, from the guess y.

        tolerance : relative to the TPE's pull at the median shape
        unloaded : share of the TPE that pulls back, less than 1 on the way from the median shape
        stay, near : see `newton`
        """
        shape, body, tpe = y.shape, self.problem.body, self.problem.tpe
        pull = np.zeros_like(y)
        kernels.gradient(
            body.elements, body.dN, body.weights, (1 - rho) * tpe.mu, (1 - rho) * tpe.kappa, median.x - body.X, pull
        )
        scale = max(float(np.sqrt(pull.ravel() @ pull.ravel())), 1e-6)

        def residual(z: FloatArray) -> Residual:
            g, energy = self.final_gradient(rho, median, z.reshape(shape), unloaded)
            return Residual(g.ravel(), scale, energy)

        def pinned(z: FloatArray, spd: bool) -> Factor:
            at = z.reshape(shape)
            tangent = self.free_analysis.factor(self.final_tangent(rho, median, at, spd, unloaded))
            return Pinned(tangent, self.free_mask(at).fixed)

        def advance(z: FloatArray, step: FloatArray) -> FloatArray:
            return self.free_turning.step(z.reshape(shape), step.reshape(shape)).ravel()

        def factor(z: FloatArray) -> Factor:
            return pinned(z, False)

        def fallback(z: FloatArray) -> Factor:
            return pinned(z, True)

        solution = newton(residual, factor, y.ravel(), tolerance, max_iterations, fallback, 0, advance, stay, near)
        return Final(solution.z.reshape(shape), solution)
