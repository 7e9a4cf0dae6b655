"""When a stage is current: its manifest tells what it read, what it depended on and what it wrote."""

import dataclasses
import hashlib
import json
from collections.abc import Mapping
from typing import Any

from fab4d import __version__
from fab4d.runner.table import Stage

Digests = Mapping[str, str | None]


def fingerprint(stage: Stage, reads: Digests, profile: Mapping[str, Any]) -> dict[str, Any]:
    """Everything that the stage's answer depends on, as plain JSON values.

    reads : sha256 of each artifact, None for one that the scene does not need
    """
    values = {key: plain(profile[key]) for key in stage.profile}
    made_by = {"stage": stage.name, "version": stage.version, "fab4d": __version__}
    return made_by | {"reads": dict(reads), "profile": values}


def plain(value: Any) -> Any:
    """`value` as JSON gives it back: dataclasses and tuples as dicts and lists. Raises TypeError for other types."""
    return json.loads(json.dumps(value, default=_as_dict))


def _as_dict(value: Any) -> dict[str, Any]:
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {field.name: getattr(value, field.name) for field in dataclasses.fields(value)}
    msg = f"a profile value of type {type(value).__name__} has no fingerprint"
    raise TypeError(msg)


def digest(values: Mapping[str, Any]) -> str:
    """sha256 of plain JSON values, whatever the order of their keys."""
    return hashlib.sha256(json.dumps(values, sort_keys=True).encode()).hexdigest()


def staleness(manifest: Mapping[str, Any] | None, expected: Mapping[str, Any], written: Digests) -> str | None:
    """Why a stage has to run, or None when it is current.

    manifest : of its last finished run        expected : fingerprint of a run now        written : what is on disk now
    """
    if manifest is None:
        return "not run yet"
    if manifest.keys() < expected.keys() | {"writes"}:
        return "its manifest is damaged"
    if manifest["fab4d"] != expected["fab4d"]:
        return f"made by fab4d {manifest['fab4d']}"
    if manifest["version"] != expected["version"]:
        return f"the stage is now version {expected['version']}"
    changed = _differing(manifest["profile"], expected["profile"]) or _differing(manifest["reads"], expected["reads"])
    if changed:
        return f"{', '.join(changed)} changed"
    edited = _differing(manifest["writes"], written)
    return f"{', '.join(edited)} changed or removed by hand" if edited else None


def _differing(before: Mapping[str, Any], now: Mapping[str, Any]) -> list[str]:
    return sorted(name for name in before.keys() | now.keys() if before.get(name, ...) != now.get(name, ...))
