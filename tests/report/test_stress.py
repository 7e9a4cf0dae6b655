"""Lines of a stress study."""

from typing import Any

from fab4d.io.csvtable import read_csv
from fab4d.report.stress import COLUMNS, stress_csv, stress_lines

SOLVED: dict[str, Any] = {
    "case": "as designed",
    "solved": True,
    "loaded": 1.0,
    "unloaded": 1.0,
    "load_steps": 7,
    "residual_median": 1e-12,
    "residual_final": 3e-11,
    "rounding_median": 2e-13,
    "rounding_final": 4e-12,
    "min_det_F": 0.5,
    "negative_modes": 0,
    "off_rel": 2e-3,
    "tau": 41.7,
}


def lines(**changed: Any) -> list[str]:
    return stress_lines(read_csv(stress_csv([SOLVED | changed]), COLUMNS, "stress.csv"))


def test_a_solved_case_has_its_figures_and_nothing_else() -> None:
    header, row = lines()
    assert row.split() == [
        "as",
        "designed",
        "100",
        "%",
        "100",
        "%",
        "7",
        "3.0e-11",
        "4.0e-12",
        "0.5",
        "0",
        "2.0e-03",
        "42",
    ]
    assert header.split()[0] == "case"


def test_it_is_told_where_a_path_ends() -> None:
    """A singular tangent has no number of unstable ways."""
    _, row = lines(solved=False, loaded=0.25, negative_modes=None)
    assert row.endswith("NOT SOLVED: no equilibrium found farther than loaded by 25 %")
    assert " - " in row
    assert lines(solved=False, unloaded=0.5)[1].endswith("farther than unloaded by 50 %")


def test_it_is_told_what_is_wrong_at_the_end_of_a_path() -> None:
    assert lines(solved=False, residual_median=1e-4)[1].endswith("residual stays at 1.0e-04, the least det F is 0.5")
