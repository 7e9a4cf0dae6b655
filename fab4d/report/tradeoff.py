"""The curve of SMP share and cost against error and number of forces: table, plot, and lines for a terminal."""

import io
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from fab4d.design.tradeoff import pareto_front
from fab4d.io.csvtable import csv_bytes
from fab4d.mesh.tetmesh import BoolArray

COLUMNS = (
    "id",
    "points",
    "lam_SMP",
    "smp_fraction",
    "cost_usd",
    "mass_g",
    "rms_mm",
    "rms_rel",
    "max_force_N",
    "acceptable",
    "pareto",
    "tau",
    "reasons",
)
_HEADER = ("row", "points", "SMP", "cost", "RMS error", "largest force", "", "")

Row = Mapping[str, Any]


def on_front(rows: Sequence[Row]) -> BoolArray:
    """(k,) whether a row is acceptable, and no other acceptable one has less SMP and no more error, or the reverse.

    Where no row is acceptable, all that have an equilibrium are compared.
    """
    fine = np.array([row["acceptable"] for row in rows], dtype=bool)
    if not fine.any():
        fine = np.array([row["rms_mm"] is not None for row in rows], dtype=bool)
    share, rms = (np.array([row[name] for row in rows], dtype=np.float64) for name in ("smp_fraction", "rms_mm"))
    front = np.zeros(len(rows), bool)
    front[fine] = pareto_front(share[fine], rms[fine])
    return front


def tradeoff_csv(rows: Sequence[Row]) -> bytes:
    """tradeoff.csv: yes or no for `acceptable` and `pareto`; figures that a row does not have are empty."""
    return csv_bytes(COLUMNS, [_cells(row, bool(front)) for row, front in zip(rows, on_front(rows), strict=True)])


def _cells(row: Row, front: bool) -> dict[str, Any]:
    plain = {name: "" if row[name] is None else row[name] for name in COLUMNS if name in row}
    words = {"acceptable": _yes(row["acceptable"]), "pareto": _yes(front), "reasons": "; ".join(row["reasons"])}
    return plain | words


def tradeoff_lines(rows: Sequence[Mapping[str, str]]) -> list[str]:
    """The rows of tradeoff.csv as a table, with what speaks against those that are not acceptable."""
    table = [_HEADER, *map(_words, rows)]
    widths = [max(len(line[c]) for line in table) for c in range(len(_HEADER) - 1)]
    return ["  ".join([*map(str.rjust, line, widths), line[-1]]).rstrip() for line in table]


def _words(row: Mapping[str, str]) -> tuple[str, ...]:
    rms = f"{float(row['rms_mm']):.3g} mm" if row["rms_mm"] else "-"
    force = f"{float(row['max_force_N']):.3g} N" if row["max_force_N"] else "-"
    share, cost = f"{100 * float(row['smp_fraction']):.1f} %", f"{float(row['cost_usd']):.2f} USD"
    front = "pareto" if row["pareto"] == "yes" else ""
    return row["id"], row["points"], share, cost, rms, force, front, row["reasons"] or "acceptable"


def tradeoff_plot(rows: Sequence[Row], tolerance: float) -> bytes:
    """PNG: RMS error (mm, logarithmic) against SMP share and cost, a line for each number of points.

    Filled: acceptable. Named and ringed: on the Pareto front. tolerance : mm
    """
    figure = Figure(figsize=(9, 5.6), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots()
    rows = sorted((row for row in rows if row["rms_mm"] is not None), key=lambda row: row["smp_fraction"])
    for points in sorted({row["points"] for row in rows}):
        _curve(axes, points, [row for row in rows if row["points"] == points])
    _front(axes, [row for row, front in zip(rows, on_front(rows), strict=True) if front])
    axes.axhline(tolerance, color="0.4", linewidth=0.8)
    axes.annotate("tolerance", (1, tolerance), xycoords=("axes fraction", "data"), ha="right", va="bottom")
    axes.set(yscale="log", xlabel="SMP, % of the volume", ylabel="RMS error as printed, mm")
    axes.margins(x=0.09)
    for formatter in (axes.yaxis.set_major_formatter, axes.yaxis.set_minor_formatter):
        formatter(_tick)
    axes.grid(alpha=0.3, which="both")
    axes.legend(frameon=False, loc="center left", bbox_to_anchor=(1.0, 0.5))
    _cost_axis(axes, rows)
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=110, metadata={"Software": None})
    return buffer.getvalue()


def _tick(value: float, _position: float) -> str:
    return f"{value:.3g}"


def _curve(axes: Any, points: int, rows: Sequence[Row]) -> None:
    share, rms = [100 * row["smp_fraction"] for row in rows], [row["rms_mm"] for row in rows]
    (line,) = axes.plot(share, rms, linewidth=1.1, label=f"{points} points")
    faces = [line.get_color() if row["acceptable"] else "white" for row in rows]
    axes.scatter(share, rms, s=28, c=faces, edgecolors=line.get_color(), zorder=3)


def _front(axes: Any, rows: Sequence[Row]) -> None:
    share, rms = [100 * row["smp_fraction"] for row in rows], [row["rms_mm"] for row in rows]
    axes.scatter(share, rms, s=110, facecolors="none", edgecolors="0.2", linewidths=0.9, zorder=4, label="Pareto front")
    axes.scatter([], [], s=28, c="white", edgecolors="0.2", label="not acceptable")
    for row, x, y in zip(rows, share, rms, strict=True):
        axes.annotate(row["id"], (x, y), xytext=(7, 7), textcoords="offset points", fontsize=8)


def _cost_axis(axes: Any, rows: Sequence[Row]) -> None:
    """The cost over the share, with which it grows linearly; none where all rows have one share."""
    share, cost = (np.array([row[name] for row in rows]) for name in ("smp_fraction", "cost_usd"))
    if len(rows) < 2 or np.ptp(share) == 0 or np.ptp(cost) == 0:
        return
    slope, base = np.polyfit(100 * share, cost, 1)
    upper = axes.secondary_xaxis("top", functions=(lambda s: base + slope * s, lambda c: (c - base) / slope))
    upper.set_xlabel("cost of the material, USD")


def _yes(value: bool) -> str:
    return "yes" if value else "no"
