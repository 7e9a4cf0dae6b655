"""The run folder: the one place that knows every path in it."""

import hashlib
import json
import shutil
import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

from fab4d.errors import ArtifactError
from fab4d.runner.codecs import decode, encode

if sys.platform == "win32":
    import msvcrt
else:
    import fcntl


@dataclass(frozen=True)
class Workspace:
    """The folder `root` and the paths of `artifacts` in it."""

    root: Path
    artifacts: Mapping[str, str]

    def path(self, artifact: str) -> Path:
        return self.root / self.artifacts[artifact]

    def manifest_path(self, stage: str) -> Path:
        return self.root / "work" / "manifests" / f"{stage}.json"

    def checkpoint_folder(self, stage: str) -> Path:
        return self.root / "work" / "checkpoints" / stage

    def study_folder(self, study: str) -> Path:
        return self.root / "work" / study

    @property
    def _lock_path(self) -> Path:
        return self.root / "work" / "lock"

    def exists(self, artifact: str) -> bool:
        return self.path(artifact).is_file()

    def digest(self, artifact: str) -> str | None:
        """sha256 of the artifact's file, None when there is none."""
        return file_digest(self.path(artifact)) if self.exists(artifact) else None

    def load(self, artifact: str) -> Any:
        """The artifact's value. Raises ArtifactError when its file is damaged."""
        return read_file(self.path(artifact))

    def save(self, values: Mapping[str, Any]) -> None:
        """Write the artifacts of one stage, all encoded before the first is renamed; None removes the file."""
        present = {name: value for name, value in values.items() if value is not None}
        write_files({self.path(name): self._encoded(name, value) for name, value in present.items()})
        for name in values.keys() - present.keys():
            self.path(name).unlink(missing_ok=True)
            _beside(self.path(name)).unlink(missing_ok=True)

    def _encoded(self, artifact: str, value: Any) -> bytes:
        try:
            return encode(self.path(artifact).suffix, value)
        except (TypeError, ValueError) as error:
            error.add_note(f"while encoding {artifact} ({self.artifacts[artifact]})")
            raise

    def manifest(self, stage: str) -> dict[str, Any] | None:
        """What the stage's last finished run recorded, or None. Raises ArtifactError when the file is damaged."""
        path = self.manifest_path(stage)
        return cast("dict[str, Any]", read_file(path)) if path.is_file() else None

    def save_manifest(self, stage: str, manifest: Mapping[str, Any]) -> None:
        write_files({self.manifest_path(stage): encode(".json", manifest)})

    def remove_manifest(self, stage: str) -> None:
        self.manifest_path(stage).unlink(missing_ok=True)

    @contextmanager
    def locked(self) -> Iterator[None]:
        """Keep every other fab4d out of the folder. Raises ArtifactError when it is in use or not ours."""
        self._refuse_foreign_folder()
        self._lock_path.parent.mkdir(parents=True, exist_ok=True)
        with self._lock_path.open("ab") as handle:
            try:
                _lock(handle.fileno())
            except OSError as error:
                msg = f"{self.root} is in use by another fab4d: wait for it, or give another folder with --out"
                raise ArtifactError(msg) from error
            yield

    def _refuse_foreign_folder(self) -> None:
        if self.root.exists() and not self.root.is_dir():
            msg = f"{self.root} is a file: give a folder with --out"
            raise ArtifactError(msg)
        if self.root.is_dir() and any(self.root.iterdir()) and not self._lock_path.exists():
            msg = f"{self.root} holds files but no run of fab4d: give a new or an empty folder with --out"
            raise ArtifactError(msg)


class Checkpoints:
    """What an unfinished stage saved, valid for one `key`: another key empties the folder."""

    def __init__(self, folder: Path, key: str) -> None:
        self.folder, self.key = folder, key
        self.spent_s = 0.0
        kept = _mark(folder)
        if kept.get("key") == key:
            self.spent_s = float(kept["spent_s"])
        else:
            self.clear()

    def save(self, name: str, arrays: Mapping[str, Any], spent_s: float) -> None:
        """Keep `arrays`; `spent_s` is the time that the stage has worked, over all its starts."""
        mark = json.dumps({"key": self.key, "spent_s": spent_s}).encode()
        write_files({self._path(name): encode(".npz", arrays), self.folder / "key.json": mark})

    def restore(self, name: str) -> dict[str, Any] | None:
        path = self._path(name)
        return cast("dict[str, Any]", read_file(path)) if path.is_file() else None

    def clear(self) -> None:
        self.spent_s = 0.0
        if self.folder.exists():
            shutil.rmtree(self.folder)

    def _path(self, name: str) -> Path:
        return self.folder / f"{name}.npz"


def kept_key(folder: Path) -> str | None:
    """The key of the checkpoints in `folder`, None where there are none."""
    return _mark(folder).get("key")


def _mark(folder: Path) -> dict[str, Any]:
    path = folder / "key.json"
    return cast("dict[str, Any]", json.loads(path.read_bytes())) if path.is_file() else {}


def read_file(path: Path) -> Any:
    """The value in `path`, by its suffix. Raises ArtifactError when it is damaged."""
    try:
        return decode(path.suffix, path.read_bytes())
    except ValueError as error:
        msg = f"{path} is damaged ({error}): delete it and run again"
        raise ArtifactError(msg) from error


def write_files(files: Mapping[Path, bytes]) -> None:
    """Write every file beside its final name, then rename them all: no partial file ever has a final name."""
    try:
        for path, data in files.items():
            path.parent.mkdir(parents=True, exist_ok=True)
            _beside(path).write_bytes(data)
        for path in files:
            _beside(path).replace(path)
    finally:
        for path in files:
            _beside(path).unlink(missing_ok=True)


def file_digest(path: Path) -> str:
    """sha256 of a file's content, hexadecimal."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _beside(path: Path) -> Path:
    return path.with_name(path.name + ".writing")


def _lock(descriptor: int) -> None:
    if sys.platform == "win32":
        msvcrt.locking(descriptor, msvcrt.LK_NBLCK, 1)
    else:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
