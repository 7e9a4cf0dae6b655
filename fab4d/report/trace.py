"""Error against run time over all stages: the table and its plot."""

import io
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from fab4d.io.csvtable import TRACE_COLUMNS, csv_bytes, read_csv

WORDS = ("solver", "phase")

Row = dict[str, Any]


def joined_trace(
    traces: Mapping[str, bytes | None], stages: Sequence[Mapping[str, Any]], tau_s: float | None
) -> list[Row]:
    """The rows of the traces of some stages, with times from the start of the run, all in the same tau.

    traces : stage -> CSV, times counted from the start of the stage
    stages : `stages` of the artifact `run`: name and wall_s, in the order of the work
    tau_s : seconds of one factorisation; None where nothing was factorised
    """
    rows: list[Row] = []
    for stage, data in traces.items():
        if data is not None:
            rows += _shifted(read_csv(data, TRACE_COLUMNS, f"{stage} trace"), _start(stage, stages), tau_s)
    return rows


def trace_csv(rows: list[Row]) -> bytes:
    """error-vs-time.csv."""
    return csv_bytes(TRACE_COLUMNS, rows)


def trace_plot(rows: list[Row], tolerance: float) -> bytes:
    """PNG: errors (mm, logarithmic) with the tolerance (mm), below it SMP share and ambiguous share, over run time."""
    figure = Figure(figsize=(9, 5.4), layout="constrained")
    FigureCanvasAgg(figure)
    upper, lower = figure.subplots(2, 1, sharex=True, height_ratios=[2.4, 1])
    t = _column(rows, "wall_s")
    for name, label, style in (("rms_mm", "RMS", "-"), ("max_mm", "maximum", "--"), ("hausdorff_mm", "Hausdorff", ":")):
        values = _column(rows, name)
        upper.plot(t, np.where(values > 0, values, np.nan), style, label=label, marker=".", markersize=3, linewidth=1.3)
    upper.axhline(tolerance, color="0.4", linewidth=0.8)
    upper.annotate("tolerance (RMS)", (1, tolerance), xycoords=("axes fraction", "data"), ha="right", va="bottom")
    upper.set(yscale="log", ylabel="error, mm")
    upper.grid(alpha=0.3, which="both")
    upper.legend(loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=3, frameon=False)
    lower.plot(t, _column(rows, "smp_fraction"), label="SMP share", color="#0096a5")
    lower.plot(t, _column(rows, "ambiguous_fraction"), label="ambiguous share", color="#b06000")
    lower.set(xlabel="run time, s", ylim=(0, 1))
    lower.grid(alpha=0.3)
    lower.legend(loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=2, frameon=False)
    _phases(upper, rows)
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=110, metadata={"Software": None})
    return buffer.getvalue()


def _start(stage: str, stages: Sequence[Mapping[str, Any]]) -> float:
    """Seconds from the start of the run to the start of a stage: what the stages before it took."""
    names = [s["name"] for s in stages]
    before = names.index(stage) if stage in names else len(names)
    return float(sum(s["wall_s"] for s in stages[:before]))


def _shifted(rows: list[dict[str, str]], start: float, tau_s: float | None) -> list[Row]:
    numbers: list[Row] = [
        {name: row[name] if name in WORDS else float(row[name]) for name in TRACE_COLUMNS} for row in rows
    ]
    for row in numbers:
        row["wall_s"] += start
        row["tau"] = row["wall_s"] / tau_s if tau_s else 0.0
        row["forces"] = int(row["forces"])
    return numbers


def _column(rows: list[Row], name: str) -> np.ndarray:
    return np.array([row[name] for row in rows], dtype=np.float64)


def _phases(axes: Any, rows: list[Row]) -> None:
    """A line and the name where each phase begins; a name that would touch the one before it is left out."""
    span = rows[-1]["wall_s"] - rows[0]["wall_s"] if rows else 0.0
    last, phase = -np.inf, None
    for row in rows:
        if row["phase"] == phase:
            continue
        phase = row["phase"]
        axes.axvline(row["wall_s"], color="0.8", linewidth=0.8, zorder=0)
        if row["wall_s"] - last > 0.03 * span:
            last = row["wall_s"]
            style = {"rotation": 90, "fontsize": 7, "color": "0.35", "va": "bottom"}
            axes.annotate(phase, (last, 0.02), xycoords=("data", "axes fraction"), **style)
