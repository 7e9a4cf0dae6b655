"""What is read back from finished run folders."""

from pathlib import Path

import numpy as np

from fab4d.errors import ArtifactError
from fab4d.io.csvtable import read_csv
from fab4d.mesh.measures import bounding_box_diagonal
from fab4d.report.bench import FinishedRun
from fab4d.runner.table import stage_table
from fab4d.runner.workspace import Workspace


def finished_roots(folder: Path) -> list[Path]:
    """The run folders in `folder` that hold a report, by name. Raises ArtifactError when there is none."""
    report = stage_table().artifacts["report_json"]
    roots = sorted(path.parent for path in folder.glob(f"*/{report}"))
    if not roots:
        msg = f"no finished run in {folder}: make one with `fab4d run SCENE`, or name run folders"
        raise ArtifactError(msg)
    return roots


def finished_run(root: Path) -> FinishedRun:
    """The run in the folder `root`. Raises ArtifactError when it is not finished or a file of it is damaged."""
    workspace = Workspace(root, stage_table().artifacts)
    for name in ("report_json", "mesh"):
        if not workspace.exists(name):
            msg = f"{workspace.path(name)} is missing: finish the run with `fab4d run SCENE --out {root}`"
            raise ArtifactError(msg)
    mesh = workspace.load("mesh")
    tau, rms = _trace(workspace)
    diagonal = bounding_box_diagonal(mesh["X"])
    return FinishedRun(root.resolve().name, len(mesh["tets"]), diagonal, workspace.load("report_json"), tau, rms)


def _trace(workspace: Workspace) -> tuple[np.ndarray, np.ndarray]:
    """Times (tau) and RMS errors (mm) of the accepted iterates; empty where nothing was solved."""
    if not workspace.exists("error_vs_time"):
        return np.zeros(0), np.zeros(0)
    rows = read_csv(workspace.load("error_vs_time"), ("tau", "rms_mm"), str(workspace.path("error_vs_time")))
    return np.array([float(row["tau"]) for row in rows]), np.array([float(row["rms_mm"]) for row in rows])
