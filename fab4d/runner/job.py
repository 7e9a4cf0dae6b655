"""One scene in one run folder: what a stage of it is given, and the sha256 of what it is given."""

import importlib
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from fab4d.errors import ArtifactError, MeshError
from fab4d.runner.fingerprint import digest, fingerprint
from fab4d.runner.machine import versions
from fab4d.runner.table import RUN, SOURCES, Stage, Table
from fab4d.runner.workspace import Workspace, file_digest
from fab4d.stages.monitor import Monitor

StageFunction = Callable[[Mapping[str, Any], Mapping[str, Any], Monitor], Mapping[str, Any]]

# Formats that keep one mesh in two files: the other file belongs to the fingerprint too.
COMPANION_SUFFIXES = {".ele": ".node", ".node": ".ele", ".xdmf": ".h5", ".xmf": ".h5"}


class UndeclaredError(LookupError):
    """A stage and its row of the table disagree."""


class Fields(dict[str, Any]):
    """The arrays or values of a file that may be from another version or edited by hand.

    Raises ArtifactError for one that it lacks.
    """

    def __init__(self, values: Mapping[str, Any], path: str, advice: str) -> None:
        super().__init__(values)
        self._path, self._advice = path, advice

    def __missing__(self, name: str) -> Any:
        msg = f'{self._path} has no "{name}": {self._advice}'
        raise ArtifactError(msg)


class Declared(Mapping[str, Any]):
    """What the table declares for a stage, and nothing else, so that the table cannot lie."""

    def __init__(self, owner: str, values: Mapping[str, Any]) -> None:
        self._owner, self._values = owner, values

    def __getitem__(self, name: str) -> Any:
        if name not in self._values:
            msg = f'{self._owner} does not declare "{name}" in pipeline/stages.toml'
            raise UndeclaredError(msg)
        return self._values[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._values)

    def __len__(self) -> int:
        return len(self._values)


def stage_function(name: str) -> StageFunction:
    """`run` of the module fab4d.stages.<name>, imported only now.

    Raises ArtifactError when numba finds no folder to keep the compiled kernels in.
    """
    try:
        function: StageFunction = importlib.import_module(f"fab4d.stages.{name}").run
    except RuntimeError as error:
        if "no locator available" not in str(error):
            raise
        msg = (
            "neither the folder of fab4d nor the user's cache folder is writable, so compiled code cannot be kept: "
            "set the environment variable NUMBA_CACHE_DIR to a folder that is"
        )
        raise ArtifactError(msg) from error
    return function


@dataclass(frozen=True)
class Job:
    """One scene to run in one run folder.

    sources : the files of the inputs `permanent` and `temporary`, and others whose sha256 the report tells
    scene : its attributes are the profile sections        read_source : reads the file of an input
    """

    table: Table
    workspace: Workspace
    scene: Any
    sources: Mapping[str, Path]
    read_source: Callable[[Path], Any]
    stage_function: Callable[[str], StageFunction] = stage_function

    def inputs(self, stage: Stage) -> Declared:
        """The artifacts that `stage` reads; None for one that the scene does not need.

        Raises ArtifactError when one is missing or damaged.
        """
        return Declared(f"stage {stage.name}", {name: self._load(name, stage) for name in stage.reads})

    def profile(self, stage: Stage) -> Declared:
        """The sections of the scene that `stage` depends on."""
        missing = [name for name in stage.profile if not hasattr(self.scene, name)]
        if missing:
            msg = f"stage {stage.name} depends on {missing}, which a scene does not have"
            raise UndeclaredError(msg)
        values = {name: getattr(self.scene, name) for name in stage.profile}
        return Declared(f"profile of stage {stage.name}", values)

    def fingerprint(self, stage: Stage) -> dict[str, Any]:
        """Everything that the answer of `stage` depends on now."""
        return fingerprint(stage, {name: self._digest(name) for name in stage.reads}, self.profile(stage))

    def written(self, stage: Stage) -> dict[str, str | None]:
        """sha256 of what lies at the places that `stage` writes."""
        return {name: self.workspace.digest(name) for name in stage.writes}

    def _digest(self, name: str) -> str | None:
        if name in SOURCES:
            return source_digest(self.sources[name])
        if name == RUN:  # its times differ from run to run, what they tell of is the same
            return digest({"versions": versions(), "inputs": input_digests(self.sources)})
        return self.workspace.digest(name)

    def _load(self, name: str, stage: Stage) -> Any:
        if name in SOURCES:
            return self.read_source(self.sources[name])
        if name == RUN:
            return self._run_record(stage)
        if not self.workspace.exists(name):
            return self._absent(name)
        value, writer = self.workspace.load(name), self.table.writer(name)
        if not isinstance(value, dict) or writer is None:
            return value
        return Fields(
            value, str(self.workspace.path(name)), f"stage {writer.name} writes it, so run from {writer.name} on"
        )

    def _absent(self, name: str) -> None:
        """None for an artifact that its stage did not need to write, or that nobody picked."""
        writer = self.table.writer(name)
        if writer is None:
            return
        manifest = self.workspace.manifest(writer.name)
        if manifest is None or manifest["writes"][name] is not None:
            msg = f"{self.workspace.path(name)} is missing: stage {writer.name} writes it, so run from {writer.name} on"
            raise ArtifactError(msg)

    def _run_record(self, stage: Stage) -> dict[str, Any]:
        """What the stages before `stage` took: what it took itself in an earlier run is no part of this one."""
        before = self.table.names[: self.table.names.index(stage.name)]
        manifests = [(name, self.workspace.manifest(name)) for name in before]
        finished = [(name, manifest) for name, manifest in manifests if manifest]
        peaks = [manifest["peak_rss_mb"] for _, manifest in finished if manifest["peak_rss_mb"] is not None]
        return {
            "stages": [
                {"name": name, "wall_s": manifest["wall_s"], "peak_rss_mb": manifest["peak_rss_mb"]}
                for name, manifest in finished
            ],
            "wall_s": sum(manifest["wall_s"] for _, manifest in finished),
            "peak_rss_mb": max(peaks, default=None),
            "versions": versions(),
            "inputs": input_digests(self.sources),
        }


def source_digest(path: Path) -> str:
    """sha256 of a file, or of both files of a format that has two. Raises MeshError when it is missing."""
    if not path.is_file():
        msg = f"{path}: no such file; [shape] of the scene names it"
        raise MeshError(msg)
    companion = path.with_suffix(COMPANION_SUFFIXES.get(path.suffix, path.suffix))
    if companion == path or not companion.is_file():
        return file_digest(path)
    return digest({"file": file_digest(path), "companion": file_digest(companion)})


def input_digests(sources: Mapping[str, Path]) -> dict[str, str]:
    """{file: sha256}, files named as seen from the folder that holds them all."""
    paths = [path.resolve() for path in sources.values()]
    folder = next(up for up in paths[0].parents if all(path.is_relative_to(up) for path in paths))
    return {path.relative_to(folder).as_posix(): source_digest(path) for path in paths}
