"""Small neo-Hookean bodies for tests: boxes of tets, their energy, forces and stiffness, and equilibria by Newton."""

from dataclasses import dataclass
from functools import cached_property
from itertools import permutations

import numpy as np
from scipy.sparse import csc_array, tril

from fab4d.elasticity import _kernels as kernels
from fab4d.elasticity.elements import Discretisation, discretise
from fab4d.elasticity.pattern import SymmetricPattern, build_pattern, dirichlet_mask
from fab4d.mesh.measures import tet_volumes
from fab4d.mesh.quadratic import quadratic_tets, with_midpoints
from fab4d.solvers.linear import analyse


def box(shape: tuple[int, int, int], size: tuple[float, float, float] = (1.0, 1.0, 1.0)):
    """A box from the origin to `size`, six tets a cell: X (n, 3), tets (m, 4)."""
    axes = [np.linspace(0.0, length, n + 1) for n, length in zip(shape, size, strict=True)]
    X = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    strides = np.array([(shape[1] + 1) * (shape[2] + 1), shape[2] + 1, 1])
    cells = np.stack(np.meshgrid(*map(np.arange, shape), indexing="ij"), axis=-1).reshape(-1, 3) @ strides
    walks = np.array([[0, strides[a], strides[a] + strides[b], strides.sum()] for a, b, _ in permutations(range(3))])
    tets = (cells[:, None, None] + walks).reshape(-1, 4)
    negative = tet_volumes(X, tets) < 0
    tets[negative] = tets[negative][:, [0, 1, 3, 2]]
    return X, tets


def irregular_box(shape: tuple[int, int, int], rng: np.random.Generator, amount: float = 0.2):
    """`box` with its interior vertices moved by up to `amount` of a cell along each axis."""
    X, tets = box(shape)
    inside = np.all((X > 1e-9) & (X < 1 - 1e-9), axis=1)
    X[inside] += rng.uniform(-amount, amount, (int(inside.sum()), 3)) / np.array(shape)
    return X, tets


@dataclass(frozen=True, eq=False)
class Solid:
    """A discretised body with moduli mu, kappa (m,), seen through its kernels."""

    body: Discretisation
    mu: np.ndarray
    kappa: np.ndarray

    @property
    def X(self) -> np.ndarray:
        return self.body.X

    @cached_property
    def pattern(self) -> SymmetricPattern:
        return build_pattern(self.body.elements, len(self.X))

    @property
    def _arguments(self) -> tuple:
        return self.body.elements, self.body.dN, self.body.weights, self.mu, self.kappa

    def energy(self, u: np.ndarray) -> float:
        return kernels.energy(*self._arguments, u)[0]

    def forces(self, u: np.ndarray) -> np.ndarray:
        """dW/du (N, 3)."""
        g = np.zeros_like(u)
        kernels.gradient(*self._arguments, u, g)
        return g

    def element_forces(self, u: np.ndarray) -> np.ndarray:
        out = np.zeros((*self.body.elements.shape, 3))
        kernels.element_forces(*self._arguments, u, out)
        return out

    def tangent_data(self, u: np.ndarray, kernel=kernels.tangent) -> np.ndarray:
        data = np.zeros(self.pattern.nnz)
        kernel(*self._arguments, u, self.pattern.rank, self.pattern.indptr, data)
        return data

    def stiffness(self, u: np.ndarray, kernel=kernels.tangent) -> csc_array:
        """The whole symmetric tangent (3 N, 3 N)."""
        return whole(self.pattern, self.tangent_data(u, kernel))

    def mixed(self, u: np.ndarray) -> np.ndarray:
        nn = self.body.elements.shape[1]
        blocks = np.zeros((len(self.body.elements), nn, nn, 3, 3))
        kernels.mixed(*self._arguments, u, blocks)
        return blocks

    def element_tangents(self, u: np.ndarray) -> np.ndarray:
        nn = self.body.elements.shape[1]
        blocks = np.zeros((len(self.body.elements), nn, nn, 3, 3))
        kernels.element_tangents(*self._arguments, u, blocks)
        return blocks

    def equilibrium(self, u: np.ndarray, fixed: np.ndarray, load: np.ndarray, steps: int = 1) -> np.ndarray:
        """Displacements in equilibrium with the nodal `load`, the dofs `fixed` as in `u`, reached in load steps."""
        mask = dirichlet_mask(self.pattern, fixed)
        analysis = analyse(self.pattern.indptr, self.pattern.indices)
        for step in range(1, steps + 1):
            u = self._newton(u, fixed, load * (step / steps), mask, analysis)
        return u

    def _newton(self, u, fixed, load, mask, analysis) -> np.ndarray:
        for _ in range(30):
            residual = (load - self.forces(u)).ravel()
            residual[fixed] = 0.0
            data = self.tangent_data(u)
            mask.apply(data, 1.0)
            du = analysis.factor(data).solve(residual).reshape(-1, 3)
            t = 1.0
            while not np.isfinite(self.energy(u + t * du)):
                t *= 0.5
            u = u + t * du
            if np.max(np.abs(du)) < 1e-11 * np.ptp(self.X):
                return u
        msg = "no equilibrium in 30 Newton steps"
        raise AssertionError(msg)


def solid(X: np.ndarray, tets: np.ndarray, order: int = 1, mu: float = 1.0, kappa: float = 6.07) -> Solid:
    """A body of linear (order 1) or quadratic (order 2) elements on the tets (m, 4)."""
    if order == 2:
        tets, edges = quadratic_tets(tets, len(X))
        X = with_midpoints(X, edges)
    ones = np.ones(len(tets))
    return Solid(discretise(X, tets), mu * ones, kappa * ones)


def whole(pattern: SymmetricPattern, data: np.ndarray) -> csc_array:
    """The symmetric matrix whose lower triangle is stored."""
    lower = csc_array((data, pattern.indices, pattern.indptr), shape=(pattern.n_dofs,) * 2)
    return csc_array(lower + tril(lower, -1).T)


def nodal_areas(solid: Solid, on_face: np.ndarray) -> np.ndarray:
    """(N,) integral of each shape function over the element faces whose nodes are all marked in `on_face`."""
    share = np.zeros(len(solid.X))
    for nodes in solid.body.elements:
        corners = nodes[:4][on_face[nodes[:4]]]
        if len(corners) == 3:
            a, b, c = solid.X[corners]
            loaded = corners if solid.body.order == 1 else nodes[4:][on_face[nodes[4:]]]
            share[loaded] += 0.5 * np.linalg.norm(np.cross(b - a, c - a)) / 3
    return share


def dofs(nodes: np.ndarray, axes: tuple[int, ...] = (0, 1, 2)) -> np.ndarray:
    """Dof numbers of the given coordinates of nodes, given as numbers or as a mask."""
    nodes = np.flatnonzero(nodes) if nodes.dtype == bool else nodes
    return (3 * nodes[:, None] + np.array(axes)).ravel()


def best_difference_error(f, derivative: np.ndarray, x: np.ndarray, direction: np.ndarray) -> float:
    """Smallest relative error of `derivative` against central differences of f along `direction`, over many steps."""
    errors = []
    for step in 10.0 ** -np.arange(1.0, 9.0, 0.5):
        difference = (f(x + step * direction) - f(x - step * direction)) / (2 * step)
        errors.append(np.linalg.norm(difference - derivative) / np.linalg.norm(derivative))
    return float(np.nanmin(errors))
