"""What commands print: verdict and reasons first, then the figures, then where the files are."""

from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any

from fab4d.io.cards import card_names, load_material, load_printer, load_rig
from fab4d.report.verdict import print_checks_of
from fab4d.runner.display import duration
from fab4d.runner.job import Job
from fab4d.runner.runner import Selection, plan
from fab4d.runner.workspace import Workspace


def _error_text(error: Mapping[str, float]) -> str:
    kinds = {"rms": "RMS", "max": "max", "hausdorff": "Hausdorff"}
    parts = [f"{label} {error[f'{name}_mm']:.3g} mm ({error[f'{name}_rel']:.1e})" for name, label in kinds.items()]
    return ", ".join(parts)


def _cost(projection: Mapping[str, Any]) -> str:
    if not projection["surface_vertices_moved"]:
        return "as wanted, its inside relaxed anew"
    return f"RMS {projection['rms_mm']:.3g} mm, max {projection['max_mm']:.3g} mm from the wanted one"


def _change_text(change: Mapping[str, Any]) -> str:
    linear, quadratic = max(change["linear_N"]), max(change["quadratic_N"])
    return f"the largest {linear:.3g} N in linear elements, {quadratic:.3g} N in quadratic ones at the same positions"


def _uncertainty_text(uncertainty: Mapping[str, Any]) -> str:
    return f"+- {max(uncertainty['N']):.2g} N ({100 * uncertainty['largest']:.0f} %) by {uncertainty['method']}"


_FIGURES: Mapping[str, tuple[str, Callable[[Any], str]]] = {
    "target_displacement_mm": ("to move", lambda value: f"{value:.3g} mm"),
    "target_projection": ("nearest", lambda value: f"the nearest shape that the part can take: {_cost(value)}"),
    "error": ("error", _error_text),
    "smp_fraction": ("SMP", lambda value: f"{100 * value:.1f} % of the volume"),
    "forces": ("forces", lambda value: f"{value} points"),
    "force_change": ("", _change_text),
    "force_uncertainty": ("", _uncertainty_text),
    "picked": ("picked", lambda row: f"row {row['id']} of the tradeoff"),
    "mass_g": ("mass", lambda value: f"{value:.3g} g"),
    "cost_usd": ("cost", lambda value: f"{value:.2f} USD"),
    "wall_s": ("time", duration),
    "peak_rss_mb": ("memory", lambda value: f"{value:.0f} MB"),
}
_STEPS = {
    "clusters": "small clusters",
    "features": "thin places",
    "well_composed": "edges and points that would not hold",
    "larger_features": "corners that lines leave empty",
}
_FILES = {
    "report_html": "read this first",
    "rig_sheet": "take this to the rig",
    "forces_csv": "its forces and positions",
    "smp_stl": "SMP body",
    "tpe_stl": "TPE body",
    "part_3mf": "both bodies for PrusaSlicer",
    "part_orca_3mf": "both for OrcaSlicer, Bambu Studio, Cura",
    "print_places": "where it may not print well",
    "design_vtu": "the verified state",
    "error_vs_time": "error against run time",
    "report_json": "all figures",
}


def report_lines(report: Mapping[str, Any]) -> list[str]:
    """Verdict, reasons and figures of a report.json; a figure that the scene does not have is left out."""
    figures = [(*_FIGURES[name], report[name]) for name in _FIGURES if report.get(name) is not None]
    return [
        str(report["verdict"]),
        *(f"  - {reason}" for reason in report["reasons"]),
        *(f"  {label:<8} {form(value)}" for label, form, value in figures),
        *(f"  {line}" for line in finding_lines(report.get("findings", []))),
        *warning_lines(report.get("printing", {})),
    ]


def warning_lines(report: Mapping[str, Any]) -> list[str]:
    """The `checks` of a report about printing that do not hold."""
    failed = [check for check in print_checks_of(report) if not check.passed]
    return [f"  warning: {check.reason}" for check in failed]


def body_lines(report: Mapping[str, Any]) -> list[str]:
    """Each body of bodies_report with volume, mass, filament and price, the purge, and the warnings."""
    lines = [
        f"  {name.upper()}: tool {body['extruder']}, {body['volume_mm3'] / 1000:.3g} cm^3, {body['mass_g']:.3g} g, "
        f"{body['filament_m']:.3g} m of filament, {body['cost_usd']:.2f} USD"
        for name, body in report["bodies"].items()
    ]
    lines += [
        f"  {name.upper()} enclosed in the other material: {pocket['count']} places, {pocket['volume_mm3']:.3g} mm^3"
        for name, pocket in report["pockets"].items()
        if pocket["count"]
    ]
    purge = report["purge"]
    if "labels" in report:
        changed = report["labels"]["changed_fraction"]
        steps = [f"{words} {100 * changed[step]:.2g} %" for step, words in _STEPS.items() if changed[step] > 0]
        total = f"  labels changed to print: {100 * changed['total']:.2g} % of the volume"
        lines.append("; ".join([total, *steps]))
    lines.append(f"  purge: {purge['tool_changes']} changes of tool, about {purge['volume_mm3'] / 1000:.3g} cm^3")
    return [*finding_lines(report.get("findings", [])), *lines, *warning_lines(report)]


def slice_lines(report: Mapping[str, Any]) -> list[str]:
    """What a test slice lays down for each body, its time, and the warnings."""
    lines = [f"sliced with {report['slicer']}:"]
    for name, body in report["bodies"].items():
        lines.append(
            f"  {name.upper()}: tool {body['extruder']}, {body['sliced_mm3'] / 1000:.4g} cm^3 laid down for a body of "
            f"{body['volume_mm3'] / 1000:.4g} cm^3, {body['filament_m']:.3g} m of filament"
        )
    if report["print_time_s"] is not None:
        without = " and ".join(report["print_time_without"])
        lines.append(f"  print time, without {without}: {duration(report['print_time_s'])}")
    return [*lines, *warning_lines(report)]


def unfinished_lines(job: Job, last: str | None) -> list[str]:
    """How far a run went that was asked to stop early, and which files are of an earlier design."""
    waiting = [job.table.stage(step.stage) for step in plan(job, Selection()) if step.state != "current"]
    files = [job.table.artifacts[name] for stage in waiting for name in stage.writes if job.workspace.exists(name)]
    outdated = [f"  out of date, of an earlier run: {', '.join(files)}"] if files else []
    return [f"done up to {last or job.table.names[-1]}", *outdated]


def file_lines(workspace: Workspace) -> list[str]:
    """The files for a person in the run folder; those that exist."""
    paths = [(workspace.artifacts[name], note) for name, note in _FILES.items() if workspace.exists(name)]
    return [f"files in {workspace.root}:", *(f"  {path:<20} {note}" for path, note in paths)]


def finding_lines(findings: Iterable[Mapping[str, Any]]) -> list[str]:
    """The findings of the mesh doctor."""
    return [f"{found['severity']:<8} {found['code']}: {found['message']}" for found in findings]


def doctor_lines(check_report: Mapping[str, Any]) -> list[str]:
    """The findings of the mesh doctor, then the figures of the two shapes."""
    findings = finding_lines(check_report["findings"])
    if check_report["nothing_to_program"]:
        findings.append("nothing to program: the shapes are equal up to a rigid motion")
    statistics = [f"  {name:<22} {value:.6g}" for name, value in check_report["statistics"].items()]
    return [*(findings or ["no findings"]), *statistics]


def card_lines() -> list[str]:
    """Every card that comes with fab4d, with where its figures are from."""
    lines = []
    for kind, load in (("materials", load_material), ("printers", load_printer), ("rigs", load_rig)):
        lines.append(f"{kind}:")
        lines += [f"  {name:<18} {load(name, Path()).source}" for name in card_names(kind)]
    return lines
