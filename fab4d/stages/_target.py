"""What the check makes of the wanted shape: held where the clamp is, and reachable by an elastic part."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from fab4d.elasticity.projection import Bounds
from fab4d.elasticity.untangle import Tell
from fab4d.materials.cards import MaterialCard
from fab4d.mesh.distance import aligned
from fab4d.mesh.doctor import Pair, wanted_clamp
from fab4d.mesh.findings import Finding, finding, named
from fab4d.mesh.grid import FINEST_STEP
from fab4d.mesh.interpolation import shape_path
from fab4d.mesh.measures import vertex_areas
from fab4d.mesh.rigid import best_rigid_motion
from fab4d.mesh.tetmesh import BoolArray, FloatArray, IntArray
from fab4d.mesh.topology import face_table
from fab4d.stages._projection import Measured, measured, nearest_within, relaxed_inside, share_of_volume

SMALLEST_DET_F = 0.1
"""Squeezed to less of its volume, a tet counts as one that no solid follows."""
_HOPELESS = 0.5  # of the volume beyond the bounds
_MOST_NAMED = 5


@dataclass(frozen=True, eq=False)
class Target:
    """The pair with its reachable temporary shape, what was found, and what the projection costs.

    wanted : (n, 3) the temporary shape that was asked for, mm, where it is not that of the pair; else None
    projection : report.json's `target_projection`; None where nothing was projected
    """

    pair: Pair
    findings: list[Finding]
    wanted: FloatArray | None = None
    projection: dict[str, Any] | None = None


def reachable_target(pair: Pair, clamp: BoolArray, materials: MaterialCard, tolerance: float, tell: Tell) -> Target:
    """Put the temporary shape to the clamp, and project it where an elastic part cannot take it.

    Only the surface is wanted: an inside that is inverted, squeezed or stretched too far is relaxed anew. Where the
    surface itself asks too much, it moves as little as it must; an error when that is more than `tolerance`, RMS mm.
    tell : is told of each attempt at that, for it may take long
    """
    pair, findings = _at_the_clamp(pair, clamp)
    wanted = pair.X_temp
    held = np.where(clamp[:, None], pair.X, wanted)
    bounds = Bounds(SMALLEST_DET_F, max(materials.smp_max_stretch, materials.tpe_max_stretch))
    before = measured(pair.X, held, pair.tets)
    if before.beyond(bounds).any():
        x, error = _projected(pair, held, clamp, materials, bounds, tell)
        if error:
            return Target(pair, [*findings, error])
        return _judged(pair, x, clamp, before, bounds, tolerance, findings)
    if _clamp_differs(pair, clamp):
        return _judged(pair, held, clamp, before, bounds, tolerance, findings)
    as_read = np.abs(held - wanted).max() <= 2 * FINEST_STEP
    return Target(pair if as_read else replace(pair, X_temp=held), findings)


def _projected(
    pair: Pair, held: FloatArray, clamp: BoolArray, materials: MaterialCard, bounds: Bounds, tell: Tell
) -> tuple[FloatArray, Finding | None]:
    """`held` (n, 3) with its inside relaxed and, if it must be, its surface moved to within the bounds, or why not."""
    kappa = materials.tpe.kappa / materials.tpe.mu
    surface = np.zeros(len(pair.X), bool)
    surface[face_table(pair.tets).boundary] = True
    x = relaxed_inside(pair.X, held, pair.tets, surface | clamp, kappa, bounds, tell)
    relaxed = measured(pair.X, x, pair.tets)
    beyond = relaxed.beyond(bounds)
    if not beyond.any():
        return x, None
    where, limits = pair.tet_map[beyond], _limits(pair, relaxed, bounds)
    if share_of_volume(pair.X, pair.tets, beyond) > _HOPELESS:
        middle = f"median det F {np.median(relaxed.det):.3g}, median stretch {np.median(relaxed.stretch):.3g}"
        message = f"{limits}, most of the part ({middle}); {_within(pair, x, clamp, bounds)}"
        return x, finding("unreachable", "error", pair.files[1], message, where)
    x = nearest_within(pair.X, x, pair.tets, clamp, kappa, bounds, tell)
    left = measured(pair.X, x, pair.tets)
    if not left.beyond(bounds).any():
        return x, None
    message = (
        f"{limits}, and no shape near it keeps within these limits (at {_distances(pair, held, x)[1]:.3g} mm RMS still "
        f"{_limits(pair, left, bounds)}): deform the mesh less, or in smaller steps"
    )
    return x, finding("unreachable", "error", pair.files[1], message, where)


def _within(pair: Pair, x: FloatArray, clamp: BoolArray, bounds: Bounds) -> str:
    """How much of the deformation to x is within the bounds, and how far from x that ends; for a message."""
    if measured(pair.X, x, pair.tets).det.min() <= 0:
        return "ask for a smaller deformation, or correct the shape"
    path, within = shape_path(pair.X, x, pair.tets, clamp), 0.0
    for step in 0.5 ** np.arange(1, 8):
        if not measured(pair.X, path.at(within + step), pair.tets).beyond(bounds).any():
            within += step
    rms = _distances(pair, x, path.at(within))[1]
    return f"{within:.0%} of the deformation is within this, and ends {rms:.3g} mm RMS off: ask for less"


def _at_the_clamp(pair: Pair, clamp: BoolArray) -> tuple[Pair, list[Finding]]:
    """The temporary shape moved rigidly to where its clamp is that of the permanent one, for the rig does not move."""
    held = wanted_clamp(pair, clamp)
    off = float(np.abs(pair.X_temp[held] - pair.X[held]).max()) if clamp.any() else 0.0
    if off <= 2 * FINEST_STEP:
        return pair, []
    R, t = best_rigid_motion(pair.X_temp[held], pair.X[held])
    message = (
        f"its clamp region lies up to {off:.3g} mm off that of {pair.files[0]}: moved rigidly to where the rig holds it"
    )
    moved = replace(pair, X_temp=pair.X_temp @ R.T + t)
    return moved, [finding("moved", "repaired", pair.files[1], message)]


def _clamp_differs(pair: Pair, clamp: BoolArray) -> float:
    """How far the surface of the clamp is from its place, mm; 0 within rounding."""
    held = wanted_clamp(pair, clamp)
    off = float(np.linalg.norm((pair.X_temp - pair.X)[held], axis=1).max(initial=0.0))
    return off if off > 2 * np.sqrt(3) * FINEST_STEP else 0.0


def _judged(
    pair: Pair,
    x: FloatArray,
    clamp: BoolArray,
    before: Measured,
    bounds: Bounds,
    tolerance: float,
    findings: list[Finding],
) -> Target:
    """The pair with the temporary shape x, and how far that is from the wanted one."""
    wanted = pair.X_temp
    distance, rms = _distances(pair, wanted, x)
    worst = np.argsort(-distance, kind="stable")[:_MOST_NAMED]
    worst = worst[distance[worst] > 0.0]
    after = measured(pair.X, x, pair.tets)
    projection = {
        "rms_mm": rms,
        "max_mm": float(distance.max()),
        "rms_rel": rms / pair.diagonal,
        "max_rel": float(distance.max()) / pair.diagonal,
        "surface_vertices_moved": int(np.count_nonzero(distance)),
        "moved_most": [{"vertex": int(pair.vertex_map[v]), "mm": float(distance[v])} for v in worst],
        "why": _why(pair, clamp, before, bounds),
        "min_det_F": {"before": float(before.det.min()), "after": float(after.det.min())},
        "max_stretch": {"before": float(before.stretch.max()), "after": float(after.stretch.max())},
    }
    told = _told(pair, projection, pair.vertex_map[worst], tolerance)
    return Target(replace(pair, X_temp=x), [*findings, told], wanted if worst.size else None, projection)


def _distances(pair: Pair, wanted: FloatArray, x: FloatArray) -> tuple[FloatArray, float]:
    """(n,) how far surface vertices of x moved from the wanted ones, mm, 0 inside; the RMS after rigid alignment."""
    faces = face_table(pair.tets).boundary
    on, areas = np.unique(faces), vertex_areas(pair.X, faces)
    distance = np.zeros(len(x))
    distance[on] = np.linalg.norm(x[on] - wanted[on], axis=1)
    if not distance.any():
        return distance, 0.0
    squared = np.sum((aligned(x, wanted, on, areas[on])[on] - wanted[on]) ** 2, axis=1)
    return distance, float(np.sqrt(areas[on] @ squared / areas.sum()))


def _why(pair: Pair, clamp: BoolArray, before: Measured, bounds: Bounds) -> list[str]:
    off = _clamp_differs(pair, clamp)
    clamped = [f"the clamp region differs by up to {off:.3g} mm"] if off else []
    return clamped + ([_limits(pair, before, bounds)] if before.beyond(bounds).any() else [])


def _limits(pair: Pair, found: Measured, bounds: Bounds) -> str:
    """What of the shape is beyond the bounds, for a message."""
    inverted = found.det <= 0
    squeezed = ~inverted & (found.det < bounds.smallest_det)
    torn = ~inverted & (found.stretch > bounds.largest_stretch)
    squeeze = f"squeezed to less than {bounds.smallest_det:g} of their volume"
    tear = f"stretched beyond the {bounds.largest_stretch:g} that the materials bear"
    said = []
    for chosen, what, worst in (
        (inverted, "inverted", f"det F from {found.det.min():.3g}"),
        (squeezed, squeeze, f"det F from {found.det[squeezed].min(initial=1.0):.3g}"),
        (torn, tear, f"up to {found.stretch[torn].max(initial=1.0):.3g}"),
    ):
        if chosen.any():
            said.append(f"{chosen.sum()} tets are {what} ({named('tet', pair.tet_map[chosen])}, {worst})")
    return ", ".join(said)


def _told(pair: Pair, projection: dict[str, Any], worst: IntArray, tolerance: float) -> Finding:
    why = ", ".join(projection["why"])
    if not len(worst):
        message = f"{why}: the inside is relaxed anew, the surface stays"
        return finding("inside", "repaired", pair.files[1], message)
    cost = (
        f"{projection['rms_mm']:.3g} mm RMS away ({projection['rms_rel']:.1e} of the diagonal), up to "
        f"{projection['max_mm']:.3g} mm at {named('vertex', worst)}"
    )
    if projection["rms_mm"] > tolerance:
        message = (
            f"{why}: the nearest shape that the part can take is {cost}, but the goal's tolerance is "
            f"{tolerance:.3g} mm: correct the shape there, deform it less, or allow a larger tolerance"
        )
        return finding("unreachable", "error", pair.files[1], message, worst)
    message = f"{why}: projected to the nearest shape that the part can take, {cost}"
    return finding("projected", "repaired", pair.files[1], message, worst)
