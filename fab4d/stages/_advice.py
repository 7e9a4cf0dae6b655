"""What the check foresees of a scene: the fewest points, the travel it needs, and where the part could be held."""

from typing import Any

import numpy as np

from fab4d.io.cards import RigCard
from fab4d.io.scene import Goal
from fab4d.mesh.doctor import Pair
from fab4d.mesh.findings import Finding, finding
from fab4d.mesh.limbs import limbs
from fab4d.mesh.measures import vertex_areas
from fab4d.mesh.rigid import best_rigid_motion
from fab4d.mesh.rigid_region import most_rigid_box
from fab4d.mesh.tetmesh import BoolArray, FloatArray
from fab4d.mesh.topology import face_table
from fab4d.units import mm_per

_SHORTEST_LIMB = 0.1  # of the diagonal
# A clamp must keep its shape much better than the goal asks of the part, and be worth the hold.
_CLAMP_SHARE_OF_TOLERANCE, _LEAST_SURFACE = 0.2, 0.04


def fewest_points(pair: Pair, clamp: BoolArray, wanted: FloatArray, tolerance: float) -> tuple[int, FloatArray]:
    """The fewest points that can come within `tolerance`, RMS mm, and what each limb costs without one, falling.

    wanted : (n, 3), mm
    A limb on which nothing pulls is free of stress, hot and cold, so it keeps its shape: its distance from the wanted
    one after the best rigid motion stays in the error. A lower bound: limbs that bend several ways need more.
    """
    areas = vertex_areas(pair.X, face_table(pair.tets).boundary)
    limb = limbs(pair.X, pair.tets, clamp, _SHORTEST_LIMB * pair.diagonal)
    costs = np.zeros(int(limb.max()) + 1)
    for k in range(len(costs)):
        on = (limb == k) & (areas > 0)
        if clamp[on].any():
            continue
        R, t = best_rigid_motion(pair.X[on], wanted[on], areas[on])
        squared = np.sum((pair.X[on] @ R.T + t - wanted[on]) ** 2, axis=1)
        costs[k] = np.sqrt(areas[on] @ squared / areas.sum())
    costs = -np.sort(-costs)
    left = np.sqrt(np.cumsum(costs[::-1] ** 2))[::-1]
    return int(np.count_nonzero(left > tolerance)), costs


def point_findings(
    pair: Pair, fewest: int, costs: FloatArray, tolerance: float, goal: Goal, rig: RigCard
) -> list[Finding]:
    """A warning when the scene allows fewer points than its limbs need; fewest, costs are of `fewest_points`."""
    allowed = rig.max_points if goal.max_forces is None else min(goal.max_forces, rig.max_points)
    if fewest <= allowed:
        return []
    message = (
        f"{fewest} limbs change their own shape, and each needs a point: with {allowed} the error stays above "
        f"{np.sqrt(np.sum(costs[allowed:] ** 2)):.3g} mm RMS, but the goal's tolerance is {tolerance:.3g} mm: allow "
        f"{fewest} points at least, choose a rig that has them, or bend fewer limbs"
    )
    return [finding("too-few-points", "warning", pair.files[1], message)]


def travel_findings(pair: Pair, clamp: BoolArray, rig: RigCard) -> list[Finding]:
    """A warning when the surface moves farther than the rig does. A part without a clamp is moved to the best place."""
    if rig.max_travel is None:
        return []
    on = np.unique(face_table(pair.tets).boundary)
    R, t = (np.eye(3), np.zeros(3)) if clamp.any() else best_rigid_motion(pair.X[on], pair.X_temp[on])
    moved = np.linalg.norm(pair.X[on] @ R.T + t - pair.X_temp[on], axis=1)
    far = on[moved > rig.max_travel]
    if not len(far):
        return []
    message = (
        f"{len(far)} vertices of the surface move farther than the {rig.max_travel:g} mm of the rig "
        f'"{rig.name}" (up to {moved.max():.3g} mm at vertex {pair.vertex_map[on[np.argmax(moved)]]}): no point '
        "near there can be held; clamp the part elsewhere, or deform it less"
    )
    return [finding("travel", "warning", pair.files[1], message, pair.vertex_map[far])]


def suggested_clamp(pair: Pair, tolerance: float, units: str) -> dict[str, Any] | None:
    """A box that could be held where the scene has no clamp, None where nothing moves as one.

    Returns `box` in the scene's units, `surface_share`, and `residual_mm`, how far its surface is from moving as one.
    """
    faces = face_table(pair.tets).boundary
    allowed = _CLAMP_SHARE_OF_TOLERANCE * tolerance
    found = most_rigid_box(pair.X, pair.X_temp, pair.tets, faces, allowed, _LEAST_SURFACE)
    if found is None:
        return None
    step = 10.0 ** np.floor(np.log10(1e-4 * pair.diagonal))
    low, high = step * np.floor(found.low / step), step * np.ceil(found.high / step)
    mm = mm_per(units)
    box = [[float(f"{value / mm:.6g}") for value in corner] for corner in (low, high)]
    return {"box": box, "surface_share": found.share, "residual_mm": found.residual}


def clamp_findings(pair: Pair, suggested: dict[str, Any] | None) -> list[Finding]:
    """The suggested clamp as text to paste into the scene."""
    if suggested is None:
        return []
    message = (
        "the scene has no clamp, so the forces must balance each other; "
        f"{suggested['surface_share']:.0%} of the surface moves as one to within {suggested['residual_mm']:.2g} mm and "
        f"could be held instead of pulled. In the scene:\n[[rig.clamp]]\nbox = {suggested['box']}"
    )
    return [finding("suggested-clamp", "hint", pair.files[0], message)]
