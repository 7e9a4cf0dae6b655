"""Stages are found by name, and kernels that cannot be kept are explained."""

import subprocess
import sys
from pathlib import Path

import pytest

from fab4d.errors import ArtifactError
from fab4d.runner.job import stage_function

MODULE = """
import numba
@numba.njit(cache=True)
def kernel(x):
    return x
"""


@pytest.mark.skipif(sys.platform == "win32", reason="no /dev/null there")
def test_numba_without_a_folder_for_its_cache_is_explained(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The message is recognised by numba's own words, so they come from numba here."""
    (tmp_path / "kernels.py").write_text(MODULE)
    (tmp_path / "__pycache__").write_text("a file, so that no folder can be made")
    environment = {"HOME": "/dev/null", "PATH": "", "PYTHONPATH": str(tmp_path)}
    code = [sys.executable, "-c", "import kernels"]
    said = subprocess.run(code, env=environment, capture_output=True, text=True, check=False).stderr.splitlines()[-1]
    assert said.startswith("RuntimeError: ")

    def import_module(_name: str) -> None:
        raise RuntimeError(said)

    monkeypatch.setattr("importlib.import_module", import_module)
    with pytest.raises(ArtifactError, match="NUMBA_CACHE_DIR"):
        stage_function("check")


def test_other_errors_of_a_stage_module_pass(monkeypatch: pytest.MonkeyPatch) -> None:
    def import_module(_name: str) -> None:
        msg = "kernel failed"
        raise RuntimeError(msg)

    monkeypatch.setattr("importlib.import_module", import_module)
    with pytest.raises(RuntimeError, match="kernel failed"):
        stage_function("check")
