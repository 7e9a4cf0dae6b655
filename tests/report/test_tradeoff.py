"""The curve of SMP share against error: what is on its front, its table and its plot."""

import csv
import io
from typing import Any

import numpy as np
from PIL import Image

from fab4d.report.tradeoff import COLUMNS, on_front, tradeoff_csv, tradeoff_lines, tradeoff_plot


def row(points: int, price: float, share: float, rms: float | None, reasons: tuple[str, ...] = ()) -> dict[str, Any]:
    return {
        "id": f"{points}x{price:g}",
        "points": points,
        "lam_SMP": 0.05 * price,
        "smp_fraction": share,
        "cost_usd": 1 + 9 * share,
        "mass_g": 10.0,
        "rms_mm": rms,
        "rms_rel": None if rms is None else rms / 90,
        "max_force_N": None if rms is None else 120.0,
        "acceptable": not reasons,
        "reasons": list(reasons),
        "tau": 900.0,
    }


ROWS = [
    row(4, 1, 0.45, 0.30),
    row(4, 2, 0.27, 0.29),
    row(4, 4, 0.10, 0.55, ("the error is 0.55 mm RMS, 0.5 mm are allowed",)),
    row(6, 1, 0.50, 0.12),
    row(6, 8, 0.04, None, ("the printed labels have no equilibrium near the design",)),
]


def test_only_acceptable_rows_are_on_the_front_where_there_are_some() -> None:
    np.testing.assert_array_equal(on_front(ROWS), [False, True, False, True, False])


def test_without_an_acceptable_row_those_with_an_equilibrium_are_compared() -> None:
    np.testing.assert_array_equal(on_front([ROWS[2], ROWS[4]]), [True, False])


def test_the_table_reads_back_as_it_was() -> None:
    read = list(csv.DictReader(io.StringIO(tradeoff_csv(ROWS).decode())))
    assert tuple(read[0]) == COLUMNS
    for told, meant in zip(read, ROWS, strict=True):
        for name in ("smp_fraction", "cost_usd", "mass_g", "rms_mm", "rms_rel", "max_force_N", "lam_SMP", "tau"):
            assert (float(told[name]) if told[name] else None) == meant[name]
        assert (told["id"], told["acceptable"] == "yes") == (meant["id"], meant["acceptable"])
        assert told["reasons"] == "; ".join(meant["reasons"])


def test_the_lines_say_what_speaks_against_a_row() -> None:
    read = list(csv.DictReader(io.StringIO(tradeoff_csv(ROWS).decode())))
    lines = tradeoff_lines(read)
    assert len(lines) == 1 + len(ROWS)
    assert all(("pareto" in line) == (line.split()[0] in ("4x2", "6x1")) for line in lines[1:])
    assert lines[3].endswith("0.5 mm are allowed")
    assert lines[1].endswith("acceptable")


def test_the_plot_shows_the_rows_and_moves_with_them() -> None:
    def picture(rows: list[dict[str, Any]]) -> np.ndarray:
        return np.asarray(Image.open(io.BytesIO(tradeoff_plot(rows, 0.5))).convert("L"))

    assert picture(ROWS).std() > 5
    np.testing.assert_array_equal(picture(ROWS), picture(list(reversed(ROWS))))
    assert (picture(ROWS) != picture([*ROWS[:-2], row(6, 1, 0.50, 0.2)])).any()
    assert picture(ROWS[:1]).shape == picture(ROWS).shape  # one share alone has no axis of cost
