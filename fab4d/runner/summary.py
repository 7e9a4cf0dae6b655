"""What commands print: verdict and reasons first, then the figures, then where the files are."""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from fab4d.io.cards import card_names, load_material, load_printer, load_rig
from fab4d.runner.display import duration
from fab4d.runner.job import Job
from fab4d.runner.runner import Selection, plan
from fab4d.runner.workspace import Workspace


def _error_text(error: Mapping[str, float]) -> str:
    kinds = {"rms": "RMS", "max": "max", "hausdorff": "Hausdorff"}
    parts = [f"{label} {error[f'{name}_mm']:.3g} mm ({error[f'{name}_rel']:.1e})" for name, label in kinds.items()]
    return ", ".join(parts)


_FIGURES: Mapping[str, tuple[str, Callable[[Any], str]]] = {
    "target_displacement_mm": ("to move", lambda value: f"{value:.3g} mm"),
    "error": ("error", _error_text),
    "smp_fraction": ("SMP", lambda value: f"{100 * value:.1f} % of the volume"),
    "forces": ("forces", lambda value: f"{value} points"),
    "mass_g": ("mass", lambda value: f"{value:.3g} g"),
    "cost_usd": ("cost", lambda value: f"{value:.2f} USD"),
    "wall_s": ("time", duration),
    "peak_rss_mb": ("memory", lambda value: f"{value:.0f} MB"),
}
_FILES = {
    "report_html": "read this first",
    "rig_sheet": "take this to the rig",
    "forces_csv": "its forces and positions",
    "smp_stl": "SMP body",
    "tpe_stl": "TPE body",
    "part_3mf": "both bodies for the slicer",
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
    ]


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


def doctor_lines(check_report: Mapping[str, Any]) -> list[str]:
    """The findings of the mesh doctor, then the figures of the two shapes."""
    findings = [f"{found['severity']:<8} {found['code']}: {found['message']}" for found in check_report["findings"]]
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
