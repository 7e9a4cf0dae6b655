"""What `fab4d tradeoff` prints."""

from fab4d.io.csvtable import read_csv
from fab4d.report.tradeoff import COLUMNS, tradeoff_lines
from fab4d.runner.workspace import Workspace


def tradeoff_summary(workspace: Workspace) -> list[str]:
    """The rows of a tradeoff, and what to do with them."""
    path = workspace.path("tradeoff_csv")
    rows = read_csv(workspace.load("tradeoff_csv"), COLUMNS, str(path))
    fine = [row for row in rows if row["acceptable"] == "yes"]
    least = min(fine, key=lambda row: float(row["smp_fraction"]), default=None)
    told = f"the least SMP has row {least['id']}" if least else "no row is acceptable"
    return [
        *tradeoff_lines(rows),
        *workspace.load("tradeoff_report")["without_a_design"],
        f"{told}; make the design of a row with `fab4d run SCENE --pick ROW`",
        f"files: {path}, {workspace.path('tradeoff_plot')}",
    ]
