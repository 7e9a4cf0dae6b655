"""The command that writes the samples."""

import runpy
import sys
from pathlib import Path

import pytest

MAKE = Path(__file__).parents[2] / "samples" / "make.py"


def run(monkeypatch: pytest.MonkeyPatch, *args: str) -> None:
    monkeypatch.setattr(sys, "argv", [str(MAKE), *args])
    runpy.run_path(str(MAKE), run_name="__main__")


def test_same_input_same_bytes(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    for folder in ("one", "two"):
        run(monkeypatch, "strip", "--out", str(tmp_path / folder))
    names = sorted(file.name for file in (tmp_path / "one" / "strip").iterdir())
    assert names == ["perm.vtu", "scene.toml", "temp.vtu"]
    for name in names:
        assert (tmp_path / "one/strip" / name).read_bytes() == (tmp_path / "two/strip" / name).read_bytes()


def test_an_unknown_sample_is_refused(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit, match="2"):
        run(monkeypatch, "stirp", "--out", str(tmp_path))
    assert "no sample 'stirp'; there are strip" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())
