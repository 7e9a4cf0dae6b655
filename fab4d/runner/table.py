"""The stage table, pipeline/stages.toml: the stages in order, what each reads, writes and depends on."""

import tomllib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, fields
from functools import cache
from pathlib import Path
from typing import Any

from fab4d.io.data import data_folder

SOURCES = ("permanent", "temporary")
RUN = "run"
# What a person picked from a study; a stage reads it where there is one.
PICKED = "picked"


@dataclass(frozen=True)
class Stage:
    """One row of the table. `profile` names sections of the scene; `version` rises when the stage's answer changes."""

    name: str
    reads: tuple[str, ...]
    writes: tuple[str, ...]
    profile: tuple[str, ...]
    version: int


@dataclass(frozen=True)
class Table:
    """Artifacts with their paths in the run folder, the stages in order, and the studies, which no run needs."""

    artifacts: Mapping[str, str]
    stages: tuple[Stage, ...]
    studies: tuple[Stage, ...] = ()

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(stage.name for stage in self.stages)

    def stage(self, name: str) -> Stage:
        """The stage called `name`."""
        return next(stage for stage in self.stages if stage.name == name)

    def study(self, name: str) -> Stage:
        """The study called `name`."""
        return next(study for study in self.studies if study.name == name)

    def writer(self, artifact: str) -> Stage | None:
        """The stage that writes `artifact`; None where a person decides it."""
        return next((stage for stage in self.stages if artifact in stage.writes), None)

    def between(self, first: str | None, last: str | None) -> tuple[Stage, ...]:
        """The stages from `first` to `last`, both included; None is the table's end."""
        start = self.names.index(first) if first else 0
        stop = self.names.index(last) + 1 if last else len(self.stages)
        return self.stages[start:stop]


@cache
def stage_table() -> Table:
    """The table that ships with fab4d."""
    return read_table(data_folder("pipeline") / "stages.toml")


def read_table(path: Path) -> Table:
    """The table in the TOML file `path`. Raises ValueError when it contradicts itself."""
    with path.open("rb") as file:
        content = tomllib.load(file)
    stages, studies = (tuple(_stage(row) for row in content.get(kind, ())) for kind in ("stage", "study"))
    table = Table(content["artifacts"], stages, studies)
    problem = next(_problems(table), None)
    if problem:
        msg = f"{path}: {problem}"
        raise ValueError(msg)
    return table


def _stage(row: Mapping[str, Any]) -> Stage:
    if set(row) != {field.name for field in fields(Stage)}:
        msg = f"stage {row.get('name')!r} needs exactly name, reads, writes, profile and version, not {sorted(row)}"
        raise ValueError(msg)
    return Stage(row["name"], tuple(row["reads"]), tuple(row["writes"]), tuple(row["profile"]), row["version"])


def _problems(table: Table) -> Iterator[str]:
    known: set[str] = {*SOURCES, RUN, PICKED}
    names = [stage.name for stage in (*table.stages, *table.studies)]
    if len(set(names)) != len(names):
        yield f"a stage name occurs twice in {names}"
    for stage in (*table.stages, *table.studies):
        yield from (f"stage {stage.name} reads {name} too early" for name in stage.reads if name not in known)
        yield from (f"stage {stage.name} writes {name} again" for name in stage.writes if name in known)
        yield from (f"{name} has no path in [artifacts]" for name in stage.writes if name not in table.artifacts)
        known.update(stage.writes)
    yield from (f"no stage writes {name}" for name in table.artifacts if name not in known)
    if len(set(table.artifacts.values())) != len(table.artifacts):
        yield "two artifacts share a path"
