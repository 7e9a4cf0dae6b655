"""The objective of model.md section 4 and the limits of rig and material, with their Gauss-Newton pieces."""

from dataclasses import dataclass, replace

import numpy as np
from scipy.sparse import csr_array, diags_array

from fab4d.design.equilibria import Equilibria, Final, Median
from fab4d.design.patches import Patches, outward_normals
from fab4d.design.problem import Problem
from fab4d.mesh.measures import unit_vectors
from fab4d.mesh.rigid import best_rigid_motion
from fab4d.mesh.tetmesh import FloatArray, IntArray


@dataclass(frozen=True)
class ObjectiveWeights:
    """Weights of the dimensionless terms; `error_scale` is the RMS error, in L0, at which E_p counts 1.

    lam_round weighs (4/V) sum_j V_j rho_j (1 - rho_j): unlike E_mat it has a slope at 0 and 1, so densities reach them.

    max_force : largest force of a patch, in mu_TPE L0^2          smp_, tpe_max_stretch : largest principal stretches
    pull_only : whether a force may not point into the surface
    limit : weight of the squared relative excess beyond these limits

    least_stretch : smallest principal stretch below which tets count as squeezed
    lam_squeeze : weight of the mean square, over the volume, of what the stretches of squeezed tets lack of it

    least_stable : share of its stiffness that a mode of the median shape keeps at least, below which it counts as soft
    lam_stable : weight of the sum of squares of what soft modes lack of it, relative to it
    """

    error_scale: float
    lam_SMP: float = 0.0
    lam_mat: float = 0.0
    lam_round: float = 0.0
    lam_smooth: float = 0.0
    max_force: float = np.inf
    smp_max_stretch: float = np.inf
    tpe_max_stretch: float = np.inf
    pull_only: bool = False
    limit: float = 100.0
    least_stretch: float = 0.0
    lam_squeeze: float = 0.0
    least_stable: float = 0.0
    lam_stable: float = 0.0

    def replace(self, **changes: float) -> "ObjectiveWeights":
        """The same with other numbers."""
        return replace(self, **changes)  # type: ignore[arg-type]

    def of_fixed_density(self) -> "ObjectiveWeights":
        """The same without the terms that the density alone decides."""
        return self.replace(lam_SMP=0.0, lam_mat=0.0, lam_round=0.0, lam_smooth=0.0)


# A rig that only pulls is asked for this share of the usual force out of the surface: a penalty gives way a little.
PULL_MARGIN = 0.05


def smoothness_matrix(problem: Problem) -> csr_array:
    """L (m, m) with rho^T L rho = E_smooth = (1/A) sum_faces A_jk (rho_j - rho_k)^2, A the whole interior face area."""
    j, k = problem.neighbours.T
    w = problem.neighbour_areas / problem.neighbour_areas.sum()
    m = problem.n_tets
    off = csr_array((w, (j, k)), shape=(m, m))
    off = off + off.T
    return csr_array(diags_array(np.asarray(off.sum(axis=0)).ravel()) - off)


@dataclass(frozen=True, eq=False)
class ShapeError:
    """Residual e (N, 3) = R y + t - X_temp of the aligned final shape, its rotation R and weighted RMS, in L0."""

    e: FloatArray
    R: FloatArray
    rms: float


def shape_error(problem: Problem, y: FloatArray) -> ShapeError:
    """Distance of the final shape y (N, 3) to X_temp on the boundary, after the best rigid motion."""
    a = problem.area_weights
    R, t = best_rigid_motion(y, problem.X_temp, a)
    e = y @ R.T + t - problem.X_temp
    return ShapeError(e, R, float(np.sqrt(a @ (e**2).sum(axis=1))))


def rigid_modes(y: FloatArray) -> FloatArray:
    """(N, 3, 6) translations and infinitesimal rotations of the shape y."""
    centred = y - y.mean(axis=0)
    modes = np.zeros((len(y), 3, 6))
    for i, axis in enumerate(np.eye(3)):
        modes[:, i, i] = 1.0
        modes[:, :, 3 + i] = np.cross(axis, centred)
    return modes


@dataclass(frozen=True, eq=False)
class ShapeMetric:
    """The Gauss-Newton metric of E_p: dy -> W (dy without its rigid part); W = 2 diag(a) / error_scale^2."""

    weights: FloatArray
    modes: FloatArray
    gram_inverse: FloatArray

    def apply(self, dy: FloatArray) -> FloatArray:
        """W P dy for dy (3N,) or (3N, k), P the projection along rigid modes; symmetric, positive semidefinite."""
        w = self.weights if dy.ndim == 1 else self.weights[:, None]
        weighted = w * dy
        return weighted - w * (self.modes @ (self.gram_inverse @ (self.modes.T @ weighted)))


def shape_metric(problem: Problem, y: FloatArray, error_scale: float) -> ShapeMetric:
    """Metric of E_p / error_scale^2 at the final shape y."""
    w = np.repeat(2.0 * problem.area_weights / error_scale**2, 3)
    modes = rigid_modes(y).reshape(-1, 6)
    gram: FloatArray = modes.T @ (w[:, None] * modes)
    return ShapeMetric(w, modes, np.linalg.inv(gram).astype(np.float64))


def force_excess(forces: FloatArray, max_force: float) -> FloatArray:
    """(K,) how far the size of each force is beyond the largest one, relative to it."""
    return np.maximum(np.linalg.norm(forces, axis=1) / max_force - 1.0, 0.0)


@dataclass(frozen=True, eq=False)
class ForceExcess:
    """The forces beyond what the rig gives.

    values (k,) : relative excess times sqrt(2 limit), half of whose squares sum to the penalty
    rows (k, 3K) : their derivatives with respect to the forces, the normals and the usual force held
    """

    values: FloatArray
    rows: FloatArray


def forces_beyond(weights: ObjectiveWeights, patches: Patches, median: Median) -> ForceExcess:
    """Forces of the median shape that are too large, or that push where the rig only pulls."""
    excess, along = force_excess(median.forces, weights.max_force), unit_vectors(median.forces) / weights.max_force
    if weights.pull_only and patches.count:
        push = pushes(patches, median)
        excess, along = np.concatenate([excess, push.excess]), np.concatenate([along, -push.normals / push.usual])
    active, scale = np.flatnonzero(excess > 0), np.sqrt(2 * weights.limit)
    rows = np.zeros((len(active), patches.count, 3))
    if len(active):
        rows[np.arange(len(active)), active % patches.count] = scale * along[active]
    return ForceExcess(scale * excess[active], rows.reshape(len(active), 3 * patches.count))


@dataclass(frozen=True, eq=False)
class Pushes:
    """How far each force (K,) is from being a pull: what it lacks of PULL_MARGIN `usual` along its outward normal
    (K, 3), relative to the usual force."""

    excess: FloatArray
    normals: FloatArray
    usual: float


def pushes(patches: Patches, median: Median) -> Pushes:
    """Forces of the median shape that a rig which only pulls cannot give."""
    usual = float(np.sqrt((median.forces**2).sum(axis=1).mean())) + 1e-12
    normals = outward_normals(patches, median.x)
    outward = (median.forces * normals).sum(axis=1) / usual
    return Pushes(np.maximum(PULL_MARGIN - outward, 0.0), normals, usual)


@dataclass(frozen=True, eq=False)
class StretchExcess:
    """The tets (k,) whose mean deformation gradient in the median shape is stretched too far.

    values (k,) : relative excess times sqrt(2 limit), half of whose squares sum to the penalty
    rows (k, 3N), by_density (k,) : their derivatives with respect to x and to the tet's own density
    """

    tets: IntArray
    values: FloatArray
    rows: csr_array
    by_density: FloatArray

    def density_gradient(self, n_tets: int) -> FloatArray:
        """(m,) gradient of the penalty with respect to the density."""
        gradient = np.zeros(n_tets)
        gradient[self.tets] = self.values * self.by_density
        return gradient


def stretch_excess(
    problem: Problem, weights: ObjectiveWeights, rho: FloatArray, x: FloatArray, share: float = 1.0
) -> StretchExcess:
    """Principal stretches of x (N, 3) beyond the limit, which is mixed of the materials' by rho (m,).

    share : of the limit from which on tets are looked at; below it the excess is negative
    """
    body = problem.body
    if np.isinf(weights.smp_max_stretch) or np.isinf(weights.tpe_max_stretch):
        return StretchExcess(np.zeros(0, np.int64), np.zeros(0), csr_array((0, x.size)), np.zeros(0))
    allowed = rho * weights.smp_max_stretch + (1 - rho) * weights.tpe_max_stretch
    dN = body.dN.mean(axis=1)
    F = np.einsum("mai,maj->mij", x[body.elements], dN)
    # The Frobenius norm bounds the largest stretch from above: most tets need no singular values.
    near = np.flatnonzero(np.sqrt((F**2).sum(axis=(1, 2))) > share * allowed)
    U, s, Vt = np.linalg.svd(F[near])
    over = s[:, 0] > share * allowed[near]
    tets, largest = near[over], s[over, 0]
    scale = np.sqrt(2 * weights.limit) / allowed[tets]
    values = scale * (largest - allowed[tets])
    # d sigma_1 = u_1 . dF v_1
    along = np.einsum("kaj,kj->ka", dN[tets], Vt[over, 0])
    slope = scale[:, None, None] * along[:, :, None] * U[over, :, 0][:, None, :]
    rows = _rows_of(body.elements[tets], slope, x.size)
    by_density = -scale * largest / allowed[tets] * (weights.smp_max_stretch - weights.tpe_max_stretch)
    return StretchExcess(tets, values, rows, by_density)


@dataclass(frozen=True, eq=False)
class Squeeze:
    """The tets (k,) whose mean deformation gradient in the median shape squeezes them too far.

    values (k,) : what the smallest principal stretch lacks of the least one, relative to it, times the root of
    2 lam_squeeze v; half of their squares sum to the penalty
    rows (k, 3N) : their derivatives with respect to x
    """

    tets: IntArray
    values: FloatArray
    rows: csr_array


def squeeze(problem: Problem, weights: ObjectiveWeights, x: FloatArray, share: float = 1.0) -> Squeeze:
    """Smallest principal stretches of x (N, 3) below weights.least_stretch.

    share : tets are looked at up to so many times less squeeze; above the least stretch their values are negative

    A free surface that is squeezed farther turns unstable in short waves (Biot, Appl. Sci. Res. A 12 (1963) 168): such
    a shape depends on the way that leads to it.
    """
    body = problem.body
    if weights.lam_squeeze == 0 or weights.least_stretch == 0:
        return Squeeze(np.zeros(0, np.int64), np.zeros(0), csr_array((0, x.size)))
    dN = body.dN.mean(axis=1)
    F = np.einsum("mai,maj->mij", x[body.elements], dN)
    # sigma_3 = det F / (sigma_1 sigma_2) >= 2 det F / |F|^2: most tets need no singular values.
    from_here = weights.least_stretch / share
    near = np.flatnonzero(2 * np.linalg.det(F) < from_here * (F**2).sum(axis=(1, 2)))
    U, s, Vt = np.linalg.svd(F[near])
    over = s[:, 2] < from_here
    tets, smallest = near[over], s[over, 2]
    scale = np.sqrt(2 * weights.lam_squeeze * problem.volume_fractions[tets])
    values = scale * (1 - smallest / weights.least_stretch)
    # d sigma_3 = u_3 . dF v_3
    along = np.einsum("kaj,kj->ka", dN[tets], Vt[over, 2])
    slope = (-scale / weights.least_stretch)[:, None, None] * along[:, :, None] * U[over, :, 2][:, None, :]
    return Squeeze(tets, values, _rows_of(body.elements[tets], slope, x.size))


def _rows_of(elements: IntArray, slopes: FloatArray, n_columns: int) -> csr_array:
    """(k, 3N) rows of derivatives (k, nn, 3) by the nodes of elements (k, nn)."""
    k, width = len(elements), 3 * elements.shape[1]
    columns = (3 * elements[:, :, None] + np.arange(3)).reshape(-1)
    return csr_array((slopes.ravel(), columns, np.arange(0, k * width + 1, width)), shape=(k, n_columns))


@dataclass(frozen=True, eq=False)
class DensityTerms:
    """Value, gradient (m,) and diagonal of a positive semidefinite Hessian model of the terms in rho alone."""

    value: float
    gradient: FloatArray
    curvature: FloatArray


def density_terms(weights: ObjectiveWeights, v: FloatArray, L: csr_array, rho: FloatArray) -> DensityTerms:
    """E_SMP, E_mat and E_smooth at rho (m,); v (m,) volume fractions. E_smooth's Hessian 2 lam_smooth L is apart."""
    g = rho * (1 - rho)
    slope = 1 - 2 * rho
    smooth = L @ rho
    value = (
        weights.lam_SMP * float(v @ rho**2)
        + 16 * weights.lam_mat * float(v @ g**2)
        + 4 * weights.lam_round * float(v @ g)
        + weights.lam_smooth * float(rho @ smooth)
    )
    push = 2 * weights.lam_SMP * rho + 32 * weights.lam_mat * g * slope + 4 * weights.lam_round * slope
    gradient = v * push + 2 * weights.lam_smooth * smooth
    bend = 32 * weights.lam_mat * (slope**2 - 2 * g)
    return DensityTerms(value, gradient, v * (2 * weights.lam_SMP + np.maximum(bend, 0.0)))


def objective_value(
    equilibria: Equilibria,
    weights: ObjectiveWeights,
    terms: DensityTerms,
    rho: FloatArray,
    median: Median,
    final: Final,
) -> float:
    """The objective but for soft modes, each term dimensionless."""
    problem = equilibria.problem
    error = shape_error(problem, final.y).rms / weights.error_scale
    forces = 0.5 * float((forces_beyond(weights, equilibria.patches, median).values ** 2).sum())
    stretches = 0.5 * float((stretch_excess(problem, weights, rho, median.x).values ** 2).sum())
    squeezed = 0.5 * float((squeeze(problem, weights, median.x).values ** 2).sum())
    return error**2 + terms.value + forces + stretches + squeezed
