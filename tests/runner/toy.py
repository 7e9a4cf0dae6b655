"""A pipeline of three small stages; as a program it runs them in a folder and hangs in the stage it is told."""

import sys
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from fab4d.runner.display import SilentDisplay
from fab4d.runner.job import Job
from fab4d.runner.runner import Selection, execute
from fab4d.runner.table import Table, read_table
from fab4d.runner.workspace import Workspace

TABLE = """
[artifacts]
scaled = "work/scaled.npz"
total  = "work/total.json"
extra  = "out/extra.bin"
text   = "out/text.txt"

[[stage]]
name = "scale"
reads = ["permanent"]
writes = ["scaled"]
profile = ["factor"]
version = 1

[[stage]]
name = "add"
reads = ["scaled"]
writes = ["total", "extra"]
profile = ["with_extra"]
version = 1

[[stage]]
name = "tell"
reads = ["total", "extra", "run"]
writes = ["text"]
profile = ["name"]
version = 1
"""
NAMES = ("scale", "add", "tell")


@dataclass(frozen=True)
class Card:
    value: float


@dataclass(frozen=True)
class ToyScene:
    name: str = "toy"
    factor: Card = Card(2.0)
    with_extra: bool = True


def scale(inputs: Mapping[str, Any], profile: Mapping[str, Any], _monitor: Any) -> dict[str, Any]:
    return {"scaled": {"values": inputs["permanent"] * profile["factor"].value}}


def add(inputs: Mapping[str, Any], profile: Mapping[str, Any], monitor: Any) -> dict[str, Any]:
    monitor.progress("adding", rms_mm=1.0)
    total = float(inputs["scaled"]["values"].sum())
    return {"total": {"total": np.float64(total)}, "extra": b"\x00\xff" if profile["with_extra"] else None}


def tell(inputs: Mapping[str, Any], profile: Mapping[str, Any], _monitor: Any) -> dict[str, Any]:
    extra = "no extra" if inputs["extra"] is None else f"{len(inputs['extra'])} bytes extra"
    files = ", ".join(inputs["run"]["inputs"])
    return {"text": f"{profile['name']}: {inputs['total']['total']} from {files}, {extra}\n".encode()}


def table(folder: Path, text: str = TABLE) -> Table:
    path = folder / "stages.toml"
    path.write_text(text)
    return read_table(path)


def lookup(replaced: Mapping[str, Callable[..., Any]], calls: list[str]) -> Callable[[str], Callable[..., Any]]:
    functions = {"scale": scale, "add": add, "tell": tell, **replaced}

    def find(name: str) -> Callable[..., Any]:
        def run(*args: Any) -> Any:
            calls.append(name)
            return functions[name](*args)

        return run

    return find


def job(
    folder: Path,
    scene: ToyScene | None = None,
    calls: list[str] | None = None,
    stages: Table | None = None,
    **replaced: Callable[..., Any],
) -> Job:
    """The toy pipeline on `folder`/numbers.txt in `folder`/run."""
    stages = stages or table(folder)
    source = folder / "numbers.txt"
    if not source.exists():
        source.write_text("1 2 3 4")
    workspace = Workspace(folder / "run", stages.artifacts)
    find = lookup(replaced, [] if calls is None else calls)
    return Job(stages, workspace, scene or ToyScene(), {"permanent": source}, np.loadtxt, find)


def hanging(name: str) -> Callable[..., Any]:
    """A stage that saves a checkpoint, says so, and never ends."""

    def run(_inputs: Any, _profile: Any, monitor: Any) -> Any:
        monitor.save("half", {"values": np.arange(3.0)})
        print(name, flush=True)
        time.sleep(600)

    return run


if __name__ == "__main__":
    execute(job(Path(sys.argv[1]), **{sys.argv[2]: hanging(sys.argv[2])}), Selection(), SilentDisplay())
