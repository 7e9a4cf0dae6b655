"""What is ahead of a scene: stages, what is left out, and roughly how long it takes.

`python -m fab4d.runner.outlook RUN...` prints what finished runs took and the laws fitted to them: the constants of
`report.growth`.
"""

import sys
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from fab4d.design.tradeoff import MOST_TRIALS
from fab4d.report.growth import peak_mb, stage_seconds
from fab4d.runner.display import duration
from fab4d.runner.job import Job
from fab4d.runner.runner import Selection, Step, plan
from fab4d.runner.summary import finding_lines
from fab4d.runner.table import stage_table
from fab4d.runner.workspace import Workspace


def plan_lines(job: Job, mesh: Mapping[str, np.ndarray], check_report: Mapping[str, Any]) -> list[str]:
    """Size, stages, what is left out and why, and the expected time and memory, for a person."""
    steps = plan(job, Selection())
    n_tets = len(mesh["tets"])
    return [
        f"{job.scene.name}: {len(mesh['X'])} vertices, {n_tets} tets, {_extent(mesh['X'])}",
        f"run folder: {job.workspace.root}",
        *(f"  {step.stage:<10} {step.state:<8} {step.reason}".rstrip() for step in steps),
        *finding_lines(check_report.get("findings", [])),
        *_left_out_lines(check_report),
        _expectation(steps, n_tets, least_smp=job.scene.goal.smp == "least"),
    ]


def _extent(X: np.ndarray) -> str:
    return " x ".join(f"{side:.3g}" for side in np.ptp(X, axis=0)) + " mm"


def _left_out_lines(check_report: Mapping[str, Any]) -> list[str]:
    left_out = check_report.get("left_out", [])
    return ["left out:", *(f"  {item['what']}: {item['why']}" for item in left_out)] if left_out else []


def _expectation(steps: Sequence[Step], n_tets: int, *, least_smp: bool) -> str:
    ahead = [step.stage for step in steps if step.state != "current"]
    if not ahead:
        return "expected: nothing to do"
    searches = {"solve": MOST_TRIALS} if least_smp else {}
    seconds = sum(searches.get(stage, 1) * stage_seconds(stage, n_tets) for stage in ahead)
    return f"expected, roughly, on two cores: {duration(seconds)}, {peak_mb(n_tets):.0f} MB of memory"


def measured(root: Path) -> dict[str, Any]:
    """Tets, seconds of each stage and peak memory of the finished run in the folder `root`."""
    workspace = Workspace(root, stage_table().artifacts)
    manifests = {name: workspace.manifest(name) for name in stage_table().names}
    finished = {name: manifest for name, manifest in manifests.items() if manifest}
    return {
        "n_tets": len(workspace.load("mesh")["tets"]),
        "seconds": {name: manifest["wall_s"] for name, manifest in finished.items()},
        "peak_mb": max(manifest["peak_rss_mb"] for manifest in finished.values()),
    }


def power_law(sizes: Sequence[float], values: Sequence[float]) -> tuple[float, float]:
    """Value at size 1,000 and power p of value ~ size ** p: least squares of the logarithms."""
    slope, intercept = np.polyfit(np.log(np.asarray(sizes) / 1000), np.log(values), 1)
    return float(np.exp(intercept)), float(slope)


def straight_line(sizes: Sequence[float], values: Sequence[float]) -> tuple[float, float]:
    """Value at size 0 and growth a 1,000: least squares."""
    slope, intercept = np.polyfit(np.asarray(sizes) / 1000, values, 1)
    return float(intercept), float(slope)


def fit_lines(runs: Iterable[Mapping[str, Any]]) -> list[str]:
    """A table of the runs and the constants of `report.growth` fitted to them."""
    runs = sorted(runs, key=lambda run: run["n_tets"])
    sizes = [run["n_tets"] for run in runs]
    names = stage_table().names
    lines = ["tets    " + "".join(f"{name:>11}" for name in names) + "    peak MB"]
    for run in runs:
        seconds = "".join(f"{run['seconds'].get(name, float('nan')):11.2f}" for name in names)
        lines.append(f"{run['n_tets']:<8}{seconds}{run['peak_mb']:11.0f}")
    laws = {name: _law_of(name, runs) for name in names}
    lines += [f'    "{name}": ({seconds:.3g}, {power:.2f}),' for name, (seconds, power) in laws.items()]
    base, slope = straight_line(sizes, [run["peak_mb"] for run in runs])
    return [*lines, f"MEMORY_MB = ({base:.0f}, {slope:.3g})"]


def _law_of(stage: str, runs: Iterable[Mapping[str, Any]]) -> tuple[float, float]:
    """Of the runs in which the stage ran: a run of an earlier version may lack it."""
    timed = [(run["n_tets"], run["seconds"][stage]) for run in runs if stage in run["seconds"]]
    return power_law(*zip(*timed, strict=True))


if __name__ == "__main__":
    print("\n".join(fit_lines(measured(Path(root)) for root in sys.argv[1:])))
