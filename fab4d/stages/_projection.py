"""The nearest shape to a wanted one that an elastic part can take: no tet inverted, squeezed or torn."""

from typing import NamedTuple

import numpy as np

from fab4d.elasticity.elements import discretise
from fab4d.elasticity.pattern import build_pattern, dirichlet_mask
from fab4d.elasticity.projection import Bounds, DrawnBody
from fab4d.elasticity.untangle import Tell, untangle
from fab4d.mesh.interpolation import closest_shape
from fab4d.mesh.measures import bounding_box_diagonal, deformation_gradients, tet_volumes, vertex_areas
from fab4d.mesh.quality import largest_stretches
from fab4d.mesh.tetmesh import BoolArray, FloatArray, IntArray
from fab4d.mesh.topology import face_table, vertices_near
from fab4d.solvers.linear import Factor, analyse
from fab4d.solvers.newton import Residual, newton

# Springs that draw the surface, per area, and strengths of the bounds to try in turn, both in shear moduli over L0:
# so stiff that an elastic part that is within the bounds moves by some 1e-5 L0.
_PULL = 1e5
_STRENGTHS = (1e3, 1e5, 1e7)
_RINGS = (4, 12, None)
# The bounds push from here on, so that what is left at the end keeps the true ones.
_DET_MARGIN, _STRETCH_MARGIN = 1.5, 0.95
_MOST_STEPS = 40
# Of Newton: by then an inside that has a place within the bounds is there, as good as relaxed.
_FIRST_STEPS = 8
_ROUNDING = 1e-9
# Where more than this share of the volume is beyond the bounds, rings around it are no smaller than the part.
_WIDESPREAD = 0.1


class Measured(NamedTuple):
    """det F and the largest principal stretch of each tet, (m,)."""

    det: FloatArray
    stretch: FloatArray

    def beyond(self, bounds: Bounds) -> BoolArray:
        """(m,) tets squeezed or stretched beyond the bounds."""
        beyond: BoolArray = (self.det < bounds.smallest_det - _ROUNDING) | (
            self.stretch > bounds.largest_stretch + _ROUNDING
        )
        return beyond


def measured(X: FloatArray, x: FloatArray, tets: IntArray) -> Measured:
    """How the shape x (n, 3) deforms the tets (m, 4) of X."""
    F = deformation_gradients(X, x, tets)
    return Measured(np.linalg.det(F), largest_stretches(F))


def share_of_volume(X: FloatArray, tets: IntArray, chosen: BoolArray) -> float:
    """Share of the `chosen` (m,) tets in the volume of X."""
    V = np.abs(tet_volumes(X, tets))
    return float(V[chosen].sum() / V.sum())


def relaxed_inside(
    X: FloatArray, x: FloatArray, tets: IntArray, held: BoolArray, kappa: float, bounds: Bounds, tell: Tell
) -> FloatArray:
    """x (n, 3), mm, with all vertices but the `held` (n,) ones where the elastic energy is least.

    The given places of the moved vertices do not matter.
    kappa : bulk modulus over the shear modulus        tell : is told of each attempt
    A surface that leaves no room within the bounds is not worth the exact minimum: then the shape is only near it.
    """
    smooth = closest_shape(X, tets, np.zeros((len(tets), 3, 3)), np.flatnonzero(held), x)
    start = untangle(X, np.where(held[:, None], x, smooth), tets, held, tell)
    if start.min_det_F <= 0 or held.all():
        return start.x
    x, none, no_bounds = start.x, np.zeros(len(X)), Bounds(0.0, np.inf)
    for most_steps in (_FIRST_STEPS, _MOST_STEPS):
        tell(f"inside, at most {most_steps} steps")
        x = _drawn(X, x, x, tets, ~held, none, kappa, no_bounds, 0.0, 1e-10, most_steps)
        if measured(X, x, tets).beyond(bounds).any():
            break
    return x


def nearest_within(
    X: FloatArray, x: FloatArray, tets: IntArray, clamp: BoolArray, kappa: float, bounds: Bounds, tell: Tell
) -> FloatArray:
    """The shape (n, 3), mm, within the bounds whose surface is near that of x (n, 3); vertices of `clamp` (n,) stay.

    Only vertices around tets beyond the bounds move, more of them where that is not enough. The result may be beyond
    the bounds: `measured` tells.
    kappa : bulk modulus over the shear modulus        tell : is told of each attempt
    """
    beyond = measured(X, x, tets).beyond(bounds)
    start = untangle(X, x, tets, clamp, tell)
    if not beyond.any() or start.min_det_F <= 0:
        return start.x
    pull = _PULL * vertex_areas(X, face_table(tets).boundary) / bounding_box_diagonal(X) ** 2
    tight = Bounds(_DET_MARGIN * bounds.smallest_det, max(_STRETCH_MARGIN * bounds.largest_stretch, 1.0))
    for rings in (None,) if share_of_volume(X, tets, beyond) > _WIDESPREAD else _RINGS:
        free = vertices_near(tets, beyond, len(X), rings) & ~clamp
        nearest = start.x
        for strength in _STRENGTHS:
            tell(f"surface, {int(free.sum())} vertices free, bounds at strength {strength:g}")
            nearest = _drawn(X, nearest, x, tets, free, pull, kappa, tight, strength, 1e-6)
            if not measured(X, nearest, tets).beyond(bounds).any():
                return nearest
    return nearest


def _drawn(
    X: FloatArray,
    start: FloatArray,
    wanted: FloatArray,
    tets: IntArray,
    free: BoolArray,
    pull: FloatArray,
    kappa: float,
    bounds: Bounds,
    strength: float,
    tolerance: float,
    most_steps: int = _MOST_STEPS,
) -> FloatArray:
    """The minimum of `DrawnBody` over the vertices `free` (n,), from `start`; lengths in mm, only their tets count."""
    L0 = bounding_box_diagonal(X)
    seen = free[tets].any(axis=1)
    nodes, local = np.unique(tets[seen], return_inverse=True)
    body = discretise(X[nodes] / L0, local.reshape(-1, 4).astype(np.int64))
    drawn = DrawnBody(body, kappa, np.where(free, pull, 0.0)[nodes], wanted[nodes] / L0, bounds, strength)
    x = start.copy()
    x[nodes] = L0 * _minimum(drawn, start[nodes] / L0, free[nodes], tolerance, most_steps)
    return np.where(free[:, None], x, start)


def _minimum(drawn: DrawnBody, start: FloatArray, free: BoolArray, tolerance: float, most_steps: int) -> FloatArray:
    pattern = build_pattern(drawn.body.elements, len(start))
    analysis = analyse(pattern.indptr, pattern.indices)
    fixed = np.flatnonzero(np.repeat(~free, 3))
    mask = dirichlet_mask(pattern, fixed)

    def residual(z: FloatArray) -> Residual:
        x = z.reshape(-1, 3)
        value, g = drawn.value_and_gradient(x)
        r = g.ravel()
        # What holds the part: the springs and the fixed vertices.
        scale = float(np.linalg.norm(drawn.pull[:, None] * (x - drawn.wanted)) + np.linalg.norm(r[fixed]))
        r[fixed] = 0.0
        return Residual(r, max(scale, 1e-6), value)

    def factor(z: FloatArray, spd: bool) -> Factor:
        data = drawn.hessian(z.reshape(-1, 3), pattern, spd)
        mask.apply(data, 1.0)
        return analysis.factor(data)

    found = newton(
        residual, lambda z: factor(z, False), start.ravel(), tolerance, most_steps, lambda z: factor(z, True)
    )
    return found.z.reshape(-1, 3)
