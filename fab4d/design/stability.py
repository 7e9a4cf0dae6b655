"""How near the held, hot median shape is to a state in which it would buckle, and what that depends on.

Of a mode phi of the median shape, the ratio lambda of K phi = lambda K+ phi tells what is left of its stiffness: K is
the tangent, K+ that of which each element's negative curvature is cut off. It is 1 where compression takes nothing, and
0 where the shape turns unstable. Unlike a frequency it does not depend on the size of what moves: a slender limb that
bends easily has a ratio near 1, and a wave on a squeezed surface about to fold one near 0.
"""

from dataclasses import dataclass
from weakref import WeakKeyDictionary

import numpy as np
from scipy.sparse import csr_array

from fab4d.design.equilibria import RIG_COMPLIANCE, Equilibria, Median
from fab4d.design.objective import ObjectiveWeights
from fab4d.design.sensitivity import forces_by_density
from fab4d.mesh.tetmesh import FloatArray
from fab4d.solvers.block_lanczos import end_modes
from fab4d.solvers.linear import Factor, SingularMatrixError, product

# So many modes are looked at, those nearest to instability.
MODES = 6
MODE_TOLERANCE, BLOCK, MOST_BLOCKS = 1e-2, 8, 24
# Third derivatives are differences over a displacement that changes the edges of no tet by more than this share.
DIFFERENCE = 1e-4


@dataclass(frozen=True, eq=False)
class SoftModes:
    """The modes nearest to instability: ratios (k,) rising, shapes (k, N, 3) with phi . K+ phi = 1."""

    ratios: FloatArray
    shapes: FloatArray


# A median shape is in equilibrium with one density at one set of points, so that its modes are its own.
_known: WeakKeyDictionary[Median, SoftModes] = WeakKeyDictionary()


def soft_modes(equilibria: Equilibria, rho: FloatArray, median: Median, factor: Factor | None = None) -> SoftModes:
    """Those of the median shape of rho (m,), by Lanczos on the inverse of the tangent.

    factor : of `Equilibria.median_tangent` there, if it is known
    Raises SingularMatrixError where the tangent is singular.
    """
    if median not in _known:
        _known[median] = _found(equilibria, rho, median.x, factor)
    return _known[median]


def _found(equilibria: Equilibria, rho: FloatArray, x: FloatArray, factor: Factor | None) -> SoftModes:
    n, pattern, W = x.size, equilibria.held_pattern, equilibria.operator
    if factor is None:
        factor = equilibria.held_analysis.factor(equilibria.median_tangent(rho, x))
    data = equilibria.median_tangent(rho, x, spd=True)

    def stiffness(u: FloatArray) -> FloatArray:
        # The forces that the rig answers with leave nothing of the constraints' rows.
        rig = -(W @ u.reshape(len(x), -1)).reshape(-1, u.shape[1]) / RIG_COMPLIANCE
        return product(pattern.indptr, pattern.indices, data, np.concatenate([u, rig]))[:n]

    def compliance(loads: FloatArray) -> FloatArray:
        return factor.solve_many(np.concatenate([loads, np.zeros((pattern.n_dofs - n, loads.shape[1]))]))[:n]

    loads = np.random.default_rng(0).standard_normal((n, BLOCK))
    loads[equilibria.held_mask.fixed] = 0.0
    unstable = min(max(factor.n_negative - 3 * equilibria.patches.count, 0), MODES)
    # A mode's eigenvalue of the inverse is the inverse of its ratio.
    modes = end_modes(
        compliance, stiffness, compliance(loads), unstable, MODES - unstable, MODE_TOLERANCE, MOST_BLOCKS
    ).found
    ratios = 1 / modes.values
    order = np.argsort(ratios)
    return SoftModes(ratios[order], modes.vectors.T[order].reshape(-1, *x.shape))


@dataclass(frozen=True, eq=False)
class Softening:
    """The modes (k,) of the median shape that are nearer to instability than they may be.

    values (k,) : what the ratio lacks of the least one, relative to it, times the root of 2 lam_stable; half of their
    squares sum to the penalty
    rows (k, 3N), by_density (k, m) : their derivatives with respect to x and to the density, K+ held: what that changes
    counts in proportion to the ratio, so that they are exact at instability and rough far from it
    """

    values: FloatArray
    rows: csr_array
    by_density: FloatArray

    def density_gradient(self) -> FloatArray:
        """(m,) gradient of the penalty with respect to the density at a held median shape."""
        return self.by_density.T @ self.values


def softening(
    equilibria: Equilibria, weights: ObjectiveWeights, rho: FloatArray, median: Median, factor: Factor | None = None
) -> Softening:
    """The penalty on modes of the median shape whose ratio is below weights.least_stable; see `soft_modes`."""
    if weights.lam_stable == 0:
        return Softening(np.zeros(0), csr_array((0, median.x.size)), np.zeros((0, len(rho))))
    modes = soft_modes(equilibria, rho, median, factor)
    soft = modes.ratios < weights.least_stable
    slope = -np.sqrt(2 * weights.lam_stable) / weights.least_stable
    at_x, rows, by_density = equilibria.median_gradient(rho, median.x)[0], [], []
    for shape in modes.shapes[soft]:
        h = _short(equilibria, median.x, shape)
        rows.append(slope * _by_shape(equilibria, rho, median.x, shape, h, at_x).ravel())
        by_density.append(slope * _by_density(equilibria, median.x, shape, h))
    return Softening(
        slope * (modes.ratios[soft] - weights.least_stable),
        csr_array(np.reshape(rows, (len(rows), median.x.size))),
        np.reshape(by_density, (len(rows), len(rho))),
    )


def softening_penalty(equilibria: Equilibria, weights: ObjectiveWeights, rho: FloatArray, median: Median) -> float:
    """The same penalty without its derivatives; inf where the tangent is singular."""
    if weights.lam_stable == 0:
        return 0.0
    try:
        lacking = 1 - soft_modes(equilibria, rho, median).ratios / weights.least_stable
    except SingularMatrixError:
        return np.inf
    return weights.lam_stable * float((np.maximum(lacking, 0.0) ** 2).sum())


def _by_shape(
    equilibria: Equilibria, rho: FloatArray, x: FloatArray, shape: FloatArray, h: float, at_x: FloatArray
) -> FloatArray:
    """(N, 3) derivative of phi . K phi with respect to x: the second derivative of the nodal forces along phi.

    h : of the difference        at_x : (N, 3) these forces at x
    """
    before, after = (equilibria.median_gradient(rho, x + t * shape)[0] for t in (-h, h))
    return (before - 2 * at_x + after) / h**2


def _by_density(equilibria: Equilibria, x: FloatArray, shape: FloatArray, h: float) -> FloatArray:
    """(m,) derivative of phi . K phi with respect to the density."""
    before, after = (forces_by_density(equilibria, x + t * shape) for t in (-h, h))
    return np.einsum("mai,mai->m", after - before, shape[equilibria.problem.body.elements]) / (2 * h)


def _short(equilibria: Equilibria, x: FloatArray, shape: FloatArray) -> float:
    """A step along the shape that changes edges by a share of DIFFERENCE at most."""
    corners = equilibria.problem.body.elements[:, :4]
    edges, changes = (np.linalg.norm(each[corners[:, 1:]] - each[corners[:, :1]], axis=2) for each in (x, shape))
    return DIFFERENCE / float((changes / edges).max())
