"""Mending inverted tets of a wanted shape: an inversion-safe energy relaxes vertices until det F > 0 everywhere."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from scipy.optimize import minimize

from fab4d.elasticity._untangle_kernels import regularised_energy
from fab4d.mesh.measures import bounding_box_diagonal, edge_matrices, vertex_areas
from fab4d.mesh.tetmesh import BoolArray, FloatArray, IntArray
from fab4d.mesh.topology import face_table, vertices_near

# Weight of the surface and rings of vertices around inverted tets (None: all vertices), to try in turn: the
# surface is fixed (_INSIDE), or held ever more softly, and what moves stays as local as it can.
_INSIDE = ((np.inf, 3), (np.inf, 5))
_SURFACE = ((1e6, 3), (1e4, 3), (1e4, 8), (1e2, 8), (1e4, None), (1e2, None))
_MAX_ROUNDS = 12


class Untangled(NamedTuple):
    """The mended shape, or the best one found."""

    x: FloatArray
    min_det_F: float
    surface_moved: float
    """Largest distance that a boundary vertex moved, mm."""
    moved: int
    """Number of vertices that moved."""


class _Region(NamedTuple):
    """The part of the mesh that is relaxed: free vertices, and the tets that see them."""

    free: IntArray
    tets: IntArray
    gradients: FloatArray
    shares: FloatArray
    pull: FloatArray
    """Stiffness (free,) of the springs that hold surface vertices to their places."""


Tell = Callable[[str], None]


def silent(what: str) -> None:
    """Tell nobody."""


def untangle(X: FloatArray, x: FloatArray, tets: IntArray, fixed: BoolArray, tell: Tell = silent) -> Untangled:
    """Move as few and as inner vertices of x (n, 3), mm, as it takes to have det dx/dX > 0 in all tets (m, 4).

    fixed : (n,) vertices that stay where they are        tell : is told of each attempt
    Raises nothing: `min_det_F` of the result tells whether it succeeded.
    Source: Garanzha et al., Foldover-free maps in 50 lines of code, ACM TOG 40 (2021) 102, eqs. (2)-(4).
    """
    L0 = bounding_box_diagonal(X)
    target = x / L0
    inverse: FloatArray = np.linalg.inv(edge_matrices(X / L0, tets)).astype(np.float64)
    inverted = _dets(target, tets, inverse) <= 0
    boundary = face_table(tets).boundary
    areas = vertex_areas(X, boundary)
    best = target
    attempts = _INSIDE if fixed[areas > 0].all() else _SURFACE
    for number, (weight, rings) in enumerate(attempts, 1):
        if not inverted.any() or _dets(best, tets, inverse).min() > 0:
            break
        tell(f"inverted tets, attempt {number} of {len(attempts)}")
        movable = vertices_near(tets, inverted, len(X), rings) & ~fixed
        region = _region(tets, inverse, movable, areas / areas.sum(), weight)
        if np.isin(tets[inverted], region.free).any(axis=1).all():
            best = max(best, _relax(target, region), key=lambda y: float(_dets(y, tets, inverse).min()))
    distance = L0 * np.linalg.norm(best - target, axis=1)
    return Untangled(
        np.where(distance[:, None] > 0, L0 * best, x),
        float(_dets(best, tets, inverse).min()),
        float(distance[np.unique(boundary)].max()),
        int(np.count_nonzero(distance)),
    )


def _region(
    tets: IntArray,
    inverse: FloatArray,
    movable: BoolArray,
    area_shares: FloatArray,
    weight: float,
) -> _Region:
    """The vertices `movable` (n,), without those of the surface when `weight` is infinite."""
    if np.isinf(weight):
        movable = movable & (area_shares == 0)
    seen = movable[tets].any(axis=1)
    volumes = 1.0 / np.abs(np.linalg.det(inverse))
    free = np.flatnonzero(movable)
    pull = weight * area_shares[free] if np.isfinite(weight) else np.zeros(len(free))
    return _Region(free, tets[seen], inverse[seen], volumes[seen] / volumes.sum(), pull)


def _dets(y: FloatArray, tets: IntArray, inverse: FloatArray) -> FloatArray:
    return np.linalg.det(edge_matrices(y, tets) @ inverse)


def _relax(target: FloatArray, region: _Region) -> FloatArray:
    """Minimise the energy for a falling regularisation until nothing is inverted, then once more as a barrier."""
    y = target
    for _ in range(_MAX_ROUNDS):
        low = float(_dets(y, region.tets, region.gradients).min())
        # The regularisation follows the worst tet down, as in the source's eq. (4).
        epsilon = np.sqrt(1e-12 + 0.04 * min(low, 0.0) ** 2)
        relaxed = _descend(y, target, region, epsilon)
        change = float(np.abs(relaxed - y).max())
        y = relaxed
        if low > 0 or change < 1e-9:
            break
    return y


def _descend(y: FloatArray, target: FloatArray, region: _Region, epsilon: float) -> FloatArray:
    """A descent in which det F, once positive, stays positive: the energy is unbounded (1/epsilon) below zero."""

    def value_and_gradient(free_values: FloatArray) -> tuple[float, FloatArray]:
        trial = y.copy()
        trial[region.free] = free_values.reshape(-1, 3)
        value, gradient = _energy(trial, region, epsilon)
        offset = trial[region.free] - target[region.free]
        value += float(region.pull @ np.sum(offset**2, axis=1))
        return value, (gradient[region.free] + 2 * region.pull[:, None] * offset).ravel()

    found = minimize(
        value_and_gradient,
        y[region.free].ravel(),
        jac=True,
        method="L-BFGS-B",
        options={"maxiter": 200, "maxcor": 10, "ftol": 1e-9, "gtol": 1e-10},
    )
    result = y.copy()
    result[region.free] = found.x.reshape(-1, 3)
    return result


def _energy(y: FloatArray, region: _Region, epsilon: float) -> tuple[float, FloatArray]:
    """The inversion-safe energy and its gradient (n, 3); lengths in L0."""
    gradient = np.zeros_like(y)
    value = regularised_energy(y, region.tets, region.gradients, region.shares, epsilon, gradient)
    return value, gradient
