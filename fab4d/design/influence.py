"""What the other material in whole tets does to the final shape, by linear algebra alone.

A flip changes the stiffness of its tet many times over, so a derivative with respect to its density is off by as much.
Here the tet takes its other material, to first order in the displacements but with its whole stiffness, while all
other nodes stay where they are: a small dense system. The forces that it then exerts go through the factors of the
whole part.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property, partial
from itertools import combinations_with_replacement

import numpy as np
from scipy.linalg import qr
from scipy.sparse import csc_array

from fab4d.design.equilibria import Equilibria
from fab4d.design.gauss_newton import HELD_STEP, Design
from fab4d.design.objective import rigid_modes, shape_error
from fab4d.design.problem import Problem
from fab4d.design.sensitivity import Linearisation, element_dofs, force_columns, linearise
from fab4d.elasticity import _kernels as kernels
from fab4d.elasticity.pattern import DirichletMask, SymmetricPattern
from fab4d.materials.cards import Moduli
from fab4d.mesh.tetmesh import BoolArray, FloatArray, IntArray
from fab4d.solvers.threads import side_by_side

# The nodes around a tet give way too, which leaves about this share of what it does among fixed ones.
SHARE_LEFT = 0.8
# Held positions follow as a Gauss-Newton step with this damping lets them.
HELD_DAMPING = 0.03
# The whole surface is followed where the changes of it by all flips are at most so many numbers; else the error in
# polynomials of this degree and in its own direction.
MOST_NUMBERS, MODE_DEGREE = 30_000_000, 3
# How little a flip's worth follows what is seen of many.
TEACH_RIDGE = 0.1
# Dense systems and right-hand sides are made for so many tets at once.
AT_ONCE = 256


@dataclass(frozen=True, eq=False)
class View:
    """Linear measures (q,) of the final shape that neither rigid motions nor moves of the held positions change.

    on_surface (s,) : dofs that are looked at        root (s,) : roots of their area weights
    basis (s, q) : orthonormal measures; None for all        rigid (s, 6) : weighted, orthonormal rigid modes
    by_held (3K, q) : derivatives by the held positions        follow (q, 3K) : what these take away of them
    """

    on_surface: IntArray
    root: FloatArray
    rigid: FloatArray
    basis: FloatArray | None
    by_held: FloatArray
    follow: FloatArray

    def without_held(self, v: FloatArray) -> FloatArray:
        """Measures (..., q) without what the held positions take away."""
        return v - (v @ self.by_held.T) @ self.follow.T

    def error(self, problem: Problem, y: FloatArray) -> FloatArray:
        """(q,) that of the final shape y (N, 3)."""
        return self.without_held(
            _measured(_weighted_error(problem, y, self.on_surface, self.root), self.rigid, self.basis)
        )


@dataclass(frozen=True, eq=False)
class Influence:
    """The error of the final shape as a vector whose length is the RMS error in L0, and what flips change of it.

    tets (k,) : that may be flipped        change (k, q) : by each flip        residual (q,) : the error
    Both are without what the held positions take away.
    """

    tets: IntArray
    change: FloatArray
    residual: FloatArray
    view: View

    def left(self, flipped: BoolArray) -> FloatArray:
        """(q,) the error with the tets `flipped` (k,)."""
        return self.residual + self.change[flipped].sum(axis=0)

    @cached_property
    def overlaps(self) -> FloatArray | None:
        """(k, k) scalar products of the changes; None where these are shorter than they are many."""
        return None if len(self.tets) > self.change.shape[1] else self.change @ self.change.T

    def along(self, k: int) -> FloatArray:
        """(k,) scalar products of all changes with the k-th."""
        return self.change @ self.change[k] if self.overlaps is None else self.overlaps[k]

    def taught(self, flipped: BoolArray, error: FloatArray) -> "Influence":
        """The same after the tets `flipped` (k,) have really left the error (q,): what they do together is that.

        Each is worth as much more or less as explains it best, and the rest is shared in proportion to their squares.
        """
        done = self.change[flipped]
        gram = done @ done.T
        ridge = TEACH_RIDGE * np.trace(gram) / len(done)
        misfit = error - self.residual - done.sum(axis=0)
        worth = 1 + np.linalg.solve(gram + ridge * np.eye(len(done)), done @ misfit)
        better = worth[:, None] * done
        share = (better**2).sum(axis=1) / (better**2).sum()
        change = self.change.copy()
        change[flipped] = better + np.outer(share, error - self.residual - better.sum(axis=0))
        return replace(self, change=change)


def influence(
    equilibria: Equilibria, design: Design, tets: IntArray, error_scale: float, most: int | None = None
) -> Influence:
    """What a flip of each of `tets` of a near 0/1 design does to the error, or of the `most` that promise most.

    error_scale : RMS error, L0, that is worth a move of the held positions
    """
    problem, y = equilibria.problem, design.final.y
    weights = np.repeat(problem.area_weights, 3)
    on_surface = np.flatnonzero(weights)
    root = np.sqrt(weights[on_surface])
    rigid, _ = np.linalg.qr(root[:, None] * rigid_modes(y).reshape(-1, 6)[on_surface])
    e = _weighted_error(problem, y, on_surface, root)
    lin = linearise(equilibria, design.rho, design.median, design.final)

    def in_modes(basis: FloatArray) -> tuple[FloatArray, FloatArray]:
        directions = np.zeros((y.size, basis.shape[1]))
        directions[on_surface] = root[:, None] * basis
        return _in_modes(lin, _loads(equilibria, design, lin, tets), len(tets), directions)

    if most is not None and len(tets) > most:
        along_error, _ = in_modes(_measured(e, rigid, None)[:, None])
        tets = np.sort(tets[np.argsort(along_error[:, 0], kind="stable")[:most]])
    basis = None
    if len(tets) * len(on_surface) <= MOST_NUMBERS:
        loads = _loads(equilibria, design, lin, tets)
        change, by_held = _on_the_surface(lin, loads, len(tets), on_surface, root, rigid)
    else:
        basis = _smooth_modes(problem, root, rigid, e, on_surface)
        change, by_held = in_modes(basis)
    ridge = HELD_DAMPING * error_scale**2 / (max(len(by_held), 1) * HELD_STEP**2)
    follow = np.linalg.solve(by_held @ by_held.T + ridge * np.eye(len(by_held)), by_held).T.astype(np.float64)
    view = View(on_surface, root, rigid, basis, by_held, follow)
    return Influence(tets, SHARE_LEFT * view.without_held(change), view.error(problem, y), view)


# -- from loads to shapes

# Each computes forces of some tets, and where these tets are among all.
Loads = list[Callable[[], tuple[slice, csc_array, csc_array]]]


def _on_the_surface(
    lin: Linearisation, loads: Loads, n_tets: int, on_surface: IntArray, root: FloatArray, rigid: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Change (k, s) by each flip and derivative (3K, s) by the held positions of the weighted boundary positions."""
    change = np.zeros((n_tets, len(on_surface)))

    def follow(load: Callable[[], tuple[slice, csc_array, csc_array]]) -> None:
        part, hot, cold = load()
        held = np.zeros((3 * lin.n_patches, hot.shape[1]))
        _, dy = lin.respond(-np.vstack([hot.toarray(), held]), -cold.toarray())
        change[part] = (root[:, None] * dy[on_surface]).T

    side_by_side([partial(follow, load) for load in loads], lin.M.shape[0])
    by_held = (root[:, None] * lin.held_columns()[2][on_surface]).T
    return _measured(change, rigid, None), _measured(by_held, rigid, None)


def _in_modes(lin: Linearisation, loads: Loads, n_tets: int, directions: FloatArray) -> tuple[FloatArray, FloatArray]:
    """The same of the measures with gradients `directions` (3N, q): a solution for each of them, not for each flip."""
    n = len(directions)
    of_median, of_final = lin.adjoint_states(directions)
    change = np.zeros((n_tets, directions.shape[1]))
    for load in loads:
        part, hot, cold = load()
        change[part] = -(hot.T @ of_median[:n] + cold.T @ of_final)
    return change, -of_median[n:]


def _smooth_modes(
    problem: Problem, root: FloatArray, rigid: FloatArray, e: FloatArray, on_surface: IntArray
) -> FloatArray:
    """(s, q) orthonormal measures without rigid motions: of the weighted error e (s,), and of polynomials."""
    smooth = root[:, None] * _polynomials(problem.body.X, MODE_DEGREE)[on_surface]
    basis = np.column_stack([e / max(float(np.abs(e).max()), 1e-300), smooth])
    for _ in range(2):  # twice is enough for orthogonality to rounding
        basis -= rigid @ (rigid.T @ basis)
    # The fields are not independent on the few vertices of a coarse mesh.
    basis, r, _ = qr(basis, mode="economic", pivoting=True)
    size = np.abs(np.diag(r))
    return basis[:, size > 1e-6 * size[0]]


def _weighted_error(problem: Problem, y: FloatArray, on_surface: IntArray, root: FloatArray) -> FloatArray:
    """(s,) error of the final shape y (N, 3), turned back to it; its length is the RMS error in L0."""
    error = shape_error(problem, y)
    return root * (error.e @ error.R).ravel()[on_surface]


def _measured(v: FloatArray, rigid: FloatArray, basis: FloatArray | None) -> FloatArray:
    """(..., q) measures of weighted fields (..., s)."""
    return v @ basis if basis is not None else v - (v @ rigid) @ rigid.T


def _polynomials(X: FloatArray, degree: int) -> FloatArray:
    """(3N, q) vector fields: each monomial of X (N, 3) up to the degree in each of the three components."""
    centred = (X - X.mean(axis=0)) / np.abs(X - X.mean(axis=0)).max()
    powers = [c for d in range(degree + 1) for c in combinations_with_replacement(range(3), d)]
    monomials = np.column_stack([centred[:, c].prod(axis=1) if c else np.ones(len(X)) for c in map(list, powers)])
    return np.kron(monomials, np.eye(3))


# -- from flips to loads


def _loads(equilibria: Equilibria, design: Design, lin: Linearisation, tets: IntArray) -> Loads:
    """Forces of flipped tets on the hot and the cold part, as columns (3N, k) of some tets after others."""
    problem = equilibria.problem
    hot_tangent = equilibria.median_tangent(design.rho, design.median.x)
    cold_tangent = equilibria.final_tangent(design.rho, design.median, design.final.y)
    cold_mask = equilibria.free_mask(design.final.y)

    def load(part: slice) -> tuple[slice, csc_array, csc_array]:
        some = tets[part]
        around_hot = _compliance(equilibria.held_pattern, hot_tangent, equilibria.held_mask, equilibria, some)
        around_cold = _compliance(equilibria.free_pattern, cold_tangent, cold_mask, equilibria, some)
        mixed = _between_nodes(equilibria, lin, some)
        hot, cold = flip_forces(equilibria, design, some, around_hot, around_cold, mixed)
        elements, n_nodes = problem.body.elements[some], problem.n_nodes
        return part, force_columns(elements, hot, n_nodes), force_columns(elements, cold, n_nodes)

    firsts = range(0, len(tets), AT_ONCE)
    return [partial(load, slice(first, min(first + AT_ONCE, len(tets)))) for first in firsts]


def flip_forces(
    equilibria: Equilibria,
    design: Design,
    tets: IntArray,
    around_hot: FloatArray,
    around_cold: FloatArray,
    mixed: FloatArray,
) -> tuple[FloatArray, FloatArray]:
    """What tets (k,) with their other material change of the nodal forces (k, 3nn) in the median and final shape.

    around_hot, around_cold (k, 3nn, 3nn) : compliance of the nodes of each tet in the two shapes
    mixed (k, 3nn, 3nn) : derivative of their forces in the final shape by their positions in the median shape

    With the change s of the density, k the tangent and r the force of the new material less those of the old one, and C
    the compliance, the tet's nodes move by -C f for the force f = s (r - k C f) that they get.
    """
    problem, x, y = equilibria.problem, design.median.x, design.final.y
    body, gradients = problem.body, design.median.gradients
    rho = design.rho[tets]
    s = np.where(rho > 0.5, -rho, 1 - rho)
    tpe, glassy = (body.dN, problem.tpe, y - body.X), (gradients, problem.glassy, y - x)
    hot = Moduli(problem.rubbery.mu - problem.tpe.mu, problem.rubbery.kappa - problem.tpe.kappa)
    r, k = _force_and_tangent(equilibria, tets, body.dN, hot, x - body.X)
    f_hot = _condensed(s[:, None] * r, s[:, None, None] * k, around_hot)
    moved = -np.einsum("kij,kj->ki", around_hot, f_hot)
    r, k = (
        a - b
        for a, b in zip(
            _force_and_tangent(equilibria, tets, *glassy), _force_and_tangent(equilibria, tets, *tpe), strict=True
        )
    )
    r += np.einsum("kij,kj->ki", _mixed_blocks(equilibria, tets, gradients, problem.glassy, y - x), moved)
    r -= np.einsum("kij,kjl,klm,km->ki", k, around_cold, mixed, moved, optimize=True)
    return f_hot, _condensed(s[:, None] * r, s[:, None, None] * k, around_cold)


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


def _compliance(
    pattern: SymmetricPattern, tangent: FloatArray, mask: DirichletMask, equilibria: Equilibria, tets: IntArray
) -> FloatArray:
    """(k, 3nn, 3nn) how the nodes of each tet move by forces on them while all others stay; zero at fixed dofs."""
    elements = equilibria.problem.body.elements[tets]
    blocks = np.zeros((*elements.shape, elements.shape[1], 3, 3))
    kernels.gather_blocks(elements, pattern.rank[tets], pattern.indptr, tangent, blocks)
    free = np.ones(pattern.n_dofs)
    free[mask.fixed] = 0.0
    moves = free[element_dofs(elements)]
    return np.linalg.inv(_square(blocks)) * moves[:, :, None] * moves[:, None, :]


def _between_nodes(equilibria: Equilibria, lin: Linearisation, tets: IntArray) -> FloatArray:
    """(k, 3nn, 3nn) the blocks of M between the nodes of each tet."""
    elements, n = equilibria.problem.body.elements[tets], equilibria.problem.n_nodes
    rows = np.repeat(np.arange(n), np.diff(lin.M.indptr))
    place = np.searchsorted(rows * n + lin.M.indices, elements[:, :, None] * n + elements[:, None, :])
    return _square(lin.M.data[place])


def _square(blocks: FloatArray) -> FloatArray:
    """(k, 3nn, 3nn) matrices of blocks (k, nn, nn, 3, 3)."""
    k, nn = blocks.shape[:2]
    return blocks.transpose(0, 1, 3, 2, 4).reshape(k, 3 * nn, 3 * nn)
