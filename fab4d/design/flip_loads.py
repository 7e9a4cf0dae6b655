"""Forces that tets with their other material exert on the rest of the part, the nodes around them giving way.

A flip changes the stiffness of its tet many times over, so a derivative with respect to its density is off by as much.
Here the tet takes its other material, to first order in the displacements but with its whole stiffness, while all nodes
but those nearest to it stay where they are: a small dense system.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np
from scipy.sparse import bsr_array, csc_array

from fab4d.design import _star_kernels as star_kernels
from fab4d.design.equilibria import Equilibria
from fab4d.design.gauss_newton import Design
from fab4d.design.sensitivity import Linearisation, element_dofs, force_columns
from fab4d.elasticity import _kernels as kernels
from fab4d.elasticity.pattern import DirichletMask, SymmetricPattern
from fab4d.materials.cards import Moduli
from fab4d.mesh.tetmesh import FloatArray, IntArray
from fab4d.mesh.topology import TET_EDGES, cells_by_vertex
from fab4d.solvers.threads import side_by_side

# Dense systems are made for so many tets at once.
AT_ONCE = 32


@dataclass(frozen=True, eq=False)
class FlipLoads:
    """Changes of the nodal forces on the median and on the final shape (3N, k), a column for each tet."""

    hot: csc_array
    cold: csc_array

    def of(self, some: IntArray | slice) -> "FlipLoads":
        """Those of some of the tets."""
        return FlipLoads(self.hot[:, some], self.cold[:, some])


def flip_loads(equilibria: Equilibria, design: Design, lin: Linearisation, tets: IntArray) -> FlipLoads:
    """What flips of tets (k,) exert. lin : at the design"""
    problem, rho = equilibria.problem, design.rho
    x, y = design.median.x, design.final.y
    hot = _Tangent(equilibria.held_pattern, equilibria.median_tangent(rho, x), equilibria.held_mask)
    cold = _Tangent(equilibria.free_pattern, equilibria.final_tangent(rho, design.median, y), equilibria.free_mask(y))
    corners = problem.body.elements[:, :4]
    at_vertex = cells_by_vertex(corners, int(corners.max()) + 1)

    n_loads = 3 * problem.body.elements.shape[1]
    of_hot, of_cold = np.zeros((len(tets), n_loads)), np.zeros((len(tets), n_loads))

    def fill(part: slice) -> None:
        some = tets[part]
        around_hot, around_cold = (_around(problem.body.elements, at_vertex, tangent, some) for tangent in (hot, cold))
        of_hot[part] = f_hot = hot_forces(equilibria, design, some, _compliances(around_hot))
        moved = [each.moves(-f) for each, f in zip(around_hot, f_hot, strict=True)]
        local = np.full(problem.n_nodes, -1)
        followed = np.array([-each.follow(lin.M, dx, local) for each, dx in zip(around_cold, moved, strict=True)])
        own = np.array([dx[-n_loads:] for dx in moved])
        of_cold[part] = cold_forces(equilibria, design, some, own, followed, _compliances(around_cold))

    parts = [slice(first, min(first + AT_ONCE, len(tets))) for first in range(0, len(tets), AT_ONCE)]
    side_by_side([partial(fill, part) for part in parts], 3 * problem.n_nodes)
    elements = problem.body.elements[tets]
    return FlipLoads(*(force_columns(elements, each, problem.n_nodes) for each in (of_hot, of_cold)))


def hot_forces(equilibria: Equilibria, design: Design, tets: IntArray, compliance: FloatArray) -> FloatArray:
    """What tets (k,) with their other material change of the nodal forces (k, 3nn) on the median shape.

    compliance C (k, 3nn, 3nn) : of their nodes. With the change s of the density, k the tangent and r the force of the
    new material less those of the old one, the nodes move by -C f for the force f = s (r - k C f) that they get.
    """
    problem, body = equilibria.problem, equilibria.problem.body
    moduli = Moduli(problem.rubbery.mu - problem.tpe.mu, problem.rubbery.kappa - problem.tpe.kappa)
    r, k = _force_and_tangent(equilibria, tets, body.dN, moduli, design.median.x - body.X)
    s = _density_changes(design, tets)
    return _condensed(s[:, None] * r, s[:, None, None] * k, compliance)


def cold_forces(
    equilibria: Equilibria,
    design: Design,
    tets: IntArray,
    moved: FloatArray,
    followed: FloatArray,
    compliance: FloatArray,
) -> FloatArray:
    """The same of the final shape, whose nodes near the tets have followed those of the median shape.

    moved, followed (k, 3nn) : change of the median and of the final position of their nodes
    """
    problem, x, y = equilibria.problem, design.median.x, design.final.y
    body, gradients = problem.body, design.median.gradients
    glassy, tpe = (gradients, problem.glassy, y - x), (body.dN, problem.tpe, y - body.X)
    (r, k), (r_tpe, k_tpe) = (_force_and_tangent(equilibria, tets, *each) for each in (glassy, tpe))
    r, k = r - r_tpe, k - k_tpe
    r += np.einsum("kij,kj->ki", _mixed_blocks(equilibria, tets, *glassy), moved)
    r += np.einsum("kij,kj->ki", k, followed)
    s = _density_changes(design, tets)
    return _condensed(s[:, None] * r, s[:, None, None] * k, compliance)


def _density_changes(design: Design, tets: IntArray) -> FloatArray:
    rho = design.rho[tets]
    return np.where(rho > 0.5, -rho, 1 - rho)


def _condensed(r: FloatArray, k: FloatArray, C: FloatArray) -> FloatArray:
    """f (k, n) with f = r - k C f."""
    return np.asarray(np.linalg.solve(np.eye(r.shape[1]) + k @ C, r[:, :, None])[:, :, 0], np.float64)


def _force_and_tangent(
    equilibria: Equilibria, tets: IntArray, dN: FloatArray, moduli: Moduli, u: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Nodal forces (k, 3nn) and tangent (k, 3nn, 3nn) of tets of one material."""
    body, ones = equilibria.problem.body, np.ones(len(tets))
    elements, weights = body.elements[tets], body.weights[tets]
    forces = np.zeros((*elements.shape, 3))
    kernels.element_forces(elements, dN[tets], weights, moduli.mu * ones, moduli.kappa * ones, u, forces)
    blocks = np.zeros((*elements.shape, elements.shape[1], 3, 3))
    kernels.element_tangents(elements, dN[tets], weights, moduli.mu * ones, moduli.kappa * ones, u, blocks)
    return forces.reshape(len(tets), -1), _square(blocks)


def _mixed_blocks(equilibria: Equilibria, tets: IntArray, dN: FloatArray, moduli: Moduli, u: FloatArray) -> FloatArray:
    """(k, 3nn, 3nn) derivative of the forces of glassy tets by their positions in the median shape."""
    body, ones = equilibria.problem.body, np.ones(len(tets))
    elements = body.elements[tets]
    blocks = np.zeros((*elements.shape, elements.shape[1], 3, 3))
    kernels.mixed(elements, dN[tets], body.weights[tets], moduli.mu * ones, moduli.kappa * ones, u, blocks)
    return _square(blocks)


def _square(blocks: FloatArray) -> FloatArray:
    """(k, 3nn, 3nn) matrices of blocks (k, nn, nn, 3, 3)."""
    k, nn = blocks.shape[:2]
    return blocks.transpose(0, 1, 3, 2, 4).reshape(k, 3 * nn, 3 * nn)


# -- the nodes around


@dataclass(frozen=True, eq=False)
class _Tangent:
    """Values of a tangent, fixed dofs decoupled."""

    pattern: SymmetricPattern
    data: FloatArray
    mask: DirichletMask


@dataclass(frozen=True, eq=False)
class _Around:
    """Nodes around a tet, its own ones last, and how they move while all others stay.

    solve : K^-1 b, of a vector (n,) that it may overwrite        free : (3nn,) of the tet's own dofs, 0 where fixed
    compliance (3nn, 3nn) : of the tet's own dofs
    """

    nodes: IntArray
    solve: Callable[[FloatArray], FloatArray]
    free: FloatArray
    compliance: FloatArray

    def moves(self, f: FloatArray) -> FloatArray:
        """(n,) of all nodes by forces f (3nn,) on the tet's own ones."""
        forces = np.zeros(3 * len(self.nodes))
        forces[-len(f) :] = self.free * f
        return self.solve(forces)

    def follow(self, M: bsr_array, moved: FloatArray, local: IntArray) -> FloatArray:
        """(3nn,) K^-1 M moved, of the tet's own nodes. local (N,) : as in the kernels"""
        forces = np.zeros_like(moved)
        star_kernels.product(self.nodes, M.indptr, M.indices, M.data, local, moved, forces)
        return self.free * self.solve(forces)[-len(self.free) :]


def _around(
    elements: IntArray, at_vertex: tuple[IntArray, IntArray], tangent: _Tangent, tets: IntArray
) -> list[_Around]:
    """at_vertex : of the tets, by `cells_by_vertex`"""
    pattern, found = tangent.pattern, list[_Around]()
    local, free = np.full(pattern.n_nodes, -1), np.ones(pattern.n_dofs)
    free[tangent.mask.fixed] = 0.0
    for tet in tets:
        nodes = star_kernels.nodes_around(tet, elements, TET_EDGES, *at_vertex, local)
        K = star_kernels.between(nodes, pattern.indptr, pattern.indices, tangent.data, local)
        own = free[element_dofs(elements[tet][None])[0]]
        found.append(_factored(nodes, K, own))
    return found


def _compliances(around: list[_Around]) -> FloatArray:
    return np.array([each.compliance for each in around])


def _factored(nodes: IntArray, K: FloatArray, free: FloatArray) -> _Around:
    solve: Callable[[FloatArray], FloatArray]
    try:
        L = np.asarray(np.linalg.cholesky(K), np.float64)
    except np.linalg.LinAlgError:  # with all others held the shape is still not stable
        inverse = np.linalg.inv(K + np.tril(K, -1).T)
        compliance = inverse[-len(free) :, -len(free) :]
        solve = inverse.__matmul__
    else:
        corner = L[-len(free) :, -len(free) :]
        compliance = np.linalg.inv(corner @ corner.T)
        solve = partial(_solved, L)
    return _Around(nodes, solve, free, free[:, None] * compliance * free)


def _solved(L: FloatArray, b: FloatArray) -> FloatArray:
    star_kernels.solve(L, b)
    return b
