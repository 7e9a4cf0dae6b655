"""Stage `judge`: whether the verified design is accepted, before anything that is printed or set up is written."""

from collections.abc import Mapping
from typing import Any

from fab4d.report.metrics import shapes_of
from fab4d.report.verdict import ACCEPTED, REJECTED, checks_of, reasons_of
from fab4d.stages._figures import figures_of, limits_of, printed_labels
from fab4d.stages.monitor import Monitor

REPORTS = ("check_report", "solve_report", "threshold_report", "refit_report", "verify_report", "sensitivity_report")


def run(inputs: Mapping[str, Any], profile: Mapping[str, Any], _monitor: Monitor) -> dict[str, Any]:
    """The verdict and its reasons, so that print files and rig sheet of a rejected design say that it is one."""
    mesh = inputs["mesh"]
    shapes, smp = shapes_of(mesh, inputs["state"]), printed_labels({"mesh": mesh, "labels": inputs["labels"]})
    limits = limits_of(profile["goal"], profile["acceptance"], profile["rig"], shapes)
    checks = checks_of(figures_of(inputs, profile["materials"], shapes, smp), limits)
    reasons = reasons_of(checks, {name: inputs[name] for name in REPORTS})
    return {"verdict_report": {"verdict": REJECTED if reasons else ACCEPTED, "reasons": reasons}}
