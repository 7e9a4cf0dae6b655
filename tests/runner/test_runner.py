"""Order, skipping, resuming, and that the table cannot lie."""

import os
import signal
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest

from fab4d.errors import ArtifactError, InterruptedRunError, MeshError
from fab4d.runner.display import SilentDisplay
from fab4d.runner.job import UndeclaredError
from fab4d.runner.runner import Selection, execute, plan

ALL = ["scale", "add", "tell"]


def run(job: Any, **selection: Any) -> list[str]:
    return execute(job, Selection(**selection), SilentDisplay())


def contents(folder: Path) -> dict[str, bytes]:
    """What stages wrote: every file but the runner's own, which hold times."""
    own = {"manifests", "checkpoints", "lock"}
    files = [path for path in folder.rglob("*") if path.is_file() and not own & set(path.parts)]
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in files}


def test_runs_in_order_and_writes_what_the_stages_return(toy: ModuleType, tmp_path: Path) -> None:
    assert run(toy.job(tmp_path)) == ALL
    assert (tmp_path / "run/out/text.txt").read_text() == "toy: 20.0 from numbers.txt, 2 bytes extra\n"
    assert (tmp_path / "run/out/extra.bin").read_bytes() == b"\x00\xff"


def test_current_stages_are_skipped(toy: ModuleType, tmp_path: Path) -> None:
    calls: list[str] = []
    run(toy.job(tmp_path, calls=calls))
    assert run(toy.job(tmp_path, calls=calls)) == []
    assert calls == ALL


@pytest.mark.parametrize(
    ("scene", "expected"),
    [({"factor": 3.0}, ALL), ({"with_extra": False}, ["add", "tell"]), ({"name": "other"}, ["tell"])],
)
def test_a_changed_profile_value_runs_what_depends_on_it(
    toy: ModuleType, tmp_path: Path, scene: dict[str, Any], expected: list[str]
) -> None:
    run(toy.job(tmp_path))
    if "factor" in scene:
        scene = {"factor": toy.Card(scene["factor"])}
    assert run(toy.job(tmp_path, toy.ToyScene(**scene))) == expected


def test_stops_early_when_an_output_comes_out_equal(toy: ModuleType, tmp_path: Path) -> None:
    run(toy.job(tmp_path))
    (tmp_path / "numbers.txt").write_text("4 3 2 1")  # another array of the same sum
    job = toy.job(tmp_path)
    assert [step.state for step in plan(job, Selection())] == ["runs", "may run", "runs"]
    assert run(job) == ALL
    (tmp_path / "run/work/scaled.npz").unlink()
    assert [step.state for step in plan(job, Selection())] == ["runs", "may run", "may run"]
    assert run(job) == ["scale"]


def test_a_stage_of_a_new_version_runs_again(toy: ModuleType, tmp_path: Path) -> None:
    run(toy.job(tmp_path))
    newer = toy.table(tmp_path, toy.TABLE.replace("version = 1", "version = 2", 1))
    assert plan(toy.job(tmp_path, stages=newer), Selection())[0].reason == "the stage is now version 2"
    assert run(toy.job(tmp_path, stages=newer)) == ["scale"]


def test_another_fab4d_runs_everything_again(toy: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    run(toy.job(tmp_path))
    monkeypatch.setattr("fab4d.runner.fingerprint.__version__", "99.0")
    assert run(toy.job(tmp_path)) == ALL


def test_a_hand_edited_artifact_is_made_again(toy: ModuleType, tmp_path: Path) -> None:
    run(toy.job(tmp_path))
    before = contents(tmp_path / "run")
    (tmp_path / "run/work/total.json").write_text('{"total": 7}')
    assert plan(toy.job(tmp_path), Selection())[1].reason == "total changed or removed by hand"
    assert run(toy.job(tmp_path)) == ["add"]
    assert contents(tmp_path / "run") == before


def test_from_takes_a_hand_edited_artifact_as_it_is(toy: ModuleType, tmp_path: Path) -> None:
    run(toy.job(tmp_path))
    (tmp_path / "run/work/total.json").write_text('{"total": 7}')
    assert run(toy.job(tmp_path), first="tell") == ["tell"]
    assert (tmp_path / "run/out/text.txt").read_text().startswith("toy: 7 from")


def test_from_and_until_bound_what_runs(toy: ModuleType, tmp_path: Path) -> None:
    assert run(toy.job(tmp_path), last="add") == ["scale", "add"]
    assert run(toy.job(tmp_path), first="add") == ["tell"]
    assert run(toy.job(tmp_path), forced=frozenset({"add"})) == ["add"]


def test_from_without_what_it_starts_from_names_the_stage_to_run(toy: ModuleType, tmp_path: Path) -> None:
    with pytest.raises(ArtifactError, match=r"total\.json is missing.* run from add"):
        run(toy.job(tmp_path), first="tell")


def test_a_damaged_artifact_is_named(toy: ModuleType, tmp_path: Path) -> None:
    run(toy.job(tmp_path))
    (tmp_path / "run/work/scaled.npz").write_bytes(b"no archive")
    with pytest.raises(ArtifactError, match=r"scaled\.npz is damaged"):
        run(toy.job(tmp_path), first="add")


def test_an_artifact_that_lacks_an_array_is_named_with_the_stage_to_run(toy: ModuleType, tmp_path: Path) -> None:
    run(toy.job(tmp_path))
    np.savez(tmp_path / "run/work/scaled.npz", other=np.zeros(2))
    with pytest.raises(ArtifactError, match=r'scaled\.npz has no "values": .* run from scale on'):
        run(toy.job(tmp_path), first="add")


def test_an_artifact_that_is_no_longer_needed_is_removed(toy: ModuleType, tmp_path: Path) -> None:
    run(toy.job(tmp_path))
    assert run(toy.job(tmp_path, toy.ToyScene(with_extra=False))) == ["add", "tell"]
    assert not (tmp_path / "run/out/extra.bin").exists()
    assert "no extra" in (tmp_path / "run/out/text.txt").read_text()
    assert run(toy.job(tmp_path, toy.ToyScene(with_extra=False))) == []


def test_an_artifact_put_where_none_belongs_is_noticed(toy: ModuleType, tmp_path: Path) -> None:
    bare = toy.job(tmp_path, toy.ToyScene(with_extra=False))
    run(bare)
    (tmp_path / "run/out/extra.bin").write_bytes(b"mine")
    assert run(bare) == ["add"]
    assert not (tmp_path / "run/out/extra.bin").exists()


@pytest.mark.skipif(sys.platform == "win32", reason="SIGKILL is not there on Windows")
@pytest.mark.parametrize("stage", ALL)
def test_resumes_after_a_kill(toy: ModuleType, tmp_path: Path, stage: str) -> None:
    killed, whole = tmp_path / "killed", tmp_path / "whole"
    killed.mkdir()
    whole.mkdir()
    script = [sys.executable, Path(toy.__file__), killed, stage]
    with subprocess.Popen(script, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        assert process.stdout.readline().strip() == stage  # it is in the middle of that stage
        process.kill()
    assert process.returncode == -signal.SIGKILL

    restored: list[Any] = []

    def resumed(inputs: Mapping[str, Any], profile: Mapping[str, Any], monitor: Any) -> Any:
        restored.append(monitor.restore("half"))
        return getattr(toy, stage)(inputs, profile, monitor)

    assert run(toy.job(killed, **{stage: resumed})) == ALL[ALL.index(stage) :]
    run(toy.job(whole))
    assert contents(killed / "run") == contents(whole / "run")
    assert restored[0]["values"].tolist() == [0.0, 1.0, 2.0]
    assert not (killed / "run/work/checkpoints" / stage).exists()


def interrupt_after_saving(_inputs: Any, _profile: Any, monitor: Any) -> Any:
    monitor.save("half", {"values": np.ones(2)})
    raise KeyboardInterrupt


def test_ctrl_c_keeps_the_checkpoint_and_says_how_to_go_on(toy: ModuleType, tmp_path: Path) -> None:
    with pytest.raises(InterruptedRunError, match=r"stopped in add.*same command again"):
        run(toy.job(tmp_path, add=interrupt_after_saving))
    assert (tmp_path / "run/work/checkpoints/add/half.npz").exists()
    assert run(toy.job(tmp_path)) == ["add", "tell"]


@pytest.mark.parametrize(("cause", "told"), [(KeyboardInterrupt(), InterruptedRunError), (None, SystemError)])
def test_ctrl_c_in_compiled_code_stops_a_run_too(
    toy: ModuleType, tmp_path: Path, cause: BaseException | None, told: type[Exception]
) -> None:
    def compiled(*_args: Any) -> Any:
        raise SystemError from cause

    with pytest.raises(told):
        run(toy.job(tmp_path, scale=compiled))


def test_sigterm_stops_a_run_as_ctrl_c_does(toy: ModuleType, tmp_path: Path) -> None:
    def killed(*_args: Any) -> Any:
        os.kill(os.getpid(), signal.SIGTERM)

    before = signal.getsignal(signal.SIGTERM)
    with pytest.raises(InterruptedRunError, match="stopped in scale"):
        run(toy.job(tmp_path, scale=killed))
    assert signal.getsignal(signal.SIGTERM) is before


def test_a_checkpoint_of_other_inputs_is_not_restored(toy: ModuleType, tmp_path: Path) -> None:
    with pytest.raises(InterruptedRunError):
        run(toy.job(tmp_path, add=interrupt_after_saving))
    restored: list[Any] = []

    def resumed(inputs: Mapping[str, Any], profile: Mapping[str, Any], monitor: Any) -> Any:
        restored.append(monitor.restore("half"))
        return toy.add(inputs, profile, monitor)

    run(toy.job(tmp_path, toy.ToyScene(with_extra=False), add=resumed))
    assert restored == [None]


def test_time_spent_before_a_checkpoint_counts(toy: ModuleType, tmp_path: Path) -> None:
    with pytest.raises(InterruptedRunError):
        run(toy.job(tmp_path, add=interrupt_after_saving))
    mark = tmp_path / "run/work/checkpoints/add/key.json"
    mark.write_text(mark.read_text().replace('"spent_s": 0.', '"spent_s": 1000.'))
    job = toy.job(tmp_path)
    run(job)
    assert job.workspace.manifest("add")["wall_s"] >= 1000.0
    assert job.workspace.manifest("tell")["wall_s"] < 100.0


def test_forcing_a_stage_forgets_its_checkpoint(toy: ModuleType, tmp_path: Path) -> None:
    with pytest.raises(InterruptedRunError):
        run(toy.job(tmp_path, add=interrupt_after_saving))
    restored: list[Any] = []

    def resumed(inputs: Mapping[str, Any], profile: Mapping[str, Any], monitor: Any) -> Any:
        restored.append(monitor.restore("half"))
        return toy.add(inputs, profile, monitor)

    run(toy.job(tmp_path, add=resumed), forced=frozenset(ALL))
    assert restored == [None]


def test_a_failing_stage_leaves_earlier_ones_current(toy: ModuleType, tmp_path: Path) -> None:
    def failing(*_args: Any) -> Any:
        msg = "no equilibrium"
        raise RuntimeError(msg)

    with pytest.raises(RuntimeError, match="no equilibrium"):
        run(toy.job(tmp_path, add=failing))
    assert run(toy.job(tmp_path)) == ["add", "tell"]


def test_reading_what_is_not_declared_is_an_error(toy: ModuleType, tmp_path: Path) -> None:
    with pytest.raises(UndeclaredError, match='stage add does not declare "permanent"'):
        run(toy.job(tmp_path, add=lambda inputs, _profile, _monitor: inputs.get("permanent")))


def test_an_undeclared_profile_key_is_an_error(toy: ModuleType, tmp_path: Path) -> None:
    with pytest.raises(UndeclaredError, match='profile of stage scale does not declare "name"'):
        run(toy.job(tmp_path, scale=lambda _inputs, profile, _monitor: profile["name"]))


@pytest.mark.parametrize("results", [{}, {"scaled": {}, "total": {}}])
def test_returning_other_artifacts_than_declared_is_an_error(
    toy: ModuleType, tmp_path: Path, results: dict[str, Any]
) -> None:
    with pytest.raises(UndeclaredError, match="stage scale returned"):
        run(toy.job(tmp_path, scale=lambda *_: results))
    assert not (tmp_path / "run/work/scaled.npz").exists()


def test_a_profile_key_that_the_scene_lacks_is_an_error(toy: ModuleType, tmp_path: Path) -> None:
    stages = toy.table(tmp_path, toy.TABLE.replace('"factor"', '"colour"'))
    with pytest.raises(UndeclaredError, match="colour"):
        run(toy.job(tmp_path, stages=stages))


def test_a_missing_input_file_is_named(toy: ModuleType, tmp_path: Path) -> None:
    job = toy.job(tmp_path)
    (tmp_path / "numbers.txt").unlink()
    with pytest.raises(MeshError, match=r"numbers\.txt: no such file"):
        run(job)


def test_the_other_file_of_a_two_file_format_counts(toy: ModuleType, tmp_path: Path) -> None:
    source = tmp_path / "shape.ele"
    source.write_text("1 2 3 4")
    (tmp_path / "shape.node").write_text("a")
    job = toy.job(tmp_path)
    object.__setattr__(job, "sources", {"permanent": source})
    run(job)
    (tmp_path / "shape.node").write_text("b")
    assert run(job)[0] == "scale"


def test_the_run_record_sums_the_stage_times(toy: ModuleType, tmp_path: Path) -> None:
    records: list[Any] = []

    def telling(inputs: Mapping[str, Any], profile: Mapping[str, Any], monitor: Any) -> Any:
        records.append(inputs["run"])
        return toy.tell(inputs, profile, monitor)

    run(toy.job(tmp_path, tell=telling))
    run(toy.job(tmp_path, tell=telling), forced=frozenset({"tell"}))
    record, again = records
    assert again == record
    assert [stage["name"] for stage in record["stages"]] == ["scale", "add"]
    assert record["wall_s"] == pytest.approx(sum(stage["wall_s"] for stage in record["stages"]))
    assert record["versions"]["numpy"] == np.__version__
    assert list(record["inputs"]) == ["numbers.txt"]
    assert sys.platform == "win32" or 10 < record["peak_rss_mb"] < 1e5
