"""`fab4d bodies MESH --labels` and `fab4d slice` on its folder: what is written, printed, and how it ends."""

import json
from itertools import permutations
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner, Result

from fab4d.cli import USAGE_EXIT_CODE, main
from fab4d.io.cards import load_printer
from fab4d.io.meshes import write_vtu
from fab4d.io.slicers import Slice, Slicer, filament_length

STRIP = Path(__file__).parents[2] / "samples" / "strip"


def fab4d(*arguments: Any) -> Result:
    return CliRunner().invoke(main, [str(argument) for argument in arguments])


@pytest.fixture
def mesh(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A bar of 4 x 1 x 1 cm, in cm, its first half SMP."""
    monkeypatch.chdir(tmp_path)
    corners = np.array([[k & 1, k >> 1 & 1, k >> 2] for k in range(8)])
    kuhn = np.array([[0, 1 << a, (1 << a) + (1 << b), 7] for a, b, _ in permutations(range(3))])
    places = (np.array([[k, 0, 0] for k in range(4)])[:, None] + corners).reshape(-1, 3)
    X, number = np.unique(places, axis=0, return_inverse=True)
    tets = number.reshape(-1, 8)[:, kuhn].reshape(-1, 4)
    write_vtu(tmp_path / "bar.vtu", X.astype(float), tets, {}, {"material": X[tets].mean(axis=1)[:, 0] < 2})
    return tmp_path / "bar.vtu"


def lay_down(monkeypatch: pytest.MonkeyPatch, *volumes: float) -> None:
    printer = load_printer("generic-dual-0.4", Path())
    lengths = tuple(filament_length(volume, printer) for volume in volumes)
    monkeypatch.setattr("fab4d.io.slicers.find_slicer", lambda _kind: Slicer("prusa", Path("some-slicer")))
    monkeypatch.setattr("fab4d.stages.slice.slice_bodies", lambda *_: Slice(lengths, 5400.0))


def test_a_labelled_mesh_becomes_bodies(mesh: Path) -> None:
    result = fab4d("bodies", mesh, "--labels", "material", "--units", "cm")
    assert result.exit_code == 0, result.output
    assert "SMP: tool 1, 2 cm^3, 2.4 g" in result.stdout
    folder = Path("runs/bar-bodies")
    assert {path.name for path in (folder / "print").iterdir()} == {"smp.stl", "tpe.stl", "part.3mf", "part.orca.3mf"}
    report = json.loads((folder / "work" / "bodies.json").read_text())
    assert {name: body["volume_mm3"] for name, body in report["bodies"].items()} == {"smp": 2000, "tpe": 2000}


def test_warnings_are_printed(mesh: Path) -> None:
    result = fab4d("bodies", mesh, "--labels", "material")
    assert result.exit_code == 0
    assert "warning: smallest contact of a cluster" not in result.stdout
    assert "warning: purge of the tool changes is 175 of the volume, allowed is at most 1" in result.stdout


@pytest.mark.parametrize(
    ("option", "code", "message"),
    [
        (("--labels", "smp"), 4, 'no cell field "smp"; it has: material'),
        (("--labels", "material", "--units", "ft"), 3, 'unknown length unit "ft"'),
        (("--labels", "material", "--printer", "prusa-x"), 3, 'did you mean "prusa-xl"'),
        (("--labels", "material", "--up", "1,0"), USAGE_EXIT_CODE, "--up takes three numbers with commas"),
        (("--printer", "prusa-xl"), USAGE_EXIT_CODE, "--printer goes with --labels"),
    ],
)
def test_wrong_options_are_named(mesh: Path, option: tuple[str, ...], code: int, message: str) -> None:
    result = fab4d("bodies", mesh, *option)
    assert result.exit_code == code
    assert message in result.stderr
    assert not Path("runs").exists()


def test_a_good_slice_ends_with_0_and_a_report(mesh: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    fab4d("bodies", mesh, "--labels", "material", "--units", "cm")
    lay_down(monkeypatch, 2010, 1990)
    result = fab4d("slice", "runs/bar-bodies")
    assert result.exit_code == 0, result.output
    assert "SMP: tool 1, 2.01 cm^3 laid down for a body of 2 cm^3" in result.stdout
    assert "print time, without heating and 50 changes of tool: 1 h 30 min" in result.stdout
    assert json.loads(Path("runs/bar-bodies/work/slice.json").read_text())["slicer"] == "some-slicer"


@pytest.mark.parametrize("volumes", [(4000, 0), (2000, 1900), (2100, 2000)])
def test_a_slice_of_other_volumes_ends_with_10(
    mesh: Path, monkeypatch: pytest.MonkeyPatch, volumes: tuple[float, float]
) -> None:
    fab4d("bodies", mesh, "--labels", "material", "--units", "cm")
    lay_down(monkeypatch, *volumes)
    result = fab4d("slice", "runs/bar-bodies")
    assert result.exit_code == 10
    assert "some-slicer: " in result.stderr
    assert "warning: " in result.stdout


def test_without_a_slicer_it_ends_with_9(mesh: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Before the bodies are made; what is wrong with the scene is told first."""
    monkeypatch.setenv("PATH", str(mesh.parent))
    result = fab4d("slice", STRIP)
    assert result.exit_code == 9
    assert "install PrusaSlicer" in result.stderr
    assert not Path("runs").exists()
    assert fab4d("slice", "no-scene").exit_code == 3


def test_what_is_no_run_is_taken_for_a_scene(mesh: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    lay_down(monkeypatch, 1, 1)
    result = fab4d("slice", mesh.parent)
    assert result.exit_code == 3
    assert "scene.toml" in result.stderr


@pytest.mark.parametrize("gone", ["part.3mf", "smp.stl"])
def test_a_print_file_that_is_gone_is_named(mesh: Path, monkeypatch: pytest.MonkeyPatch, gone: str) -> None:
    fab4d("bodies", mesh, "--labels", "material", "--units", "cm")
    lay_down(monkeypatch, 2000, 2000)
    assert fab4d("slice", "runs/bar-bodies").exit_code == 0
    (Path("runs/bar-bodies/print") / gone).unlink()
    result = fab4d("slice", "runs/bar-bodies")
    assert result.exit_code == 8
    assert f"{gone} is missing: make it again" in result.stderr
