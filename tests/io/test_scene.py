"""Scenes and cards: what is accepted, what is refused, and that lengths become mm."""

from pathlib import Path
from typing import Any

import pytest

from fab4d.errors import Fab4dError, MaterialError, SceneError
from fab4d.io.cards import card_names, load_material, load_printer, load_rig
from fab4d.io.scene import Acceptance, ClampRegion, Goal, Scene, SolverSettings, Weights, load_scene

MINIMAL = 'units = "mm"\n[shape]\npermanent = "p.vtu"\ntemporary = "t.vtu"\n'
CARDS = Path(__file__).parents[2] / "profiles"


def scene(folder: Path, text: str) -> Scene:
    (folder / "scene.toml").write_text(text, encoding="utf-8")
    return load_scene(folder)


def test_a_minimal_scene_gets_the_defaults(tmp_path: Path) -> None:
    found = scene(tmp_path, MINIMAL)
    assert found.name == tmp_path.name
    assert found.permanent == tmp_path / "p.vtu"
    assert (found.materials.name, found.printer.name, found.rig.name) == (
        "paper-corrected",
        "generic-dual-0.4",
        "bench",
    )
    assert found.clamp == ()
    assert found.gravity is None
    assert (found.goal, found.weights, found.acceptance) == (Goal(), Weights(), Acceptance())
    assert found.solver == SolverSettings()


FULL = """
name = "bar"
units = "cm"
[shape]
permanent = "a.msh"
temporary = "b.msh"
[materials]
card = "fig7"
[printer]
card = "prusa-xl"
[rig]
card = "bench"
[[rig.clamp]]
box = [[-0.1, 0, 0], [2.8, 1, 3]]
[[rig.clamp]]
vertices = [3, 0]
[[rig.clamp]]
set = "foot"
[goal]
tolerance = 0.15
max_forces = 8
max_smp_fraction = 0.4
[weights]
lam_SMP = 2
[solver]
method = "reduced"
element = "quadratic"
seed = 3
[acceptance]
max_isolated_fraction = 0.2
"""


def test_a_full_scene_is_read_and_lengths_become_mm(tmp_path: Path) -> None:
    found = scene(tmp_path, FULL)
    assert (found.name, found.units) == ("bar", "cm")
    assert (found.materials.name, found.printer.name) == ("fig7", "prusa-xl")
    assert found.clamp == (
        ClampRegion(box=((-1.0, 0.0, 0.0), (28.0, 10.0, 30.0))),
        ClampRegion(vertices=(3, 0)),
        ClampRegion(set_name="foot"),
    )
    assert found.goal == Goal(tolerance=1.5, max_forces=8, max_smp_fraction=0.4)
    assert found.weights == Weights(lam_SMP=2.0)
    assert found.solver == SolverSettings("reduced", "quadratic", 3)
    assert found.acceptance == Acceptance(max_isolated_fraction=0.2)


def test_a_scene_is_a_folder_or_a_file(tmp_path: Path) -> None:
    (tmp_path / "arm.toml").write_text(MINIMAL, encoding="utf-8-sig")
    assert load_scene(tmp_path / "arm.toml").name == "arm"


REFUSALS = [
    ("unit = 'mm'\n" + MINIMAL, r'scene\.toml: unknown key "unit"; did you mean "units"\?'),
    (MINIMAL + "[goal]\ntolerence = 1", r'\[goal\]: unknown key "tolerence"; did you mean "tolerance"\?'),
    (MINIMAL + "[weights]\nlam_smp = 1", r'\[weights\]: unknown key "lam_smp"; did you mean "lam_SMP"\?'),
    (MINIMAL + "[rig]\nmax_points = 3", r'\[rig\]: unknown key "max_points"; known: card, clamp'),
    (MINIMAL + "[[rig.clamp]]\nbocks = 3", r'\[\[rig\.clamp\]\] 1: unknown key "bocks"; did you mean "box"\?'),
    (MINIMAL.replace('"mm"', '"ft"'), r'units must be "mm" or "cm" or "m" or "in", not \'ft\''),
    (MINIMAL.replace('units = "mm"', ""), r'the key "units" is missing'),
    ('units = "mm"', r'the key "shape" is missing'),
    ('units = "mm"\n[shape]\npermanent = "p"', r'\[shape\]: the key "temporary" is missing'),
    ("shape = 3\n" + 'units = "mm"', r"\[shape\] must be a table of keys, not 3"),
    (MINIMAL + "[goal]\ntolerance = 0", r"\[goal\] tolerance must be a number above 0 up, not 0"),
    (MINIMAL + "[goal]\ntolerance = nan", r"\[goal\] tolerance must be a number"),
    (MINIMAL + "[goal]\ntolerance = true", r"\[goal\] tolerance must be a number"),
    (MINIMAL + "[goal]\nmax_forces = 2.5", r"max_forces must be a whole number from 1 up, not 2\.5"),
    (MINIMAL + "[goal]\nmax_forces = 17", r'max_forces is 17, but the rig "bench" pulls at most 16'),
    (MINIMAL + "[goal]\nmax_smp_fraction = 1.1", r"max_smp_fraction must be a number from 0 to 1, not 1\.1"),
    (MINIMAL + "[solver]\nelement = 'cubic'", r'element must be "auto" or "linear" or "quadratic"'),
    (MINIMAL + "[materials]\ncard = 'paper-corected'", r'no card "paper-corected" .* did you mean "paper-corrected"'),
    (MINIMAL + "[materials]\ncard = 'mine.toml'", r"mine\.toml: cannot be read"),
    (MINIMAL + "[rig]\nclamp = {box = 1}", r"written \[\[rig\.clamp\]\]"),
    (MINIMAL + "[[rig.clamp]]", r"exactly one of box, vertices and set, and has none"),
    (MINIMAL + "[[rig.clamp]]\nset = 'a'\nvertices = [1]", r"exactly one of .* has set, vertices"),
    (MINIMAL + "[[rig.clamp]]\nbox = [[0, 0, 0], [1, 1]]", r"a list of 2, each a list of 3"),
    (MINIMAL + "[[rig.clamp]]\nbox = [[0, 0, 2], [1, 1, 1]]", r"\[lowest corner, highest corner\]"),
    (MINIMAL + "[[rig.clamp]]\nvertices = [-1]", r"whole number from 0 up"),
    (MINIMAL + "[[rig.clamp]]\nvertices = []", r"a list that is not empty"),
    (MINIMAL + "[gravity]\ndirection = [0, 0, -1]", r"gravity needs supports"),
    (MINIMAL + "[gravity]\ndirection = [0, 0, 0]", r"direction must not be zero"),
    (MINIMAL + "[gravity]", r'\[gravity\]: the key "direction" is missing'),
    (MINIMAL + 'name = "a\\nb"', r"unknown key|line of text"),
    ('name = ""\n' + MINIMAL, r"name must be a line of text"),
    ("units = mm", r"scene\.toml: not valid TOML: .*line 1"),
]


@pytest.mark.parametrize(("text", "message"), REFUSALS)
def test_a_wrong_scene_is_refused_with_the_place(tmp_path: Path, text: str, message: str) -> None:
    with pytest.raises(SceneError, match=message):
        scene(tmp_path, text)


def test_files_that_are_no_scene_are_refused(tmp_path: Path) -> None:
    with pytest.raises(SceneError, match=r"scene\.toml: cannot be read \(No such file"):
        load_scene(tmp_path)
    (tmp_path / "scene.toml").write_bytes(b"name = '\xff'")
    with pytest.raises(SceneError, match="byte 8 is not UTF-8"):
        load_scene(tmp_path)


LOADERS: dict[str, Any] = {"materials": load_material, "printers": load_printer, "rigs": load_rig}


@pytest.mark.parametrize("kind", LOADERS)
def test_every_card_that_comes_along_loads_under_its_name(kind: str) -> None:
    names = card_names(kind)
    assert len(names) >= {"materials": 3, "printers": 3, "rigs": 1}[kind]
    for name in names:
        card = LOADERS[kind](name, Path())
        assert card.name == name
        assert len(card.source) > 20


def test_a_rig_card_may_state_its_travel(tmp_path: Path) -> None:
    own = (CARDS / "rigs" / "bench.toml").read_text(encoding="utf-8")
    (tmp_path / "own.toml").write_text(own + "\nmax_travel_mm = 80\n")
    assert load_rig("own.toml", tmp_path).max_travel == 80.0
    assert load_rig("bench", tmp_path).max_travel is None


def test_a_rig_card_may_state_larger_pads(tmp_path: Path) -> None:
    lines = (CARDS / "rigs" / "bench.toml").read_text(encoding="utf-8").splitlines()
    usual = "\n".join(line for line in lines if not line.startswith("larger_patch_radii_mm"))
    for name, more, radii in (("usual", "", (4.0,)), ("more", "\nlarger_patch_radii_mm = [9, 6]", (4.0, 6.0, 9.0))):
        (tmp_path / f"{name}.toml").write_text(usual + more)
        assert load_rig(f"{name}.toml", tmp_path).patch_radii == radii


def test_the_three_presets_differ_where_the_paper_is_misprinted() -> None:
    corrected, printed, fig7 = (load_material(name, Path()) for name in ("paper-corrected", "paper-printed", "fig7"))
    assert corrected.warnings() == []
    assert corrected.glassy.kappa / corrected.glassy.mu == pytest.approx(6.07, abs=0.01)
    assert printed.glassy.poisson_ratio == pytest.approx(-0.031, abs=5e-4)
    assert len(printed.warnings()) == 1
    assert fig7.glassy == fig7.tpe
    assert corrected.tpe == printed.tpe
    assert corrected.rubbery == printed.rubbery
    assert not corrected.measured


OWN = (CARDS / "materials" / "paper-corrected.toml").read_text(encoding="utf-8")


def test_an_own_card_is_found_beside_the_scene(tmp_path: Path) -> None:
    (tmp_path / "own.toml").write_text(OWN.replace('name = "paper-corrected"', 'name = "spool 12"'), encoding="utf-8")
    assert scene(tmp_path, MINIMAL + "[materials]\ncard = 'own.toml'").materials.name == "spool 12"


@pytest.mark.parametrize(
    ("old", "new", "error", "message"),
    [
        ("mu_MPa = 11.8", "mu_MPa = -1", SceneError, r"\[smp\.rubbery\] mu_MPa must be a number above 0"),
        ("mu_MPa = 11.8", "mu_Mpa = 11.8", SceneError, r'unknown key "mu_Mpa"; did you mean "mu_MPa"'),
        ("measured = false", "measured = 0", SceneError, "measured must be true or false, not 0"),
        ("price_usd_per_kg = 30\n", "", SceneError, r'\[tpe\]: the key "price_usd_per_kg" is missing'),
        ("max_stretch = 3.0", "max_stretch = 1", SceneError, "max_stretch must be a number above 1"),
    ],
)
def test_a_wrong_card_is_refused(tmp_path: Path, old: str, new: str, error: type[Fab4dError], message: str) -> None:
    (tmp_path / "own.toml").write_text(OWN.replace(old, new, 1), encoding="utf-8")
    with pytest.raises(error, match=message):
        load_material("own.toml", tmp_path)


def test_material_errors_are_errors_that_a_user_can_fix() -> None:
    assert issubclass(MaterialError, Fab4dError)


def test_the_printer_may_say_what_points_up(tmp_path: Path) -> None:
    assert scene(tmp_path, MINIMAL).printer.up == (0.0, 0.0, 1.0)
    assert scene(tmp_path, MINIMAL + "[printer]\nup = [3, 0, -4]\n").printer.up == pytest.approx((0.6, 0.0, -0.8))


@pytest.mark.parametrize(
    ("value", "message"),
    [("[0, 0, 0]", "not all zero"), ("[0, 1]", "a list of 3"), ('"z"', "a list of 3"), ("[nan, 0, 1]", "finite")],
)
def test_a_direction_that_is_none_is_refused(tmp_path: Path, value: str, message: str) -> None:
    with pytest.raises(SceneError, match=rf"\[printer\] up must be .*{message}"):
        scene(tmp_path, MINIMAL + f"[printer]\nup = {value}\n")
