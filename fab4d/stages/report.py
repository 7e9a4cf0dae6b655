"""Stage `report`: the verdict with its reasons, the figures, the traces, the verified state and the page."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from fab4d.io.meshes import vtu_bytes
from fab4d.report import metrics
from fab4d.report.growth import growth
from fab4d.report.page import report_page, view_data
from fab4d.report.trace import joined_trace, trace_csv, trace_plot
from fab4d.report.verdict import (
    ACCEPTED,
    REJECTED,
    checks_of,
    left_out_of,
    print_checks_of,
    reasons_of,
)
from fab4d.stages._figures import figures_of, limits_of, printed_labels
from fab4d.stages.monitor import Monitor

REPORTS = (
    "check_report",
    "solve_report",
    "threshold_report",
    "refit_report",
    "verify_report",
    "sensitivity_report",
    "bodies_report",
    "slice_report",
    "rig_report",
)


def run(inputs: Mapping[str, Any], profile: Mapping[str, Any], monitor: Monitor) -> dict[str, Any]:
    """Everything that a person or a program reads about a finished design."""
    monitor.progress("figures")
    mesh, state, smp = inputs["mesh"], inputs["state"], printed_labels(inputs)
    shapes, reports = metrics.shapes_of(mesh, state), {name: inputs[name] for name in REPORTS}
    limits = limits_of(profile["goal"], profile["acceptance"], profile["rig"], shapes)
    figures = figures_of(inputs, profile["materials"], shapes, smp)
    checks = checks_of(figures, limits)
    reasons = reasons_of(checks, reports)
    verdict = REJECTED if reasons else ACCEPTED
    report = {"verdict": verdict, "reasons": reasons} | figures
    report |= {"sensitivity": _sensitivity(reports["sensitivity_report"]), "printing": _printing(reports)}
    report |= _origin(inputs, reports)
    monitor.progress("page", rms_mm=figures["error"]["rms_mm"])
    rows = joined_trace({s: inputs[f"{s}_trace"] for s in ("solve", "refit")}, inputs["run"]["stages"], report["tau_s"])
    plot = trace_plot(rows, limits.tolerance) if rows else None
    view = view_data(shapes, mesh["tets"], smp, mesh["clamp"], state)
    return {
        "report_json": report,
        "error_vs_time": trace_csv(rows) if rows else None,
        "error_plot": plot,
        "design_vtu": _design_vtu(inputs, smp),
        "report_html": report_page(
            profile["name"],
            report,
            [*checks, *print_checks_of(report["printing"])],
            view,
            plot,
            inputs["print_places"],
        ),
    }


def _sensitivity(report: Mapping[str, Any] | None) -> dict[str, Any] | None:
    """The sensitivity report but for what is told with those of other stages; None where it was left out."""
    kept = {key: value for key, value in (report or {}).items() if key not in ("reasons", "left_out")}
    return kept or None


def _printing(reports: Mapping[str, Any]) -> dict[str, Any]:
    """Material and purge as planned, the test slice if there was one, and the checks of both."""
    bodies, sliced = reports["bodies_report"] or {}, reports["slice_report"] or {}
    return {
        "filament_m": {name: body.get("filament_m") for name, body in bodies.get("bodies", {}).items()},
        "purge": bodies.get("purge"),
        "print_time_s": sliced.get("print_time_s"),
        "print_time_without": sliced.get("print_time_without", []),
        "checks": [*bodies.get("checks", []), *sliced.get("checks", [])],
    }


def _findings(check_report: Mapping[str, Any]) -> list[dict[str, str]]:
    """What the mesh doctor found, repaired or advises."""
    return [{key: found[key] for key in ("severity", "code", "message")} for found in check_report["findings"]]


def _origin(inputs: Mapping[str, Any], reports: Mapping[str, Any]) -> dict[str, Any]:
    solve, refit = inputs["solve_report"] or {}, inputs["refit_report"] or {}
    # Of the element that is delivered; without a fit, of the search.
    run, tau_s = inputs["run"], refit.get("tau_s", solve.get("tau_s"))
    stages = [stage | {"tau": stage["wall_s"] / tau_s if tau_s else None} for stage in run["stages"]]
    return {
        "picked": solve.get("picked"),
        "tau_s": tau_s,
        "wall_s": run["wall_s"],
        "peak_rss_mb": run["peak_rss_mb"],
        "findings": _findings(inputs["check_report"]),
        "left_out": left_out_of(reports),
        "stages": stages,
        "growth": growth(len(inputs["mesh"]["tets"]), stages, run["peak_rss_mb"]),
        "versions": run["versions"],
        "inputs": run["inputs"],
    }


def _design_vtu(inputs: Mapping[str, Any], smp: np.ndarray) -> bytes:
    """The verified state as it stands; without one, the part at rest."""
    mesh, labels, relaxed = inputs["mesh"], inputs["labels"], inputs["relaxed"]
    state = inputs["state"] if inputs["state"] is not None else _at_rest(mesh)
    point_data = {
        "median": state["x"],
        "temporary": state["y"],
        "force": state["force"],
        "held": state["held"].astype(np.int64),
        "clamp": state["clamp"].astype(np.int8),
    }
    cell_data = {
        "smp": smp.astype(np.int8),
        "rho": smp.astype(float) if relaxed is None else relaxed["rho"],
        "cluster": smp.astype(np.int64) if labels is None else labels["cluster"].astype(np.int64),
    }
    return vtu_bytes(state["nodes"], state["elements"], point_data, cell_data)


def _at_rest(mesh: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    X, n = mesh["X"], len(mesh["X"])
    still = {"nodes": X, "x": X, "y": X, "elements": mesh["tets"], "clamp": mesh["clamp"]}
    return still | {"force": np.zeros((n, 3)), "held": np.full(n, -1)}
