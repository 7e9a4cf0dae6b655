"""Error against run time of finished runs: one table, one plot.

Times are also told in tau, the time of one factorisation on the machine of the run, which busy or slow machines share.
"""

import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

COLUMNS = (
    "scene",
    "tets",
    "points",
    "RMS error",
    "max error",
    "SMP",
    "time",
    "tau",
    "memory",
    "order",
    "verdict",
)


@dataclass(frozen=True, eq=False)
class FinishedRun:
    """One run: its name, number of tets, diagonal L0 of the permanent shape (mm), report.json, and the times (tau) and
    RMS errors (mm) of its accepted iterates, each (k,)."""

    name: str
    n_tets: int
    diagonal: float
    report: Mapping[str, Any]
    tau: np.ndarray
    rms: np.ndarray

    @property
    def wall_tau(self) -> float | None:
        """Run time in factorisations; None where nothing was factorised."""
        tau_s = self.report["tau_s"]
        return self.report["wall_s"] / tau_s if tau_s else None


def bench_lines(runs: Sequence[FinishedRun], markdown: bool = False) -> list[str]:
    """The runs, smallest first, as a table for a terminal or in Markdown; errors are relative to L0."""
    rows = [COLUMNS, *(_cells(run) for run in sorted(runs, key=lambda run: run.n_tets))]
    if markdown:
        rows.insert(1, ("---",) + ("---:",) * (len(COLUMNS) - 2) + ("---",))
        return [f"| {' | '.join(row)} |" for row in rows]
    widths = [max(len(row[c]) for row in rows) for c in range(len(COLUMNS))]
    return ["  ".join(_aligned(row, widths)).rstrip() for row in rows]


def _cells(run: FinishedRun) -> tuple[str, ...]:
    report, error = run.report, run.report["error"]
    return (
        run.name,
        str(run.n_tets),
        str(report["forces"]),
        f"{error['rms_rel']:.2e}",
        f"{error['max_rel']:.2e}",
        f"{100 * report['smp_fraction']:.1f} %",
        f"{report['wall_s']:.1f} s",
        "–" if run.wall_tau is None else f"{run.wall_tau:.0f}",
        "–" if report["peak_rss_mb"] is None else f"{report['peak_rss_mb']:.0f} MB",
        "–" if report["element_order"] is None else str(report["element_order"]),
        report["verdict"],
    )


def _aligned(row: Sequence[str], widths: Sequence[int]) -> list[str]:
    """Words to the left, numbers to the right."""
    first, *numbers, last = row
    return [first.ljust(widths[0]), *(n.rjust(w) for n, w in zip(numbers, widths[1:-1], strict=True)), last]


def bench_plot(runs: Sequence[FinishedRun]) -> bytes:
    """PNG, both axes logarithmic: RMS error relative to L0 of each accepted iterate over time in tau.

    The dot at the end of a curve is the verified design at the end of the run.
    """
    figure = Figure(figsize=(8, 5), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots()
    for run in sorted(runs, key=lambda run: run.n_tets):
        _curve(axes, run)
    axes.set(xscale="log", yscale="log", xlabel="run time, factorisations (tau)", ylabel="RMS error / L0")
    axes.grid(alpha=0.3, which="both")
    axes.legend(frameon=False, loc="center left", bbox_to_anchor=(1.0, 0.5))
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=110, metadata={"Software": None})
    return buffer.getvalue()


def _curve(axes: Any, run: FinishedRun) -> None:
    """The iterates of one run and its verified end; zeros, which have no logarithm, are left out."""
    shown = (run.rms > 0) & (run.tau > 0)
    (line,) = axes.plot(run.tau[shown], run.rms[shown] / run.diagonal, linewidth=1.2, label=run.name)
    if run.wall_tau is not None and run.report["error"]["rms_rel"] > 0:
        axes.plot([run.wall_tau], [run.report["error"]["rms_rel"]], "o", color=line.get_color())
