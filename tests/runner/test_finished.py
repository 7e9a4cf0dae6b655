"""Finished run folders, read back."""

from pathlib import Path

import numpy as np
import pytest

from fab4d.errors import ArtifactError
from fab4d.runner.finished import finished_roots, finished_run
from fab4d.runner.table import stage_table
from fab4d.runner.workspace import Workspace

MESH = {"X": np.array([[0.0, 0, 0], [3, 0, 0], [0, 4, 0], [0, 0, 12]]), "tets": np.array([[0, 1, 2, 3]])}
TRACE = b"solver,phase,tau,rms_mm\nreduced,start,5.5,2.25\nreduced,refit,7,0.5\n"


def made(root: Path, **artifacts: object) -> Path:
    Workspace(root, stage_table().artifacts).save(artifacts)
    return root


def test_a_run_is_read_from_its_files(tmp_path: Path) -> None:
    run = finished_run(made(tmp_path / "bar", mesh=MESH, report_json={"verdict": "ACCEPTED"}, error_vs_time=TRACE))
    assert (run.name, run.n_tets, run.diagonal, run.report) == ("bar", 1, 13.0, {"verdict": "ACCEPTED"})
    np.testing.assert_array_equal(run.tau, [5.5, 7.0])
    np.testing.assert_array_equal(run.rms, [2.25, 0.5])


def test_a_run_without_a_solver_has_no_curve(tmp_path: Path) -> None:
    run = finished_run(made(tmp_path / "still", mesh=MESH, report_json={}, error_vs_time=None))
    assert len(run.tau) == len(run.rms) == 0


@pytest.mark.parametrize("missing", ["mesh", "report_json"])
def test_an_unfinished_run_is_named_with_what_it_lacks(tmp_path: Path, missing: str) -> None:
    made(tmp_path, **{name: value for name, value in {"mesh": MESH, "report_json": {}}.items() if name != missing})
    with pytest.raises(ArtifactError, match=stage_table().artifacts[missing]):
        finished_run(tmp_path)


def test_a_curve_without_its_columns_names_its_file(tmp_path: Path) -> None:
    made(tmp_path, mesh=MESH, report_json={}, error_vs_time=b"tau\n1\n")
    with pytest.raises(ArtifactError, match=r"error-vs-time\.csv: no column rms_mm"):
        finished_run(tmp_path)


def test_finished_runs_are_found_by_their_report(tmp_path: Path) -> None:
    with pytest.raises(ArtifactError, match="no finished run"):
        finished_roots(tmp_path)
    for name in ("b", "a"):
        made(tmp_path / name, report_json={})
    made(tmp_path / "unfinished", mesh=MESH)
    assert [root.name for root in finished_roots(tmp_path)] == ["a", "b"]
