"""A table that contradicts itself is refused."""

from pathlib import Path
from types import ModuleType

import pytest


@pytest.mark.parametrize(
    ("old", "new", "problem"),
    [
        ('reads = ["scaled"]', 'reads = ["text"]', "stage add reads text too early"),
        ('writes = ["text"]', 'writes = ["text", "total"]', "stage tell writes total again"),
        ('text   = "out/text.txt"', "", r"text has no path in \[artifacts\]"),
        ('text   = "out/text.txt"', 'text = "out/text.txt"\nspare = "s"', "no stage writes spare"),
        ('text   = "out/text.txt"', 'text = "out/extra.bin"', "two artifacts share a path"),
        ('name = "tell"', 'name = "add"', "a stage name occurs twice"),
        ("version = 1", "", "stage 'scale' needs exactly"),
        ("version = 1", "version = 1\nwhen = 2", "stage 'scale' needs exactly"),
    ],
)
def test_contradictions_are_named(toy: ModuleType, tmp_path: Path, old: str, new: str, problem: str) -> None:
    assert old in toy.TABLE
    with pytest.raises(ValueError, match=problem):
        toy.table(tmp_path, toy.TABLE.replace(old, new, 1))


def test_stages_between(toy: ModuleType, tmp_path: Path) -> None:
    table = toy.table(tmp_path)
    assert [stage.name for stage in table.between("add", None)] == ["add", "tell"]
    assert [stage.name for stage in table.between(None, "add")] == ["scale", "add"]
    assert [stage.name for stage in table.between("tell", "scale")] == []
    assert table.writer("extra").name == "add"
