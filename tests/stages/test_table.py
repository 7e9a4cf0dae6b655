"""The stage table that ships with fab4d against the code."""

import ast
import dataclasses
from pathlib import Path

import pytest

from fab4d.io.data import data_folder
from fab4d.io.scene import Scene
from fab4d.runner.job import stage_function
from fab4d.runner.table import Stage, stage_table

ROOM = Path(__file__).parents[2] / "fab4d" / "stages"
HELPERS = {"monitor"}
STAGES = pytest.mark.parametrize("stage", stage_table().stages + stage_table().studies, ids=lambda stage: stage.name)


def test_the_table_names_the_modules_of_the_room() -> None:
    modules = {path.stem for path in ROOM.glob("*.py") if not path.stem.startswith("_")}
    studies = {study.name for study in stage_table().studies}
    assert modules - HELPERS == {*stage_table().names, *studies}


@STAGES
def test_each_stage_has_a_run(stage: Stage) -> None:
    assert callable(stage_function(stage.name))


@STAGES
def test_every_profile_key_is_a_section_of_a_scene(stage: Stage) -> None:
    assert set(stage.profile) <= {field.name for field in dataclasses.fields(Scene)}


@STAGES
def test_a_stage_uses_everything_that_it_declares(stage: Stage) -> None:
    """A declared artifact or section that the code never names would make the stage run for nothing."""
    tree = ast.parse((ROOM / f"{stage.name}.py").read_text())
    words = {node.value for node in ast.walk(tree) if isinstance(node, ast.Constant) and isinstance(node.value, str)}
    declared = {*stage.reads, *stage.writes, *stage.profile}
    assert {name for name in declared - words if not name.endswith("_trace")} == set()  # traces are named in a loop


def test_the_readme_explains_every_artifact_that_a_later_stage_reads() -> None:
    text = (data_folder("pipeline") / "README.md").read_text()
    read = {name for stage in stage_table().stages for name in stage.reads}
    families = {name: f"*_{name.rsplit('_', 1)[-1]}" for name in read}
    assert {name for name in read if f"`{name}`" not in text and f"`{families[name]}`" not in text} == set()
