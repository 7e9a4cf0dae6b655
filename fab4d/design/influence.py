"""What the other material in whole tets does to the final shape and to active limits, by linear algebra alone.

The forces that flipped tets exert (`flip_loads.py`) go through the factors of the whole part. What many flips do to the
surface is told by few measures of it: random sums of flips span what most of them have in common (Halko, Martinsson,
Tropp, SIAM Review 53 (2011) 217), and random fields tell how much of each is left out.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import TypeVar

import numpy as np
from scipy.linalg import qr
from scipy.sparse import csr_array, vstack

from fab4d.design.equilibria import Equilibria, Median
from fab4d.design.flip_loads import FlipLoads, flip_loads
from fab4d.design.gauss_newton import HELD_STEP, ROUNDED_OFF, Ahead, Design
from fab4d.design.objective import (
    ObjectiveWeights,
    forces_beyond,
    rigid_modes,
    shape_error,
    squeeze,
    stretch_excess,
)
from fab4d.design.problem import Problem
from fab4d.design.sensitivity import Linearisation, linearise
from fab4d.mesh.tetmesh import BoolArray, FloatArray, IntArray
from fab4d.solvers.threads import side_by_side

Result = TypeVar("Result")

# So many measures are followed at once.
AT_ONCE = 64
# Held positions follow as a Gauss-Newton step with this damping lets them.
HELD_DAMPING = 0.03
# Random sums of flips that the measures of the surface span, and random fields that see what these leave out.
SAMPLES, PROBES = 256, 16
# Tets count as near a limit from this share of it on; so many limits are followed, those that are nearest.
NEAR_LIMIT, MOST_LIMITS = 0.75, 100
# The held positions settle among limits in so many tries of which of them hold back.
MOST_ACTIVE_SETS = 10
# How little a flip's worth follows what is seen of many.
TEACH_RIDGE = 0.1
# What a flip does comes out with an error of this share of it, so that flips that each do much and in sum should cancel
# leave more than they promise.
UNCERTAIN = 0.3


@dataclass(frozen=True, eq=False)
class Limits:
    """The limits of forces, stretches and squeezes that a design is at or near, as measures: the squares of those above
    zero sum, with that of the RMS error in L0, to the objective times error_scale^2.

    values (l,) : at the design        rows_x (l, 3N), rows_f (l, 3K) : derivatives by median shape and forces
    """

    values: FloatArray
    rows_x: csr_array
    rows_f: FloatArray
    median: Median

    def at(self, median: Median) -> FloatArray:
        """(l,) at another median shape, to first order."""
        dx, df = median.x - self.median.x, median.forces - self.median.forces
        return self.values + self.rows_x @ dx.ravel() + self.rows_f @ df.ravel()


def limits_near(equilibria: Equilibria, design: Design, weights: ObjectiveWeights) -> Limits:
    """The limits that the design is beyond, and those that it is near."""
    problem, median = equilibria.problem, design.median
    scale, k = weights.error_scale / np.sqrt(2), 3 * equilibria.patches.count
    forces = forces_beyond(weights, equilibria.patches, median)
    stretch = stretch_excess(problem, weights, design.rho, median.x, NEAR_LIMIT)
    squeezed = squeeze(problem, weights, median.x, NEAR_LIMIT)
    values = np.concatenate([forces.values, stretch.values, squeezed.values])
    no_shape, no_force = csr_array((len(forces.values), median.x.size)), np.zeros((len(values) - len(forces.values), k))
    rows_x = vstack([no_shape, stretch.rows, squeezed.rows], format="csr")
    rows_f = np.vstack([forces.rows, no_force])
    kept = np.sort(np.argsort(-values, kind="stable")[:MOST_LIMITS])
    return Limits(scale * values[kept], scale * rows_x[kept], scale * rows_f[kept], median)


@dataclass(frozen=True, eq=False)
class View:
    """Linear measures of a design: (p,) of its final shape, which rigid motions do not change, and (l,) of its limits.

    on_surface (s,) : dofs that are looked at        root (s,) : roots of their area weights
    basis (s, p) : orthonormal measures of it
    shape_by_held (3K, p), limits_by_held (3K, l) : derivatives by the held positions
    ridge : what a move of a held position costs, squared errors for a squared length
    """

    on_surface: IntArray
    root: FloatArray
    basis: FloatArray
    limits: Limits
    shape_by_held: FloatArray
    limits_by_held: FloatArray
    ridge: float

    @cached_property
    def gram(self) -> FloatArray:
        """(3K, 3K) what moves of the held positions cost, their effect on the shape included."""
        effect = self.shape_by_held @ self.shape_by_held.T
        # Positions that move the shape alike make that singular, however strict the tolerance.
        return effect + max(self.ridge, ROUNDED_OFF * np.abs(effect).max(initial=0.0)) * np.eye(len(effect))

    def shape(self, problem: Problem, y: FloatArray) -> FloatArray:
        """(p,) error of the final shape y (N, 3)."""
        return _weighted_error(problem, y, self.on_surface, self.root) @ self.basis

    def without_held(self, v: FloatArray) -> FloatArray:
        """Measures of the shape (..., p) without what the held positions take away where no limit holds them back."""
        follow = np.linalg.solve(self.gram, self.shape_by_held)
        return v - (v @ self.shape_by_held.T) @ follow

    def error(self, problem: Problem, y: FloatArray) -> FloatArray:
        """(p,) that of the final shape y (N, 3), without what the held positions take away."""
        return self.without_held(self.shape(problem, y))


@dataclass(frozen=True, eq=False)
class Settled:
    """Moves (3K,) of the held positions that lower the objective of a predicted design most, and what is left.

    squared : the error in L0, squared, with what is expected of doubt, and that of the limits that it is beyond
    active (l,) : the limits that hold them back
    """

    squared: float
    moves: FloatArray
    active: BoolArray


@dataclass(frozen=True, eq=False)
class FlipEnergy:
    """|error + sum of changes|^2 + |positive part of beyond + sum of limit_changes|^2 + doubts + prices, of flips of
    tets (k,).

    error (p,), changes (k, p) : of the shape        beyond (l,), limit_changes (k, l) : of the limits
    doubts (k,) : the squared error, L0^2, that is expected of a flip besides
    price, defect_price : of each flip, and of each place that is left pinched, L0^2
    """

    tets: IntArray
    error: FloatArray
    changes: FloatArray
    beyond: FloatArray
    limit_changes: FloatArray
    doubts: FloatArray
    price: float
    defect_price: float


@dataclass(frozen=True, eq=False)
class Influence:
    """What flips of tets change of the error of a design, a vector whose length is its RMS error in L0, and of limits.

    tets (k,) : that may be flipped        shape (p,), beyond (l,) : measures of the design
    shape_change (k, p), limit_change (k, l) : by each flip at fixed held positions
    unseen (k,) : the squared error, L0^2, of what a flip changes besides, mostly dents of its own
    lin, loads : the linear maps about the design, and what the flips exert
    doubt : the share of each change by which it is expected to come out otherwise
    """

    tets: IntArray
    shape: FloatArray
    beyond: FloatArray
    shape_change: FloatArray
    limit_change: FloatArray
    unseen: FloatArray
    view: View
    lin: Linearisation
    loads: FlipLoads
    doubt: float = UNCERTAIN

    @cached_property
    def change(self) -> FloatArray:
        """(k, p) of the shape by each flip, without what the held positions take away."""
        return self.view.without_held(self.shape_change)

    @cached_property
    def doubts(self) -> FloatArray:
        """(k,) squared error, L0^2, that is expected of each flip beside what its change, which may come out otherwise,
        makes of the error."""
        return self.unseen + self.doubt**2 * np.einsum("kp,kp->k", self.change, self.change)

    @cached_property
    def residual(self) -> FloatArray:
        """(p,) error of the shape, without what the held positions take away."""
        return self.view.without_held(self.shape)

    def measures(self, flipped: BoolArray) -> tuple[FloatArray, FloatArray]:
        """(p,) of the shape and (l,) of the limits, with the tets `flipped` (k,) at fixed held positions."""
        shape = self.shape + self.shape_change[flipped].sum(axis=0)
        return shape, self.beyond + self.limit_change[flipped].sum(axis=0)

    def after(self, flipped: BoolArray) -> Settled:
        """The held positions settled with the tets `flipped` (k,)."""
        shape, beyond = self.measures(flipped)
        squared = float(shape @ shape + self.doubts[flipped].sum())
        return self.settled(squared, self.view.shape_by_held @ shape, beyond)

    def ahead(self, flipped: BoolArray, moves: FloatArray) -> Ahead:
        """Where the equilibria are predicted with the tets `flipped` (k,) and moves (3K,) of the held positions."""
        loads = self.loads.of(np.flatnonzero(flipped))
        n = loads.hot.shape[0]
        hot = -np.concatenate([loads.hot.sum(axis=1), moves])
        z, dy = self.lin.respond(hot[:, None], -loads.cold.sum(axis=1)[:, None])
        dc, dx, df, dy = (each.reshape(-1, 3) for each in (moves, z[:n], z[n:], dy))
        return Ahead(dc, dx, df, dy, self.lin)

    def damped(self, factor: float) -> "Influence":
        """The same with moves of the held positions that cost so many times as much."""
        return replace(self, view=replace(self.view, ridge=factor * self.view.ridge))

    def left(self, flipped: BoolArray) -> float:
        """The error, L0, with the tets `flipped` (k,) and the held positions settled, limits included."""
        return float(np.sqrt(self.after(flipped).squared))

    def settled(self, squared: float, toward: FloatArray, beyond: FloatArray) -> Settled:
        """Held positions that settle where the shape has this squared error and gradient (3K,), by an active set.

        beyond (l,) : of each limit before they move
        """
        view, active, moves = self.view, beyond > 0, np.zeros(len(toward))
        for _ in range(MOST_ACTIVE_SETS):
            by_held = view.limits_by_held[:, active]
            pull = toward + by_held @ beyond[active]
            moves = -np.linalg.solve(view.gram + by_held @ by_held.T, pull).astype(np.float64)
            before, active = active, beyond + moves @ view.limits_by_held > 0
            if (active == before).all():
                break
        settled = beyond + moves @ view.limits_by_held
        squared += float(2 * toward @ moves + moves @ view.gram @ moves + (np.maximum(settled, 0) ** 2).sum())
        return Settled(max(squared, 0.0), moves, settled > 0)

    def energy(self, flipped: BoolArray, price: float, defect_price: float = 0.0) -> "FlipEnergy":
        """What flips cost where the tets `flipped` (k,) are flipped already and the held positions have settled.

        Prices are in squared errors then. From there the held positions follow along the limits that hold them back:
        where these change the true error is smaller.
        """
        view, sign = self.view, np.where(flipped, -1.0, 1.0)[:, None]
        shape, beyond = self.measures(flipped)
        settled = self.after(flipped)
        error, beyond = shape + settled.moves @ view.shape_by_held, beyond + settled.moves @ view.limits_by_held
        squared = float(error @ error + (np.maximum(beyond, 0) ** 2).sum())
        by_held = view.limits_by_held[:, settled.active]
        pulls = self.shape_change @ view.shape_by_held.T + self.limit_change[:, settled.active] @ by_held.T
        moves = -np.linalg.solve(view.gram + by_held @ by_held.T, pulls.T).T
        changes = sign * (self.shape_change + moves @ view.shape_by_held)
        limit_changes, doubts = sign * (self.limit_change + moves @ view.limits_by_held), sign[:, 0] * self.doubts
        prices = price * squared, defect_price * squared
        return FlipEnergy(self.tets, error, changes, beyond, limit_changes, doubts, *prices)

    def taught(self, flipped: BoolArray, shape: FloatArray, beyond: FloatArray) -> "Influence":
        """The same after the tets `flipped` (k,) have really led to these measures: what they do together is that.

        Each is worth as much more or less as explains the error best, and the rest is shared in proportion to squares.
        """
        done = self.change[flipped]
        gram = done @ done.T
        ridge = TEACH_RIDGE * np.trace(gram) / len(done)
        misfit = self.view.without_held(shape) - self.residual - done.sum(axis=0)
        worth = 1 + np.linalg.solve(gram + ridge * np.eye(len(done)), done @ misfit)
        shapes = _shared(worth[:, None] * self.shape_change[flipped], shape - self.shape)
        limits = _shared(worth[:, None] * self.limit_change[flipped], beyond - self.beyond)
        shape_change, limit_change = self.shape_change.copy(), self.limit_change.copy()
        shape_change[flipped], limit_change[flipped] = shapes, limits
        return replace(self, shape_change=shape_change, limit_change=limit_change)


def _shared(changes: FloatArray, total: FloatArray) -> FloatArray:
    """(k, q) near these changes, with the sum `total` (q,)."""
    share = (changes**2).sum(axis=1)
    whole = share.sum()
    share = share / whole if whole > 0 else np.full(len(changes), 1 / len(changes))
    return changes + np.outer(share, total - changes.sum(axis=0))


def influence(
    equilibria: Equilibria, design: Design, tets: IntArray, weights: ObjectiveWeights, most: int | None = None
) -> Influence:
    """What a flip of each of `tets` of a near 0/1 design does to its error, or of the `most` that promise most."""
    surface = _surface(equilibria.problem, design.final.y)
    limits = limits_near(equilibria, design, weights)
    lin = linearise(equilibria, design.rho, design.median, design.final)
    loads = flip_loads(equilibria, design, lin, tets)
    if most is not None and len(tets) > most:
        kept = _promising(lin, loads, surface, limits, most)
        tets, loads = tets[kept], loads.of(kept)

    random = np.random.default_rng(0)
    fields = surface.root[:, None] * _spanning_fields(lin, loads, random)[surface.dofs]
    basis = _orthonormal(_without(surface.rigid, np.column_stack([surface.error, fields])))
    signs = random.choice([-1.0, 1.0], (len(basis), PROBES))
    probes = _without(np.hstack([surface.rigid, basis]), signs) / np.sqrt(PROBES)
    of_shape = np.hstack([basis, probes, np.zeros((len(basis), len(limits.values)))])
    of_limits = np.hstack([np.zeros((len(limits.values), basis.shape[1] + PROBES)), np.eye(len(limits.values))])

    def seen(part: slice) -> tuple[FloatArray, FloatArray]:
        return _seen(lin, loads, _gradients(surface, limits, of_shape[:, part], of_limits[:, part]))

    by_flips, by_held = map(np.hstack, zip(*_in_parts(seen, of_shape.shape[1], lin), strict=True))
    ends = [basis.shape[1], basis.shape[1] + PROBES]
    shape_change, probed, limit_change = np.split(by_flips, ends, axis=1)
    shape_by_held, _, limits_by_held = np.split(by_held, ends, axis=1)
    ridge = HELD_DAMPING * weights.error_scale**2 / (max(len(by_held), 1) * HELD_STEP**2)
    view = View(surface.dofs, surface.root, basis, limits, shape_by_held, limits_by_held, ridge)
    unseen, shape = (probed**2).sum(axis=1), view.shape(equilibria.problem, design.final.y)
    return Influence(tets, shape, limits.values, shape_change, limit_change, unseen, view, lin, loads)


# -- from loads to measures


@dataclass(frozen=True, eq=False)
class _Surface:
    """What is looked at of a final shape: dofs (s,), roots (s,) of their area weights, the error (s,), whose length is
    the RMS error in L0, and orthonormal rigid motions (s, 6). n_dofs : of the whole shape"""

    dofs: IntArray
    root: FloatArray
    error: FloatArray
    rigid: FloatArray
    n_dofs: int


def _surface(problem: Problem, y: FloatArray) -> _Surface:
    areas = np.repeat(problem.area_weights, 3)
    dofs = np.flatnonzero(areas)
    root = np.sqrt(areas[dofs])
    rigid, _ = np.linalg.qr(root[:, None] * rigid_modes(y).reshape(-1, 6)[dofs])
    return _Surface(dofs, root, _weighted_error(problem, y, dofs, root), rigid, y.size)


def _promising(lin: Linearisation, loads: FlipLoads, surface: _Surface, limits: Limits, most: int) -> IntArray:
    """The `most` flips that lower the squared error and limits most, to first order, in ascending order."""
    error, beyond = _without(surface.rigid, surface.error), np.maximum(limits.values, 0)
    promise, _ = _seen(lin, loads, _gradients(surface, limits, error[:, None], beyond[:, None]))
    return np.sort(np.argsort(promise[:, 0], kind="stable")[:most])


@dataclass(frozen=True, eq=False)
class Gradients:
    """Of q measures, with respect to x (3N, q), f (3K, q) and y (3N, q)."""

    x: FloatArray
    f: FloatArray
    y: FloatArray


def _gradients(surface: _Surface, limits: Limits, of_shape: FloatArray, of_limits: FloatArray) -> Gradients:
    """Of q measures of the shape (s, q) and of the limits (l, q) together."""
    y = np.zeros((surface.n_dofs, of_shape.shape[1]))
    y[surface.dofs] = surface.root[:, None] * of_shape
    return Gradients(limits.rows_x.T @ of_limits, limits.rows_f.T @ of_limits, y)


def _seen(lin: Linearisation, loads: FlipLoads, gradients: Gradients) -> tuple[FloatArray, FloatArray]:
    """Change (k, q) by each flip, and derivative (3K, q) by the held positions, of q measures with these gradients."""
    n = lin.M.shape[0]
    of_median, of_final = lin.adjoint_states(gradients.x, gradients.f, gradients.y)
    return -(loads.hot.T @ of_median[:n] + loads.cold.T @ of_final), -of_median[n:]


def _spanning_fields(lin: Linearisation, loads: FlipLoads, random: np.random.Generator) -> FloatArray:
    """(3N, 3K + q) changes of the final shape by each held position and by random sums of flips."""
    n_tets = loads.hot.shape[1]
    sums = random.standard_normal((n_tets, min(SAMPLES, n_tets)))

    def follow(part: slice) -> FloatArray:
        hot, cold = -(loads.hot @ sums[:, part]), -(loads.cold @ sums[:, part])
        held = np.zeros((3 * lin.n_patches, hot.shape[1]))
        return lin.respond(np.vstack([hot, held]), cold)[1]

    _, _, by_held = lin.held_columns()
    return np.hstack([by_held, *_in_parts(follow, sums.shape[1], lin)])


def _in_parts(call: Callable[[slice], Result], count: int, lin: Linearisation) -> list[Result]:
    """Its results for slices of `count` measures, side by side."""
    parts = [slice(first, min(first + AT_ONCE, count)) for first in range(0, count, AT_ONCE)]
    return side_by_side([partial(call, part) for part in parts], lin.M.shape[0])


def _orthonormal(fields: FloatArray) -> FloatArray:
    """(s, p) orthonormal basis of fields (s, q), of which some may depend on others."""
    sizes = np.maximum(np.linalg.norm(fields, axis=0), np.finfo(np.float64).tiny)
    basis, r, _ = qr(fields / sizes, mode="economic", pivoting=True)
    size = np.abs(np.diag(r))
    return basis[:, size > 1e-6 * size[0]]


def _without(basis: FloatArray, fields: FloatArray) -> FloatArray:
    """The part of fields (s,) or (s, q) that is orthogonal to an orthonormal basis (s, p)."""
    for _ in range(2):  # twice is enough for orthogonality to rounding
        fields = fields - basis @ (basis.T @ fields)
    return fields


def _weighted_error(problem: Problem, y: FloatArray, on_surface: IntArray, root: FloatArray) -> FloatArray:
    """(s,) error of the final shape y (N, 3), turned back to it; its length is the RMS error in L0."""
    error = shape_error(problem, y)
    return root * (error.e @ error.R).ravel()[on_surface]
