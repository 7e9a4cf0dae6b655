"""Commands from outside: help, messages, exit codes, and what is printed in which order."""

import subprocess
import sys
import tomllib
from collections.abc import Mapping
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner, Result

from fab4d import __version__, errors
from fab4d.cli import USAGE_EXIT_CODE, main
from fab4d.io.csvtable import csv_bytes
from fab4d.report.stress import COLUMNS as STRESS_COLUMNS
from fab4d.report.stress import stress_csv
from fab4d.report.tradeoff import COLUMNS
from fab4d.runner.table import stage_table

HEAVY = {"numpy", "scipy", "numba", "meshio", "trimesh", "manifold3d", "reportlab", "matplotlib", "PIL", "rslab"}
SCENE = """
name = "two tets"
units = "mm"
[shape]
permanent = "a.vtk"
temporary = "b.vtk"
"""
REPORT = {
    "verdict": "ACCEPTED",
    "reasons": [],
    "error": {f"{kind}_{unit}": 0.25 for kind in ("rms", "max", "hausdorff") for unit in ("mm", "rel")},
    "smp_fraction": 0.5,
    "forces": 8,
    "mass_g": None,
}


def fab4d(*arguments: object) -> Result:
    return CliRunner().invoke(main, [str(argument) for argument in arguments])


@pytest.fixture
def scene(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A scene folder, with the folder above it as the current one."""
    monkeypatch.chdir(tmp_path)
    folder = tmp_path / "scene"
    folder.mkdir()
    (folder / "scene.toml").write_text(SCENE)
    header = "# vtk DataFile Version 3.0\nbox\nASCII\nDATASET UNSTRUCTURED_GRID\nPOINTS 5 double\n"
    cells = "CELLS 2 10\n4 0 1 2 3\n4 4 1 3 2\nCELL_TYPES 2\n10\n10\n"
    for name, top in (("a.vtk", 9), ("b.vtk", 10)):
        (folder / name).write_text(f"{header}0 0 0\n9 0 0\n0 9 0\n0 0 {top}\n9 9 9\n{cells}")
    return folder


@pytest.fixture
def stages(monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
    """Stages that write what this dict holds, and for the rest that nothing is needed."""
    written: dict[str, Any] = {"report_json": dict(REPORT), "smp_stl": b"solid"}

    def run(inputs: Mapping[str, Any], _profile: Any, monitor: Any) -> dict[str, Any]:
        stage = next(stage for stage in stage_table().stages if set(inputs) == set(stage.reads))
        monitor.progress("working", forces=8)
        for failure in [written[stage.name]] if stage.name in written else []:
            raise failure
        return {name: written.get(name) for name in stage.writes}

    for name in stage_table().names:
        module = ModuleType(name)
        module.run = run  # type: ignore[attr-defined]
        monkeypatch.setitem(sys.modules, f"fab4d.stages.{name}", module)
    written["mesh"] = {"X": np.eye(4, 3) * 50, "tets": np.array([[0, 1, 2, 3]])}
    finding = {"severity": "warning", "code": "thin", "file": "a.vtk", "message": "one tet thick", "count": 1}
    written["check_report"] = {
        "findings": [finding],
        "nothing_to_program": False,
        "statistics": {"min_det_F": 0.5},
        "left_out": [{"what": "gravity", "why": "the scene has none"}],
    }
    return written


def test_help_imports_nothing_heavy() -> None:
    code = "import sys, fab4d.cli; fab4d.cli.main(['--help'], standalone_mode=False); print(*sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    modules = set(done.stdout.split())
    assert "fab4d.runner.table" in modules
    assert not modules & HEAVY


@pytest.mark.parametrize("command", sorted(main.commands))
def test_every_command_has_help(command: str) -> None:
    result = fab4d(command, "--help")
    assert result.exit_code == 0
    assert main.commands[command].get_short_help_str()
    assert "--debug" in result.output


def test_every_stage_is_a_command() -> None:
    assert set(stage_table().names) < set(main.commands)


def test_version_is_that_of_the_package() -> None:
    project = tomllib.loads((Path(__file__).parents[2] / "pyproject.toml").read_text())["project"]
    assert fab4d("--version").output == f"fab4d, version {project['version']}\n"
    assert project["version"] == __version__


@pytest.mark.parametrize("arguments", [["run"], ["fly", "scene"], ["--fast"], ["run", "scene", "--from", "nowhere"]])
def test_a_mistyped_command_does_not_look_like_a_rejected_design(arguments: list[str]) -> None:
    assert fab4d(*arguments).exit_code == USAGE_EXIT_CODE != errors.DesignRejectedError.exit_code


def test_from_after_until_is_refused(scene: Path) -> None:
    result = fab4d("run", scene, "--from", "rig", "--until", "solve")
    assert result.exit_code == USAGE_EXIT_CODE
    assert "--from rig comes after --until solve" in result.output


def test_exit_codes_are_distinct() -> None:
    codes = [error.exit_code for error in errors.Fab4dError.__subclasses__()]
    assert len({*codes, errors.Fab4dError.exit_code, USAGE_EXIT_CODE, 0}) == len(codes) + 3


@pytest.mark.parametrize("command", [name for name in main.commands if name not in ("cards", "bench")])
def test_a_missing_scene_is_named(command: str, tmp_path: Path) -> None:
    result = fab4d(command, tmp_path / "nothing.toml")
    assert result.exit_code == errors.SceneError.exit_code
    assert result.stderr.startswith("fab4d: ")
    assert "nothing.toml" in result.stderr
    assert "Traceback" not in result.stderr


def test_an_unknown_key_names_the_nearest(scene: Path) -> None:
    (scene / "scene.toml").write_text(SCENE + "[goal]\ntolerence = 1\n")
    result = fab4d("run", scene)
    assert result.exit_code == errors.SceneError.exit_code
    assert "tolerance" in result.stderr


def test_a_missing_mesh_file_is_named(scene: Path) -> None:
    (scene / "b.vtk").unlink()
    result = fab4d("run", scene)
    assert result.exit_code == errors.MeshError.exit_code
    assert "b.vtk" in result.stderr


def test_debug_shows_the_trace(scene: Path) -> None:
    (scene / "b.vtk").unlink()
    result = fab4d("run", scene, "--debug")
    assert result.exit_code == errors.MeshError.exit_code
    assert "Traceback" in result.stderr


def test_a_foreign_folder_is_refused(scene: Path) -> None:
    result = fab4d("run", scene, "--out", scene)
    assert result.exit_code == errors.ArtifactError.exit_code
    assert "--out" in result.stderr


@pytest.mark.usefixtures("stages")
def test_the_verdict_comes_first_and_then_where_the_files_are(scene: Path) -> None:
    result = fab4d("run", scene)
    assert result.exit_code == 0, result.output
    lines = result.stdout.splitlines()
    assert lines[0] == "ACCEPTED"
    assert any(line.split() == ["SMP", "50.0", "%", "of", "the", "volume"] for line in lines)
    assert not any("mass" in line for line in lines)
    assert lines[-3:-1] == [f"files in {Path('runs/two-tets')}:", "  print/smp.stl        SMP body"]
    assert Path("runs/two-tets/report.json").is_file()


@pytest.mark.usefixtures("stages")
def test_progress_goes_to_stderr_and_quiet_silences_it(scene: Path) -> None:
    assert "solve      working  8 forces" in fab4d("run", scene).stderr
    assert fab4d("run", scene, "--force", "--quiet").stderr == ""


def test_a_rejected_design_is_delivered_with_its_reasons_first(scene: Path, stages: dict[str, Any]) -> None:
    stages["report_json"] |= {"verdict": "REJECTED", "reasons": ["error 4 mm above 1 mm", "grey"]}
    result = fab4d("run", scene)
    assert result.exit_code == errors.DesignRejectedError.exit_code
    assert result.stdout.splitlines()[:3] == ["REJECTED", "  - error 4 mm above 1 mm", "  - grey"]
    assert "fab4d: design rejected: error 4 mm above 1 mm (and 1 more)" in result.stderr
    assert Path("runs/two-tets/print/smp.stl").is_file()
    assert fab4d("run", scene).exit_code == errors.DesignRejectedError.exit_code  # also when nothing has to run


@pytest.mark.parametrize("error", errors.Fab4dError.__subclasses__())
def test_each_error_has_its_exit_code(scene: Path, stages: dict[str, Any], error: type[errors.Fab4dError]) -> None:
    stages["solve"] = error("tet 7: volume -0.1 mm^3")
    result = fab4d("run", scene)
    assert result.exit_code == error.exit_code
    assert result.stderr.endswith("fab4d: tet 7: volume -0.1 mm^3\n")


def test_ctrl_c_ends_with_130_and_says_how_to_go_on(scene: Path, stages: dict[str, Any]) -> None:
    stages["solve"] = KeyboardInterrupt()
    result = fab4d("run", scene, "--out", "here")
    assert result.exit_code == 130
    assert "stopped in solve" in result.stderr
    del stages["solve"]
    assert "check      current" in fab4d("run", scene, "--out", "here").stderr


@pytest.mark.usefixtures("stages")
def test_a_stage_command_runs_up_to_its_stage_and_tells_what_is_out_of_date(scene: Path) -> None:
    first = fab4d("verify", scene)
    assert first.exit_code == 0
    assert first.stdout.splitlines()[0] == "done up to verify"
    assert not Path("runs/two-tets/report.json").exists()
    fab4d("run", scene)
    (scene / "scene.toml").write_text(SCENE + "[goal]\ntolerance = 1\n")
    assert "out of date, of an earlier run: print/smp.stl, report.json" in fab4d("solve", scene).stdout
    forced = fab4d("solve", scene, "--force").stderr
    assert "check      current" in forced
    assert "solve      runs: forced" in forced


@pytest.mark.usefixtures("stages")
def test_check_tells_the_findings_and_leaves_nothing_behind(scene: Path, tmp_path: Path) -> None:
    result = fab4d("check", scene)
    assert result.stdout == "warning  thin: one tet thick\n  min_det_F              0.5\n"
    assert [path.name for path in tmp_path.iterdir()] == ["scene"]
    fab4d("check", scene, "--out", "kept")
    assert Path("kept/work/mesh.npz").is_file()


def test_check_says_when_there_is_nothing_to_program(scene: Path, stages: dict[str, Any]) -> None:
    stages["check_report"] |= {"findings": [], "nothing_to_program": True}
    first = fab4d("check", scene).stdout.splitlines()[0]
    assert first == "nothing to program: the shapes are equal up to a rigid motion"


@pytest.mark.usefixtures("stages")
def test_plan_tells_size_stages_what_is_left_out_and_what_to_expect(scene: Path, tmp_path: Path) -> None:
    before = fab4d("plan", scene).stdout
    assert before.startswith("two tets: 4 vertices, 1 tets, 50 x 50 x 50 mm\n")
    assert "  solve      runs     not run yet" in before
    assert "  gravity: the scene has none" in before
    assert "warning  thin: one tet thick" in before
    assert "expected, roughly" in before
    assert [path.name for path in tmp_path.iterdir()] == ["scene"]
    fab4d("run", scene)
    after = fab4d("plan", scene).stdout
    assert after.count("current") == len(stage_table().names)
    assert "nothing to do" in after


def test_cards_lists_every_card_that_comes_with_fab4d() -> None:
    profiles = Path(__file__).parents[2] / "profiles"
    result = fab4d("cards")
    assert result.exit_code == 0
    for card in profiles.rglob("*.toml"):
        assert f"  {card.stem} " in result.stdout


def test_bench_compares_the_finished_runs_and_draws_them(scene: Path, stages: dict[str, Any], tmp_path: Path) -> None:
    assert fab4d("bench").exit_code == errors.ArtifactError.exit_code
    stages["report_json"] |= {"tau_s": 0.01, "wall_s": 2.0, "peak_rss_mb": 100.0, "element_order": 1}
    stages["error_vs_time"] = b"tau,rms_mm\n10,0.5\n20,0.25\n"
    fab4d("run", scene)
    fab4d("run", scene, "--out", "runs/other")
    result = fab4d("bench", "--plot", "plots/all.png")
    assert result.exit_code == 0, result.output
    assert [line.split()[0] for line in result.stdout.splitlines()] == ["scene", "other", "two-tets"]
    assert (tmp_path / "plots" / "all.png").read_bytes().startswith(b"\x89PNG")
    assert fab4d("bench", "runs/other", "--markdown").stdout.splitlines()[-1].startswith("| other | 1 | 8 |")
    assert fab4d("bench", scene).exit_code == errors.ArtifactError.exit_code


@pytest.mark.usefixtures("stages")
def test_a_stress_study_tells_its_cases_and_where_they_are(
    scene: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    def study(_inputs: Any, _profile: Any, _monitor: Any) -> dict[str, Any]:
        row = dict.fromkeys(STRESS_COLUMNS, 1.0) | {"case": "as designed", "solved": False, "unloaded": 0.5}
        report = {"cases": 1, "solved": 0, "largest_residual": None}
        return {"stress_csv": stress_csv([row]), "stress_report": report}

    module = ModuleType("stress")
    module.run = study  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "fab4d.stages.stress", module)
    told = fab4d("stress", scene, "--out", tmp_path / "stressed")
    assert told.exit_code == 0, told.output
    assert "NOT SOLVED" in told.output
    assert "solved 0 of 1 cases\n" in told.output
    assert (tmp_path / "stressed" / "stress.csv").read_text().startswith("case,solved")


# -- a row of a tradeoff, picked


@pytest.fixture
def picked(stages: dict[str, Any], monkeypatch: pytest.MonkeyPatch) -> list[Any]:
    """What stage solve was given as picked; the study makes the rows that it is asked for."""
    stages["solve_report"] = {"tau_s": 1.0}
    given: list[Any] = []
    solve = sys.modules["fab4d.stages.solve"].run

    def watched(inputs: Mapping[str, Any], profile: Any, monitor: Any) -> dict[str, Any]:
        given.append(inputs["picked"])
        return solve(inputs, profile, monitor)

    def study(_inputs: Any, _profile: Any, monitor: Any, points: Any = (4,), prices: Any = (1.0,)) -> dict[str, Any]:
        index = monitor.restore("index")
        names = [f"{count}x{price:g}" for count in points for price in prices]
        for name in names:
            monitor.save(name, {"rho": np.full(2, float(name[0])), "row": np.array(f'{{"id": "{name}"}}')})
        monitor.save("index", {"names": np.array([*(index["names"] if index else ()), *names])})
        figures = {"points": 4, "smp_fraction": 0.2, "cost_usd": 1.0, "rms_mm": 0.1, "max_force_N": 9.0}
        row = dict.fromkeys(COLUMNS, "") | figures | {"id": names[0], "acceptable": "yes"}
        csv = csv_bytes(COLUMNS, [row])
        return {"tradeoff_csv": csv, "tradeoff_plot": b"", "tradeoff_report": {"without_a_design": ["2 points: none"]}}

    monkeypatch.setattr(sys.modules["fab4d.stages.solve"], "run", watched)
    module = ModuleType("tradeoff")
    module.run = study  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "fab4d.stages.tradeoff", module)
    return given


def test_a_picked_row_takes_the_place_of_the_search_until_it_is_taken_back(scene: Path, picked: list[Any]) -> None:
    told = fab4d("tradeoff", scene, "--points", "4,6", "--prices", "1,2")
    assert told.exit_code == 0, told.output
    assert "2 points: none" in told.output
    assert "the least SMP has row 4x1" in told.output
    assert fab4d("run", scene, "--pick", "6x2").exit_code == 0
    np.testing.assert_array_equal(picked[-1]["rho"], [6.0, 6.0])
    assert fab4d("run", scene).exit_code == 0  # still picked, so there is nothing to do
    assert len(picked) == 1
    assert fab4d("tradeoff", scene, "--points", "8").exit_code == 0
    assert fab4d("run", scene).exit_code == 0  # more rows do not change the picked one
    assert len(picked) == 1
    assert fab4d("run", scene, "--pick", "none").exit_code == 0
    assert picked[1:] == [None]


def test_what_cannot_be_picked_says_why(scene: Path, picked: list[Any]) -> None:
    missing = fab4d("run", scene, "--pick", "4x1")
    assert missing.exit_code == errors.ArtifactError.exit_code
    assert "run `fab4d tradeoff`" in missing.output
    fab4d("tradeoff", scene)
    unknown = fab4d("run", scene, "--pick", "4x3")
    assert unknown.exit_code == errors.ArtifactError.exit_code
    assert 'no row 4x3; did you mean "4x1"?' in unknown.output
    for unpickable in ("index", "../../lock"):
        assert fab4d("run", scene, "--pick", unpickable).exit_code == errors.ArtifactError.exit_code
    assert picked == []


@pytest.mark.parametrize("pick", [("--pick", "4x1"), ()])
def test_a_row_of_other_inputs_is_refused(scene: Path, picked: list[Any], pick: tuple[str, ...]) -> None:
    fab4d("tradeoff", scene)
    assert fab4d("run", scene, "--pick", "4x1").exit_code == 0
    (scene / "scene.toml").write_text(SCENE + "[goal]\nmax_forces = 5\n")
    refused = fab4d("run", scene, *pick)
    assert refused.exit_code == errors.ArtifactError.exit_code
    assert "other inputs (goal changed)" in refused.output
    assert len(picked) == 1
    assert fab4d("run", scene, "--pick", "none").exit_code == 0
    assert picked[1:] == [None]


@pytest.mark.parametrize("where", [("--from", "threshold"), ("--until", "check")])
def test_a_pick_that_no_stage_would_use_is_refused(scene: Path, where: tuple[str, str]) -> None:
    assert fab4d("run", scene, "--pick", "4x1", *where).exit_code == USAGE_EXIT_CODE


@pytest.mark.parametrize("options", [("--points", "4,x"), ("--points", "0"), ("--prices", "-1"), ("--points", "900")])
def test_mistyped_numbers_of_a_tradeoff_are_refused(scene: Path, options: tuple[str, str]) -> None:
    result = fab4d("tradeoff", scene, *options)
    assert result.exit_code == USAGE_EXIT_CODE
    assert options[0] in result.output
