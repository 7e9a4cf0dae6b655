"""Files of the run folder: whole or not there, equal values as equal bytes, one run at a time."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from fab4d.errors import ArtifactError
from fab4d.runner.codecs import decode, encode
from fab4d.runner.workspace import Workspace

ARTIFACTS = {"arrays": "work/arrays.npz", "report": "report.json", "body": "print/body.stl"}
KINDS = st.sampled_from([np.float64, np.int64, np.bool_, np.dtype("U5")])
ARRAYS = st.dictionaries(st.from_regex(r"[a-z_]{1,8}", fullmatch=True), hnp.arrays(KINDS, hnp.array_shapes(min_side=0)))


@given(ARRAYS)
def test_arrays_survive_the_round_trip(arrays: dict[str, np.ndarray]) -> None:
    back = decode(".npz", encode(".npz", arrays))
    assert back.keys() == arrays.keys()
    for name, array in arrays.items():
        assert back[name].dtype == array.dtype
        np.testing.assert_array_equal(back[name], array)


@given(ARRAYS)
def test_equal_arrays_give_equal_bytes(arrays: dict[str, np.ndarray]) -> None:
    reversed_copy = {name: arrays[name].copy() for name in reversed(arrays)}
    assert encode(".npz", arrays) == encode(".npz", reversed_copy)


def test_reports_take_numpy_numbers_and_keep_their_order() -> None:
    data = encode(".json", {"verdict": "ACCEPTED", "error": np.float64(0.5), "at": np.array([1, 2])})
    assert data.decode().startswith('{\n  "verdict"')
    assert json.loads(data) == {"verdict": "ACCEPTED", "error": 0.5, "at": [1, 2]}


@pytest.mark.parametrize(
    ("suffix", "value"),
    [(".json", {"a": float("nan")}), (".json", {"a": object()}), (".csv", "text"), (".npz", {"a": np.array([None])})],
)
def test_what_a_form_cannot_hold_is_refused(suffix: str, value: Any) -> None:
    with pytest.raises((TypeError, ValueError)):
        encode(suffix, value)


def test_a_stage_with_one_unfit_artifact_writes_none(tmp_path: Path) -> None:
    space = Workspace(tmp_path, ARTIFACTS)
    with pytest.raises(TypeError, match="expected bytes") as caught:
        space.save({"report": {"a": 1}, "body": "no bytes"})
    assert "print/body.stl" in caught.value.__notes__[0]
    assert list(tmp_path.rglob("*")) == []


def test_an_interrupted_write_leaves_no_partial_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    space = Workspace(tmp_path, ARTIFACTS)
    space.save({"report": {"a": 1}, "body": b"old"})
    original = Path.write_bytes

    def disk_full(path: Path, data: bytes) -> int:
        if "body" in path.name:
            original(path, data[:1])
            msg = "no space left on device"
            raise OSError(msg)
        return original(path, data)

    monkeypatch.setattr(Path, "write_bytes", disk_full)
    with pytest.raises(OSError, match="no space"):
        space.save({"report": {"a": 2}, "body": b"new"})
    assert space.load("report") == {"a": 1}
    assert space.load("body") == b"old"
    assert not list(tmp_path.rglob("*.writing"))


def test_none_removes_the_file_and_a_left_over_partial_one(tmp_path: Path) -> None:
    space = Workspace(tmp_path, ARTIFACTS)
    space.save({"body": b"old"})
    (tmp_path / "print/body.stl.writing").write_bytes(b"o")
    space.save({"body": None})
    assert list((tmp_path / "print").iterdir()) == []
    assert space.digest("body") is None


@pytest.mark.parametrize("artifact", ["arrays", "report"])
def test_a_cut_file_is_an_error_that_names_it(tmp_path: Path, artifact: str) -> None:
    space = Workspace(tmp_path, ARTIFACTS)
    space.save({"arrays": {"X": np.ones((9, 3))}, "report": {"a": 1}})
    path = space.path(artifact)
    path.write_bytes(path.read_bytes()[:-5])
    with pytest.raises(ArtifactError, match=path.name):
        space.load(artifact)


def test_two_runs_do_not_share_a_folder(tmp_path: Path) -> None:
    space = Workspace(tmp_path / "run", ARTIFACTS)
    with space.locked(), pytest.raises(ArtifactError, match="in use"), Workspace(space.root, ARTIFACTS).locked():
        pass
    with space.locked():
        pass


def test_a_folder_with_other_files_is_refused(tmp_path: Path) -> None:
    (tmp_path / "thesis.pdf").write_bytes(b"mine")
    with pytest.raises(ArtifactError, match="no run of fab4d"), Workspace(tmp_path, ARTIFACTS).locked():
        pass
    with pytest.raises(ArtifactError, match="is a file"), Workspace(tmp_path / "thesis.pdf", ARTIFACTS).locked():
        pass
    assert [path.name for path in tmp_path.iterdir()] == ["thesis.pdf"]


def test_the_lock_of_a_killed_run_binds_nobody(tmp_path: Path) -> None:
    (tmp_path / "work").mkdir()
    (tmp_path / "work/lock").write_bytes(b"")
    with Workspace(tmp_path, ARTIFACTS).locked():
        pass
