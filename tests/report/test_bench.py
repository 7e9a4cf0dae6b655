"""The table and the plot of finished runs."""

import io

import numpy as np
import pytest
from matplotlib.figure import Figure
from PIL import Image

from fab4d.report import bench
from fab4d.report.bench import COLUMNS, FinishedRun, bench_lines, bench_plot


def finished(name: str, n_tets: int, **changes: object) -> FinishedRun:
    report = {
        "verdict": "ACCEPTED",
        "error": {"rms_rel": 2.5e-3, "max_rel": 8e-3},
        "forces": 8,
        "smp_fraction": 0.25,
        "wall_s": 12.0,
        "tau_s": 0.01,
        "peak_rss_mb": 300.4,
        "element_order": 1,
    }
    tau, rms = np.array([10.0, 100.0, 1000.0]), np.array([4.0, 1.0, 0.0])
    return FinishedRun(name, n_tets, 200.0, report | changes, tau, rms)


UNSOLVED = {"error": {"rms_rel": 0.0, "max_rel": 0.0}, "tau_s": None, "element_order": None, "peak_rss_mb": None}


def test_a_row_tells_what_the_report_says() -> None:
    heads, row = (line.split() for line in bench_lines([finished("bar", 1705)]))
    assert " ".join(heads) == " ".join(COLUMNS)
    assert " ".join(row) == "bar 1705 8 2.50e-03 8.00e-03 25.0 % 12.0 s 1200 300 MB 1 ACCEPTED"


def test_runs_are_told_in_the_order_of_their_size_in_columns_of_one_width() -> None:
    lines = bench_lines([finished("a-long-name", 14400), finished("b", 7), finished("c", 800, **UNSOLVED)])
    assert [line.split()[0] for line in lines] == ["scene", "b", "c", "a-long-name"]
    assert len({line.index(line.split()[-1]) for line in lines}) == 1


def test_what_was_not_measured_is_a_dash() -> None:
    row = bench_lines([finished("still", 10, **UNSOLVED)], markdown=True)[-1]
    cells = dict(zip(COLUMNS, (cell.strip() for cell in row.strip("|").split("|")), strict=True))
    assert [name for name, cell in cells.items() if cell == "–"] == ["tau", "memory", "order"]


def test_every_line_of_the_markdown_table_has_all_cells() -> None:
    lines = bench_lines([finished("bar", 1705), finished("still", 10, **UNSOLVED)], markdown=True)
    assert [line.count("|") for line in lines] == [len(COLUMNS) + 1] * 4
    assert set(lines[1]) <= set("|-: ")


def test_a_curve_is_relative_to_the_diagonal_and_ends_in_the_verified_design() -> None:
    axes = Figure().subplots()
    bench._curve(axes, finished("bar", 1705))
    iterates, end = axes.get_lines()
    np.testing.assert_allclose(iterates.get_xydata(), [[10.0, 0.02], [100.0, 0.005]])
    np.testing.assert_allclose(end.get_xydata(), [[1200.0, 2.5e-3]])


@pytest.mark.parametrize("runs", [[finished("bar", 1705), finished("still", 10, **UNSOLVED)]])
def test_the_plot_is_a_picture_and_the_same_each_time(runs: list[FinishedRun]) -> None:
    data = bench_plot(runs)
    assert data == bench_plot(runs)
    assert min(Image.open(io.BytesIO(data)).size) > 400
