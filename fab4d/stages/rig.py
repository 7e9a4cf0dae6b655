"""Stage `rig`: from the verified state to what a person sets up."""

from collections.abc import Mapping
from typing import Any

from fab4d.io.csvtable import csv_bytes
from fab4d.mesh.topology import face_table
from fab4d.report.sheet import rig_sheet
from fab4d.report.views import Figure
from fab4d.rig.clamp import clamped_faces
from fab4d.rig.plan import limit_reasons, plan_summary, rig_plan
from fab4d.rig.table import FORCE_COLUMNS, force_rows
from fab4d.stages.monitor import Monitor


def run(inputs: Mapping[str, Any], profile: Mapping[str, Any], monitor: Monitor) -> dict[str, Any]:
    """Rig sheet, force table and their figures; no sheet where nothing is to be programmed."""
    state = inputs["state"]
    if state is None or len(state["patch_center"]) == 0:
        return _nothing_to_set_up()
    monitor.progress("plan")
    plan = rig_plan(state, profile["materials"], inputs["verify_report"]["force_uncertainty"])
    rig = profile["rig"]
    reasons = limit_reasons(plan.points, rig.max_force, rig.max_points, rig.pull_only)
    monitor.progress("sheet", forces=plan.points.count)
    rows = force_rows(plan.points, inputs["mesh"]["vertex_map"], plan.trust.uncertainty)
    return {
        "rig_sheet": rig_sheet(
            profile["name"],
            plan,
            _figure(state, inputs["labels"]),
            reasons,
            inputs["sensitivity_report"],
            inputs["verdict_report"]["reasons"],
            profile["printer"].up,
        ),
        "forces_csv": csv_bytes(FORCE_COLUMNS, rows),
        "rig_report": plan_summary(plan, reasons),
    }


def _nothing_to_set_up() -> dict[str, Any]:
    why = "no point carries a force: there is nothing to program"
    report = {"points": 0, "reasons": [], "left_out": [{"what": "rig sheet and force table", "why": why}]}
    return {"rig_sheet": None, "forces_csv": None, "rig_report": report}


def _figure(state: Mapping[str, Any], labels: Mapping[str, Any]) -> Figure:
    corners = state["elements"][:, :4]
    outer = face_table(corners).boundary
    return Figure(
        X=state["nodes"],
        x=state["x"],
        outer=outer,
        smp=face_table(corners[labels["smp"]]).boundary,
        clamp=clamped_faces(state, outer),
    )
