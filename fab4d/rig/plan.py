"""All that stands on the rig sheet, as data."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from fab4d.materials.cards import MaterialCard
from fab4d.mesh.tetmesh import FloatArray, IntArray
from fab4d.mesh.topology import face_table
from fab4d.mesh.walls import COARSE_SHARE, FEWEST_ELEMENTS, walls
from fab4d.rig.checks import CaliperChecks, caliper_checks
from fab4d.rig.clamp import Clamp, clamp_of, corner_mark
from fab4d.rig.points import LoadPoints, load_points
from fab4d.rig.schedule import Step, schedule, thickness

# Ratio of computed to true flexibility of a bent bar by linear tets across its thickness: model.md section 5.
LINEAR_FLEXIBILITY = ((1.0, 0.15), (2.0, 0.37), (4.0, 0.67), (8.0, 0.87))
# The same by quadratic tets.
QUADRATIC_FLEXIBILITY = ((1.0, 0.93), (2.0, 0.97), (8.0, 1.0))

# A part without opposite walls has no number of elements across them.
MOST_COUNTED = 100.0


@dataclass(frozen=True, eq=False)
class ForceTrust:
    """How far the forces are to be trusted.

    elements_across : elements that span the thinnest walls        thin_share : share of the walls' area that fewer than
    two span, around `thin_place` (3,), mm        least_fraction : least true force over the computed one
    uncertainty : (K,) N, that of each force by `method`; None where it was left out
    """

    element_order: int
    elements_across: float
    least_fraction: float
    thin_share: float
    thin_place: FloatArray
    uncertainty: FloatArray | None
    method: str


@dataclass(frozen=True, eq=False)
class RigPlan:
    """Points, clamp, mark, schedule and checks. `mark_position` (3,) is on the permanent shape, mm; `wall` in mm."""

    points: LoadPoints
    clamp: Clamp | None
    mark_vertex: int
    mark_position: FloatArray
    wall: float
    steps: tuple[Step, ...]
    checks: CaliperChecks
    trust: ForceTrust
    left_out: tuple[dict[str, str], ...]


def rig_plan(
    state: Mapping[str, np.ndarray], card: MaterialCard, uncertainty: Mapping[str, Any] | None = None
) -> RigPlan:
    """The plan for a verified state with the `force_uncertainty` of its report (pipeline/README.md)."""
    X, tets = state["nodes"], state["elements"][:, :4]
    faces = face_table(tets).boundary
    points, clamp = load_points(state), clamp_of(state, faces)
    wall = thickness(X, tets, faces)
    mark = corner_mark(X, state["clamp"], faces)
    return RigPlan(
        points=points,
        clamp=clamp,
        mark_vertex=mark,
        mark_position=X[mark],
        wall=wall,
        steps=schedule(card, wall, clamp is not None),
        checks=caliper_checks(X, state["x"], state["y"], faces, np.append(points.vertex, mark)),
        trust=force_trust(X, state["elements"], uncertainty),
        left_out=_left_out(clamp),
    )


def force_trust(X: FloatArray, elements: IntArray, uncertainty: Mapping[str, Any] | None = None) -> ForceTrust:
    """Trust in forces from elements (m, 4 or 10) by their number across the thinnest walls: model.md section 5."""
    order = 1 if elements.shape[1] == 4 else 2
    tets = elements[:, :4]
    found = walls(X[: int(tets.max()) + 1], tets)
    across = min(found.fewest(COARSE_SHARE), MOST_COUNTED)
    counts, ratios = np.array(LINEAR_FLEXIBILITY if order == 1 else QUADRATIC_FLEXIBILITY).T
    return ForceTrust(
        element_order=order,
        elements_across=across,
        least_fraction=float(np.interp(across, counts, ratios)),
        thin_share=found.thin_share(FEWEST_ELEMENTS),
        thin_place=found.thinnest_place(X),
        uncertainty=None if uncertainty is None else np.array(uncertainty["N"]),
        method="" if uncertainty is None else uncertainty["method"],
    )


def limit_reasons(points: LoadPoints, max_force: float, max_points: int, pull_only: bool) -> list[str]:
    """Why a rig with these limits cannot apply the forces; empty when it can."""
    reasons = []
    if points.count > max_points:
        reasons.append(f"{points.count} points, but the rig has {max_points}")
    over = np.flatnonzero(points.size > max_force * (1 + 1e-6))
    if len(over):
        worst = int(over[np.argmax(points.size[over])])
        reasons.append(f"point {worst + 1} needs {points.size[worst]:.4g} N, but the rig gives {max_force:.4g} N")
    if pull_only and points.pushes.any():
        names = ", ".join(str(k + 1) for k in np.flatnonzero(points.pushes))
        reasons.append(f"the rig only pulls, but the force at point {names} points into the surface")
    return reasons


def plan_summary(plan: RigPlan, reasons: list[str]) -> dict[str, Any]:
    """The plan as the rig report: plain numbers, lengths in mm, forces in N, moments in N mm."""
    points, checks, trust, clamp = plan.points, plan.checks, plan.trust, plan.clamp
    return {
        "points": points.count,
        "largest_force_N": float(points.size.max()),
        "force_sum_N": points.force.sum(axis=0).tolist(),
        "clamp": None if clamp is None else _clamp_summary(clamp),
        "mark": {"vertex": plan.mark_vertex, "position_mm": plan.mark_position.tolist()},
        "wall_mm": plan.wall,
        "force_trust": {
            "element_order": trust.element_order,
            "elements_across": trust.elements_across,
            "least_fraction": trust.least_fraction,
            "thin_share": trust.thin_share,
            "thin_place_mm": trust.thin_place.tolist(),
            "uncertainty_N": None if trust.uncertainty is None else trust.uncertainty.tolist(),
            "method": trust.method,
        },
        "schedule": [_step_summary(step) for step in plan.steps],
        "checks": [
            {"vertices": v.tolist(), "permanent_mm": float(a), "median_mm": float(b), "final_mm": float(c)}
            for v, a, b, c in zip(checks.vertices, checks.permanent, checks.median, checks.final, strict=True)
        ],
        "reasons": reasons,
        "left_out": list(plan.left_out),
    }


def _clamp_summary(clamp: Clamp) -> dict[str, Any]:
    return {
        "box_mm": [clamp.lower.tolist(), clamp.upper.tolist()],
        "area_mm2": clamp.area,
        "force_N": clamp.force.tolist(),
        "force_sum_N": float(np.linalg.norm(clamp.force)),
        "moment_Nmm": clamp.moment.tolist(),
        "about_mm": clamp.center.tolist(),
    }


def _step_summary(step: Step) -> dict[str, Any]:
    times = {time.bath: time.minutes for time in step.times}
    return {"name": step.name, "bath_K": step.bath_temperature, "core_K": step.core_temperature, "minutes": times}


def _left_out(clamp: Clamp | None) -> tuple[dict[str, str], ...]:
    missing = [] if clamp is not None else [("clamp", "the scene has none: the forces balance each other")]
    missing += [
        ("weight of the part and buoyancy in the bath", "the part is taken as weightless"),
        ("friction of cables and pads", "the forces are those on the part, not those at the actuator"),
        ("collisions", "cables, pads and the part are not kept apart"),
    ]
    return tuple({"what": what, "why": why} for what, why in missing)
