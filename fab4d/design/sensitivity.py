"""Derivatives of both equilibria with respect to the density and the held positions."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.sparse import bsr_array, csc_array, csr_array

from fab4d.design.equilibria import Equilibria, Final, Median
from fab4d.elasticity import _kernels as kernels
from fab4d.materials.cards import Moduli
from fab4d.mesh.tetmesh import FloatArray, IntArray
from fab4d.solvers.linear import Factor
from fab4d.solvers.threads import side_by_side


def _element_forces(equilibria: Equilibria, gradients: FloatArray, moduli: Moduli, u: FloatArray) -> FloatArray:
    body = equilibria.problem.body
    out = np.zeros((*body.elements.shape, 3))
    ones = np.ones(len(body.elements))
    kernels.element_forces(body.elements, gradients, body.weights, moduli.mu * ones, moduli.kappa * ones, u, out)
    return out


def forces_by_density(equilibria: Equilibria, x: FloatArray) -> FloatArray:
    """(m, nn, 3) derivative of each element's nodal forces in the hot shape x (N, 3) with respect to its density."""
    problem = equilibria.problem
    hot = Moduli(problem.rubbery.mu - problem.tpe.mu, problem.rubbery.kappa - problem.tpe.kappa)
    return _element_forces(equilibria, problem.body.dN, hot, x - problem.body.X)


def element_dofs(elements: IntArray) -> IntArray:
    """(m, 3nn) dofs of the nodes of elements (m, nn)."""
    return (3 * elements[:, :, None] + np.arange(3)).reshape(len(elements), -1)


def force_columns(elements: IntArray, forces: FloatArray, n_nodes: int) -> csc_array:
    """(3N, m) matrix whose column j holds the nodal forces (nn, 3) of element j."""
    rows = element_dofs(elements)
    indptr = np.arange(0, rows.size + 1, rows.shape[1])
    return csc_array((forces.ravel(), rows.ravel(), indptr), shape=(3 * n_nodes, len(elements)))


def _mixed_matrix(equilibria: Equilibria, rho: FloatArray, median: Median, y: FloatArray) -> bsr_array:
    """M = d(dW_fin/dy)/dx as a (3N, 3N) matrix of 3 x 3 blocks; an element's blocks are summed on multiplication."""
    body, glassy = equilibria.problem.body, equilibria.problem.glassy
    m, nn = body.elements.shape
    blocks = np.zeros((m, nn, nn, 3, 3))
    kernels.mixed(
        body.elements, median.gradients, body.weights, rho * glassy.mu, rho * glassy.kappa, y - median.x, blocks
    )
    order, starts, indices, indptr = equilibria.block_structure
    summed = np.add.reduceat(blocks.reshape(-1, 3, 3)[order], starts, axis=0)
    n = 3 * equilibria.problem.n_nodes
    return bsr_array((summed, indices, indptr), shape=(n, n))


@dataclass(frozen=True, eq=False)
class Change:
    """Changes of x (3N,), f (3K,) and y (3N,), or the gradients with respect to them."""

    x: FloatArray
    f: FloatArray
    y: FloatArray


@dataclass(frozen=True, eq=False)
class Linearisation:
    """The linear maps of solver.md section 1 about one pair of equilibria.

    With R = d residual / d rho and M = d(dW_fin/dy)/dx:
        [K_x, -W^T; -W, -d] [dx; df] = [-R_x drho; -dc],        dy = -K_y^-1 (R_y drho + M dx)
    """

    held: Factor
    free: Factor
    held_fixed: IntArray
    free_fixed: IntArray
    M: bsr_array
    MT: bsr_array
    R_x: csc_array
    R_y: csc_array
    R_xT: csr_array
    R_yT: csr_array
    n_patches: int

    @cached_property
    def M_rows(self) -> csr_array:
        """M for products with many columns: three times as quick as by its blocks."""
        return self.M.tocsr()

    def forward(self, drho: FloatArray, dc: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """dx (N, 3), df (K, 3), dy (N, 3) of changes drho (m,) and dc (K, 3) of the held positions."""
        n = self.M.shape[0]
        rhs = np.concatenate([-(self.R_x @ drho), -dc.ravel()])
        rhs[self.held_fixed] = 0.0
        z = self.held.solve(rhs)
        r = -(self.R_y @ drho + self.M @ z[:n])
        r[self.free_fixed] = 0.0
        return z[:n].reshape(-1, 3), z[n:].reshape(-1, 3), self.free.solve(r).reshape(-1, 3)

    def final_follows(self, dx: FloatArray) -> FloatArray:
        """dy (N, 3) of a change dx (N, 3) of the median shape."""
        r = -(self.M @ dx.ravel())
        r[self.free_fixed] = 0.0
        return self.free.solve(r).reshape(-1, 3)

    def forward_rho(self, drho: FloatArray) -> Change:
        """What a change drho (m,) at fixed held positions changes."""
        n = self.M.shape[0]
        rhs = np.zeros(n + 3 * self.n_patches)
        rhs[:n] = -(self.R_x @ drho)
        rhs[self.held_fixed] = 0.0
        z = self.held.solve(rhs)
        r = -(self.R_y @ drho + self.M @ z[:n])
        r[self.free_fixed] = 0.0
        return Change(z[:n], z[n:], self.free.solve(r))

    def adjoint_rho(self, g: Change) -> FloatArray:
        """Gradient (m,) with respect to rho at fixed held positions of a function with these gradients."""
        return self.adjoint(g.x, g.f, g.y)[0]

    def adjoint(self, gx: FloatArray, gf: FloatArray, gy: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Gradients with respect to rho (m,) and held positions (K, 3) of a function with gradients gx, gf, gy.

        gy must be free of rigid modes, for y is fixed up to them only.
        """
        n = self.M.shape[0]
        b = gy.ravel().copy()
        b[self.free_fixed] = 0.0
        ly = self.free.solve(b)
        rhs = np.concatenate([gx.ravel() - self.MT @ ly, gf.ravel()])
        rhs[self.held_fixed] = 0.0
        lz = self.held.solve(rhs)
        return -(self.R_xT @ lz[:n]) - self.R_yT @ ly, -lz[n:].reshape(-1, 3)

    def respond(self, hot: FloatArray, cold: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Changes of (x, f) (3N + 3K, q) and of y (3N, q) where loads change by hot (3N + 3K, q) and cold (3N, q)."""
        n = self.M.shape[0]
        hot[self.held_fixed] = 0.0
        z = self.held.solve_many(hot)
        cold = cold - self.M_rows @ z[:n]
        cold[self.free_fixed] = 0.0
        return z, self.free.solve_many(cold)

    def adjoint_states(self, gx: FloatArray, gf: FloatArray, gy: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Gradients by the loads of `respond`, (3N + 3K, q) and (3N, q), of q functions with gradients gx (3N, q),
        gf (3K, q) and gy (3N, q)."""
        b = gy.copy()
        b[self.free_fixed] = 0.0
        ly = self.free.solve_many(b)
        rhs = np.vstack([gx - self.MT @ ly, gf])
        rhs[self.held_fixed] = 0.0
        return self.held.solve_many(rhs), ly

    def held_columns(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """dx/dc, df/dc, dy/dc as (3N, 3K), (3K, 3K), (3N, 3K)."""
        n, k = self.M.shape[0], 3 * self.n_patches
        if k == 0:
            return np.zeros((n, 0)), np.zeros((0, 0)), np.zeros((n, 0))
        rhs = np.zeros((n + k, k))
        rhs[n + np.arange(k), np.arange(k)] = -1.0
        z, dy = self.respond(rhs, np.zeros((n, k)))
        return z[:n], z[n:], dy


def linearise(equilibria: Equilibria, rho: FloatArray, median: Median, final: Final) -> Linearisation:
    """Factor both tangents at the equilibria and form their derivatives with respect to rho and x."""
    problem = equilibria.problem
    held, free, M = side_by_side(
        [
            lambda: equilibria.held_analysis.factor(equilibria.median_tangent(rho, median.x)),
            lambda: equilibria.free_analysis.factor(equilibria.final_tangent(rho, median, final.y)),
            lambda: _mixed_matrix(equilibria, rho, median, final.y),
        ],
        3 * problem.n_nodes,
    )
    body = problem.body
    cold = _element_forces(equilibria, median.gradients, problem.glassy, final.y - median.x)
    by_hot = forces_by_density(equilibria, median.x)
    by_cold = cold - _element_forces(equilibria, body.dN, problem.tpe, final.y - body.X)
    R_x, R_y = (force_columns(body.elements, forces, problem.n_nodes) for forces in (by_hot, by_cold))
    return Linearisation(
        held=held,
        free=free,
        held_fixed=equilibria.held_mask.fixed,
        free_fixed=equilibria.free_mask(final.y).fixed,
        M=M,
        MT=M.T.tobsr(blocksize=(3, 3)),
        R_x=R_x,
        R_y=R_y,
        R_xT=R_x.T,
        R_yT=R_y.T,
        n_patches=equilibria.patches.count,
    )
