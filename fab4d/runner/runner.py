"""Runs the stages of a table in order, skips the current ones, and goes on where a killed run stopped."""

import signal
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from types import FrameType
from typing import Any, NoReturn

from fab4d.errors import InterruptedRunError
from fab4d.runner.display import Display, duration
from fab4d.runner.fingerprint import digest, staleness
from fab4d.runner.job import Job, UndeclaredError
from fab4d.runner.machine import peak_rss_mb
from fab4d.runner.monitor import StageMonitor
from fab4d.runner.pick import refuse_outdated_pick, study_rows
from fab4d.runner.table import Stage
from fab4d.runner.workspace import Checkpoints


@dataclass(frozen=True)
class Selection:
    """Which stages to run: from `first` to `last` (None: the table's ends), `forced` ones even when current."""

    first: str | None = None
    last: str | None = None
    forced: frozenset[str] = frozenset()


@dataclass(frozen=True)
class Step:
    """A stage of a plan. state: `runs`, `current`, or `may run` when it hangs on the answer of an earlier stage."""

    stage: str
    state: str
    reason: str


def plan(job: Job, selection: Selection) -> list[Step]:
    """What `execute` would do now, without doing it."""
    steps: list[Step] = []
    for stage in job.table.between(selection.first, selection.last):
        open_stages = {step.stage for step in steps if step.state != "current"}
        steps.append(_step(job, stage, selection, open_stages))
    return steps


def _step(job: Job, stage: Stage, selection: Selection, open_stages: set[str]) -> Step:
    artifacts = [name for name in stage.reads if name in job.table.artifacts]
    writers = {name: job.table.writer(name) for name in artifacts}
    awaited = [name for name, writer in writers.items() if writer and writer.name in open_stages]
    reason = _reason(job, stage, selection, awaited)
    if reason:
        return Step(stage.name, "runs", reason)
    if awaited:
        return Step(stage.name, "may run", f"if {', '.join(awaited)} changes")
    return Step(stage.name, "current", "")


def execute(job: Job, selection: Selection, display: Display) -> list[str]:
    """Run what is not current, in order; returns the names of the stages that ran.

    Raises InterruptedRunError on Ctrl-C or SIGTERM, ArtifactError when an artifact that `selection` takes for granted
    is missing, and whatever a stage raises.
    """
    ran: list[str] = []
    with job.workspace.locked(), _sigterm_as_interrupt():
        for stage in job.table.between(selection.first, selection.last):
            with _resumable(job, stage, selection):
                reason = _reason(job, stage, selection)
                display.note(stage.name, f"runs: {reason}" if reason else "current")
                if reason:
                    refuse_outdated_pick(job, stage)
                    _run_stage(job, stage, stage.name in selection.forced, display)
                    ran.append(stage.name)
    return ran


def execute_study(job: Job, name: str, options: Mapping[str, Any], forced: bool, display: Display) -> None:
    """Run the stages that the study reads from, then the study; rows that it finished for the same inputs are kept.

    Raises InterruptedRunError on Ctrl-C or SIGTERM, and whatever the study raises.
    """
    study = job.table.study(name)
    writers = [writer.name for writer in map(job.table.writer, study.reads) if writer]
    execute(job, Selection(last=max(writers, key=job.table.names.index)), display)
    selection = Selection(forced=frozenset({name} if forced else ()))
    with job.workspace.locked(), _sigterm_as_interrupt(), _resumable(job, study, selection):
        rows = study_rows(job, study)
        if forced:
            rows.clear()
        monitor = StageMonitor(name, rows, display)
        results = job.stage_function(name)(job.inputs(study), job.profile(study), monitor, **options)
        _check_writes(study, results)
        job.workspace.save(results)
        job.workspace.save_manifest(name, job.fingerprint(study) | {"writes": job.written(study)})
        display.note(name, f"done in {duration(monitor.elapsed_s())}")


def _reason(job: Job, stage: Stage, selection: Selection, unchanged: Sequence[str] = ()) -> str | None:
    """Why `stage` has to run, None when it is current, taking it that the artifacts `unchanged` will come out equal."""
    if stage.name in selection.forced:
        return "forced"
    manifest, expected = job.workspace.manifest(stage.name), job.fingerprint(stage)
    if manifest:
        expected["reads"] |= {name: manifest["reads"].get(name) for name in unchanged}
    return staleness(manifest, expected, job.written(stage))


def _run_stage(job: Job, stage: Stage, from_scratch: bool, display: Display) -> None:
    expected = job.fingerprint(stage)
    checkpoints = Checkpoints(job.workspace.checkpoint_folder(stage.name), digest(expected))
    if from_scratch:
        checkpoints.clear()
    if checkpoints.spent_s:
        display.note(stage.name, f"goes on after {duration(checkpoints.spent_s)} of an earlier run")
    monitor = StageMonitor(stage.name, checkpoints, display)
    results = job.stage_function(stage.name)(job.inputs(stage), job.profile(stage), monitor)
    _check_writes(stage, results)
    job.workspace.remove_manifest(stage.name)
    job.workspace.save(results)
    wall_s = monitor.elapsed_s()
    measured = {"wall_s": wall_s, "peak_rss_mb": peak_rss_mb()}
    job.workspace.save_manifest(stage.name, expected | {"writes": job.written(stage)} | measured)
    checkpoints.clear()
    display.note(stage.name, f"done in {duration(wall_s)}")


def _check_writes(stage: Stage, results: Mapping[str, Any]) -> None:
    if set(results) != set(stage.writes):
        msg = f"stage {stage.name} returned {sorted(results)}, pipeline/stages.toml declares {sorted(stage.writes)}"
        raise UndeclaredError(msg)


@contextmanager
def _resumable(job: Job, stage: Stage, selection: Selection) -> Iterator[None]:
    """Turn Ctrl-C into an error that says how to go on."""
    try:
        yield
    except (KeyboardInterrupt, SystemError) as error:
        # Compiled code that Ctrl-C stops raises SystemError because of it.
        if not isinstance(error, KeyboardInterrupt) and not isinstance(error.__cause__, KeyboardInterrupt):
            raise
        again = "the same command again without --force" if selection.forced else "the same command again"
        msg = f"stopped in {stage.name}; what was finished is kept in {job.workspace.root}: to go on, give {again}"
        raise InterruptedRunError(msg) from None


@contextmanager
def _sigterm_as_interrupt() -> Iterator[None]:
    """Let `kill` stop a run as Ctrl-C does."""

    def interrupt(_number: int, _frame: FrameType | None) -> NoReturn:
        raise KeyboardInterrupt

    previous = signal.signal(signal.SIGTERM, interrupt)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, previous)
