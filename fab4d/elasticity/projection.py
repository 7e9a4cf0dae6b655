"""An elastic body drawn to a wanted surface by springs and kept within bounds of compression and stretch."""

from dataclasses import dataclass

import numpy as np

from fab4d.elasticity import _kernels as kernels
from fab4d.elasticity._bound_kernels import bound_gradient, bound_tangent
from fab4d.elasticity.elements import Discretisation
from fab4d.elasticity.pattern import SymmetricPattern
from fab4d.mesh.tetmesh import FloatArray


@dataclass(frozen=True)
class Bounds:
    """Smallest det F and largest principal stretch of a tet."""

    smallest_det: float
    largest_stretch: float


@dataclass(frozen=True, eq=False)
class DrawnBody:
    """Potential sum_j V_j [psi(F_j) + strength/2 excess_j^2] + 1/2 sum_i pull_i |x_i - wanted_i|^2, mu = 1.

    body : linear tets, lengths in L0        kappa : bulk modulus over mu
    pull : (n,) spring stiffnesses           wanted : (n, 3)
    bounds : beyond which det F and the principal stretches count as excess, relative to the bound
    """

    body: Discretisation
    kappa: float
    pull: FloatArray
    wanted: FloatArray
    bounds: Bounds
    strength: float

    def value_and_gradient(self, x: FloatArray) -> tuple[float, FloatArray]:
        """The potential at x (n, 3), inf where a tet is inverted, and its gradient (n, 3)."""
        g, u = np.zeros_like(x), x - self.body.X
        energy, _ = kernels.gradient(self.body.elements, self.body.dN, self.body.weights, *self._moduli(), u, g)
        if not np.isfinite(energy):
            return np.inf, g
        if self.strength > 0.0:
            energy += bound_gradient(*self._bounded(u), g)
        offset = x - self.wanted
        pulled: FloatArray = g + self.pull[:, None] * offset
        return energy + 0.5 * float(self.pull @ np.sum(offset**2, axis=1)), pulled

    def hessian(self, x: FloatArray, pattern: SymmetricPattern, spd: bool) -> FloatArray:
        """Values of the Hessian at x (n, 3) in `pattern`; spd: with the positive semidefinite part of each tet's.

        The excesses count with their Gauss-Newton Hessian.
        """
        data, u = np.zeros(pattern.nnz), x - self.body.X
        assemble = kernels.tangent_spd if spd else kernels.tangent
        assemble(
            self.body.elements, self.body.dN, self.body.weights, *self._moduli(), u,
            pattern.rank, pattern.indptr, data,
        )  # fmt: skip
        if self.strength > 0.0:
            bound_tangent(*self._bounded(u), pattern.rank, pattern.indptr, data)
        data[pattern.indptr[:-1]] += np.repeat(self.pull, 3)
        return data

    def _moduli(self) -> tuple[FloatArray, FloatArray]:
        ones = np.ones(len(self.body.elements))
        return ones, self.kappa * ones

    def _bounded(self, u: FloatArray) -> tuple:
        bounds = self.bounds
        weights = self.strength * self.body.weights
        return self.body.elements, self.body.dN, weights, u, bounds.largest_stretch, bounds.smallest_det
