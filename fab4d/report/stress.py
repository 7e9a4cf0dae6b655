"""What a stress study found: table, and lines for a terminal."""

from collections.abc import Mapping, Sequence
from typing import Any

from fab4d.io.csvtable import csv_bytes

COLUMNS = (
    "case",
    "solved",
    "loaded",
    "unloaded",
    "load_steps",
    "residual_median",
    "residual_final",
    "rounding_median",
    "rounding_final",
    "min_det_F",
    "negative_modes",
    "off_rel",
    "tau",
)
SHAPES = ("median", "final")
_HEADER = ("case", "loaded", "unloaded", "steps", "residual", "rounding", "min det F", "unstable", "off", "tau", "")


def stress_csv(rows: Sequence[Mapping[str, Any]]) -> bytes:
    """stress.csv: yes or no for `solved`; figures that a row does not have are empty."""
    return csv_bytes(COLUMNS, [_cells(row) for row in rows])


def _cells(row: Mapping[str, Any]) -> dict[str, Any]:
    plain = {name: "" if value is None else value for name, value in row.items()}
    return plain | {"solved": "yes" if row["solved"] else "no"}


def stress_lines(rows: Sequence[Mapping[str, str]]) -> list[str]:
    """The rows of stress.csv as a table."""
    table = [_HEADER, *map(_words, rows)]
    widths = [max(len(line[c]) for line in table) for c in range(len(_HEADER) - 1)]
    aligned = [[line[0].ljust(widths[0]), *map(str.rjust, line[1:-1], widths[1:]), line[-1]] for line in table]
    return ["  ".join(line).rstrip() for line in aligned]


def _words(row: Mapping[str, str]) -> tuple[str, ...]:
    residual, rounding = (max(float(row[f"{what}_{shape}"]) for shape in SHAPES) for what in ("residual", "rounding"))
    return (
        row["case"],
        f"{100 * float(row['loaded']):.3g} %",
        f"{100 * float(row['unloaded']):.3g} %",
        row["load_steps"],
        f"{residual:.1e}",
        f"{rounding:.1e}",
        f"{float(row['min_det_F']):.3g}",
        row["negative_modes"] or "-",
        f"{float(row['off_rel']):.1e}",
        f"{float(row['tau']):.0f}",
        _trouble(row, residual),
    )


def _trouble(row: Mapping[str, str], residual: float) -> str:
    if row["solved"] == "yes":
        return ""
    for way in ("loaded", "unloaded"):
        if float(row[way]) < 1:
            return f"NOT SOLVED: no equilibrium found farther than {way} by {100 * float(row[way]):.3g} %"
    return f"NOT SOLVED: the residual stays at {residual:.1e}, the least det F is {float(row['min_det_F']):.3g}"
