"""What README and CONTRIBUTING tell is so."""

import re
from pathlib import Path

import pytest

from fab4d import errors
from fab4d.cli import USAGE_EXIT_CODE, main
from fab4d.io.scene import load_scene
from fab4d.runner.table import stage_table

ROOT = Path(__file__).parents[2]
README = (ROOT / "README.md").read_text()


def blocks(language: str) -> list[str]:
    """The code blocks of README.md in `language`."""
    return re.findall(rf"```{language}\n(.*?)```", README, re.DOTALL)


def test_the_scene_of_the_readme_is_the_sample(tmp_path: Path) -> None:
    path = tmp_path / "scene.toml"
    path.write_text(blocks("toml")[0])
    told, sample = load_scene(path), load_scene(ROOT / "samples" / "strip")
    assert told.clamp == sample.clamp
    assert told.goal == sample.goal
    assert (told.name, told.materials, told.rig) == (sample.name, sample.materials, sample.rig)


def test_the_readme_has_two_commands_and_ci_runs_the_second() -> None:
    first, second = blocks("sh")
    marker = "<!-- test command"
    assert README.index(first) < README.index(marker) < README.index(second)
    assert f"/^{marker}/" in (ROOT / ".ci" / "run").read_text()
    assert (ROOT / first.split()[-1] / "scene.toml").is_file()


@pytest.mark.parametrize("name", [name for name in main.commands if name not in stage_table().names])
def test_the_readme_shows_every_command(name: str) -> None:
    assert f"fab4d {name}" in README


def test_the_readme_tells_every_exit_code() -> None:
    rows = re.findall(r"^\| ([\d, ]+) \|", README, re.MULTILINE)
    told = {int(code) for row in rows for code in row.split(",")}
    codes = {error.exit_code for error in errors.Fab4dError.__subclasses__()}
    assert told == codes | {0, USAGE_EXIT_CODE}


def test_the_readme_tells_every_file_outside_work() -> None:
    files = [path for path in stage_table().artifacts.values() if not path.startswith("work/")]
    assert [path for path in files if f"`{path}`" not in README] == []


def test_contributing_tells_every_room() -> None:
    text = (ROOT / "CONTRIBUTING.md").read_text()
    rooms = [path.name for path in (ROOT / "fab4d").iterdir() if (path / "__init__.py").is_file()]
    assert [room for room in rooms if f"`{room}/`" not in text] == []
