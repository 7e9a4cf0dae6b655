"""The verdict: every check with its value, its limit and, when it fails, the reason to print first."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from fab4d.report.wording import plain

ACCEPTED, REJECTED = "ACCEPTED", "REJECTED"
ERROR_CHECK = "RMS error"
LARGEST_RESIDUAL = 1e-8
"""Largest residual of an equilibrium, relative to the largest force."""
DEFAULT_TOLERANCE, DEFAULT_SHARE, LEAST_TOLERANCE = 5e-3, 0.1, 1e-4
"""When the scene states no largest RMS error: parts of the diagonal and of the prescribed displacement, and the part of
the diagonal below which no printer works."""


@dataclass(frozen=True)
class Check:
    """What was checked, what was found and allowed (as words), and whether it holds; a warning rejects no design."""

    name: str
    found: str
    allowed: str
    passed: bool
    warning: bool = False

    @property
    def reason(self) -> str:
        return f"{self.name} is {self.found}, allowed is {self.allowed}"


@dataclass(frozen=True)
class Limits:
    """What a design must keep. tolerance in mm; None: not limited."""

    tolerance: float
    max_forces: int
    max_smp_fraction: float | None
    max_ambiguous_fraction: float
    max_isolated_fraction: float


def default_tolerance(diagonal: float, prescribed: float) -> float:
    """The largest RMS error of a scene that states none.

    diagonal : of the part        prescribed : RMS displacement from the permanent to the temporary shape, same unit
    """
    return max(min(DEFAULT_TOLERANCE * diagonal, DEFAULT_SHARE * prescribed), LEAST_TOLERANCE * diagonal)


def checks_of(figures: Mapping[str, Any], limits: Limits) -> list[Check]:
    """The checks of the figures of report.json; a figure that was not measured (None) is not checked."""
    residual = figures["equilibrium_residual"]
    found = [
        _at_most(ERROR_CHECK, figures["error"]["rms_mm"], limits.tolerance, " mm"),
        _at_most("number of forces", figures["forces"], limits.max_forces),
        _at_most("SMP share of the volume", figures["smp_fraction"], limits.max_smp_fraction),
        _below("share of ambiguous tets", figures["ambiguous_fraction"], limits.max_ambiguous_fraction),
        _below("share of isolated SMP tets", figures["isolated_fraction"], limits.max_isolated_fraction),
        _at_most("equilibrium residual of the median shape", residual["median"], LARGEST_RESIDUAL),
        _at_most("equilibrium residual of the final shape", residual["final"], LARGEST_RESIDUAL),
        _above("smallest det F", figures["min_det_F"], 0.0),
    ]
    return [check for check in found if check is not None]


def print_checks_of(report: Mapping[str, Any]) -> list[Check]:
    """The `checks` about printing that a report holds, as warnings."""
    return [_print_check(item) for item in report.get("checks", [])]


def _print_check(item: Mapping[str, Any]) -> Check:
    unit = f" {item['unit']}" if item.get("unit") else ""
    found = item.get("message", "none") if item["value"] is None else plain(item["value"]) + unit
    place = ", ".join(f"{x:.4g}" for x in item.get("where") or ())
    allowed = f"{item['sense']} {plain(item['limit'])}{unit}" if "limit" in item else ""
    return Check(item["check"], f"{found} at ({place}) mm" if place else found, allowed, item["ok"], warning=True)


def reasons_of(checks: list[Check], reports: Mapping[str, Mapping[str, Any] | None]) -> list[str]:
    """Why the design is rejected: failed checks, then what the stages say, each once; empty when it is accepted."""
    said = [r for report in reports.values() if report for r in report.get("reasons", [])]
    verify = reports.get("verify_report")
    if verify and not verify["reached"]:
        said.insert(0, "the forward simulation from the permanent shape did not reach the designed state")
    failed = [c.reason + _limit_of(c, reports.get("solve_report")) for c in checks if not c.passed]
    return list(dict.fromkeys(failed + said))


def _limit_of(check: Check, solve_report: Mapping[str, Any] | None) -> str:
    """What limits the error, if the solver knows."""
    limited = (solve_report or {}).get("limited_by")
    return f"; limited by {limited}" if limited and check.name == ERROR_CHECK else ""


def left_out_of(reports: Mapping[str, Mapping[str, Any] | None]) -> list[dict[str, str]]:
    """What all stages left out, in their order, each once."""
    items = [item for report in reports.values() if report for item in report.get("left_out", [])]
    return [{"what": what, "why": why} for what, why in dict.fromkeys((i["what"], i["why"]) for i in items)]


def _at_most(name: str, value: float | None, limit: float | None, unit: str = "") -> Check | None:
    if value is None or limit is None:
        return None
    return Check(name, plain(value) + unit, f"at most {plain(limit)}{unit}", value <= limit)


def _below(name: str, value: float | None, limit: float) -> Check | None:
    return None if value is None else Check(name, plain(value), f"below {plain(limit)}", value < limit)


def _above(name: str, value: float | None, limit: float) -> Check | None:
    return None if value is None else Check(name, plain(value), f"above {plain(limit)}", value > limit)
