"""What `fab4d stress` prints."""

from fab4d.io.csvtable import read_csv
from fab4d.report.stress import COLUMNS, stress_lines
from fab4d.runner.workspace import Workspace


def stress_summary(workspace: Workspace) -> list[str]:
    """The cases of a stress study, and how many are solved."""
    path, report = workspace.path("stress_csv"), workspace.load("stress_report")
    rows = read_csv(workspace.load("stress_csv"), COLUMNS, str(path))
    largest = report["largest_residual"]
    worst = "" if largest is None else f", the largest residual of these is {largest:.1e}"
    return [*stress_lines(rows), f"solved {report['solved']} of {report['cases']} cases{worst}", f"file: {path}"]
