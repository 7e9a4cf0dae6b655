"""The scene: what the user wants, checked and in mm, N and MPa."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any

from fab4d.errors import SceneError
from fab4d.io.cards import PrinterCard, RigCard, load_material, load_printer, load_rig
from fab4d.io.tables import (
    Key,
    direction,
    fraction,
    list_of,
    non_negative,
    number,
    one_of,
    positive,
    read_keys,
    read_toml,
    text,
    whole,
)
from fab4d.materials.cards import MaterialCard
from fab4d.units import MM_PER_UNIT, mm_per

DEFAULT_CARDS = {"materials": "paper-corrected", "printer": "generic-dual-0.4", "rig": "bench"}


@dataclass(frozen=True)
class ClampRegion:
    """A region held fixed: a box (2, 3) in mm, vertex numbers of the mesh file (from 0), or a named set of it."""

    box: tuple[tuple[float, float, float], tuple[float, float, float]] | None = None
    vertices: tuple[int, ...] | None = None
    set_name: str | None = None


@dataclass(frozen=True)
class Goal:
    """What the user wants. tolerance: largest RMS distance to the temporary shape, mm (None: 5e-3 of the diagonal);
    max_forces: most points to pull (None: the rig's); max_smp_fraction: largest share of SMP in the volume; smp:
    `enough` for the first design that meets the goal, `least` to search on for the one with the least SMP."""

    tolerance: float | None = None
    max_forces: int | None = None
    max_smp_fraction: float | None = None
    smp: str = "enough"


@dataclass(frozen=True)
class Acceptance:
    """The paper's two acceptance checks, as fractions."""

    max_ambiguous_fraction: float = 1e-3
    max_isolated_fraction: float = 0.30


@dataclass(frozen=True)
class Weights:
    """The paper's weights in the dimensionless form of model.md section 4; None leaves the choice to the solver."""

    lam_pfinal: float | None = None
    lam_force: float | None = None
    lam_mat: float | None = None
    lam_smooth: float | None = None
    lam_SMP: float | None = None


@dataclass(frozen=True)
class SolverSettings:
    """method: `reduced`; element of the last fit: `auto`, `linear` or `quadratic`; seed of every random choice."""

    method: str = "reduced"
    element: str = "auto"
    seed: int = 0


@dataclass(frozen=True)
class Gravity:
    """Direction of gravity while programming, unit vector."""

    direction: tuple[float, float, float]


@dataclass(frozen=True)
class Scene:
    """A whole scene. Lengths are already mm; `units` is the length unit of the mesh files."""

    name: str
    units: str
    permanent: Path
    temporary: Path
    materials: MaterialCard
    printer: PrinterCard
    rig: RigCard
    clamp: tuple[ClampRegion, ...] = ()
    goal: Goal = field(default_factory=Goal)
    weights: Weights = field(default_factory=Weights)
    acceptance: Acceptance = field(default_factory=Acceptance)
    solver: SolverSettings = field(default_factory=SolverSettings)
    gravity: Gravity | None = None


_TABLE = Key(lambda value: value)
_CARD = {"card": Key(text)}
_ORIENTATION = {"up": Key(direction)}
_SECTIONS = {
    "name": Key(text),
    "units": Key(one_of(*MM_PER_UNIT), required=True),
    "shape": Key(lambda value: value, required=True),
} | dict.fromkeys(("materials", "printer", "rig", "goal", "weights", "acceptance", "solver", "gravity"), _TABLE)
_SHAPE = {"permanent": Key(text, required=True), "temporary": Key(text, required=True)}
_GOAL = {
    "tolerance": Key(positive),
    "max_forces": Key(whole(1)),
    "max_smp_fraction": Key(fraction),
    "smp": Key(one_of("enough", "least")),
}
_WEIGHTS = {weight.name: Key(non_negative) for weight in fields(Weights)}
_ACCEPTANCE = {limit.name: Key(fraction) for limit in fields(Acceptance)}
_SOLVER = {
    "method": Key(one_of("reduced")),
    "element": Key(one_of("auto", "linear", "quadratic")),
    "seed": Key(whole(0)),
}
_GRAVITY = {"direction": Key(list_of(number, 3), required=True)}
_CLAMP = {
    "box": Key(list_of(list_of(number, 3), 2)),
    "vertices": Key(list_of(whole(0))),
    "set": Key(text),
}


def load_scene(path: Path) -> Scene:
    """The scene in the TOML file `path`, or in scene.toml of the folder `path`.

    Mesh files and own cards are looked up relative to the scene; the mesh files are not opened.
    Raises SceneError for an unknown key, a missing key or a wrong value, MaterialError for an unusable material card.
    """
    file = path / "scene.toml" if path.is_dir() else path
    sections = read_keys(read_toml(file), _SECTIONS, str(file))
    mm = mm_per(sections["units"])
    shape = read_keys(sections["shape"], _SHAPE, f"{file} [shape]")
    rig_section = read_keys(sections.get("rig", {}), {**_CARD, "clamp": _TABLE}, f"{file} [rig]")
    scene = Scene(
        name=sections.get("name", file.resolve().parent.name if file.name == "scene.toml" else file.stem),
        units=sections["units"],
        permanent=file.parent / shape["permanent"],
        temporary=file.parent / shape["temporary"],
        materials=load_material(_card_name("materials", sections, file), file.parent),
        printer=_printer(sections.get("printer", {}), file),
        rig=load_rig(rig_section.get("card", DEFAULT_CARDS["rig"]), file.parent),
        clamp=_clamp(rig_section.get("clamp", []), mm, file),
        goal=_goal(sections.get("goal", {}), mm, file),
        weights=Weights(**read_keys(sections.get("weights", {}), _WEIGHTS, f"{file} [weights]")),
        acceptance=Acceptance(**read_keys(sections.get("acceptance", {}), _ACCEPTANCE, f"{file} [acceptance]")),
        solver=SolverSettings(**read_keys(sections.get("solver", {}), _SOLVER, f"{file} [solver]")),
        gravity=_gravity(sections.get("gravity"), file),
    )
    _refuse_what_does_not_fit(scene, file)
    return scene


def _card_name(section: str, sections: Mapping[str, Any], file: Path) -> str:
    keys = read_keys(sections.get(section, {}), _CARD, f"{file} [{section}]")
    return str(keys.get("card", DEFAULT_CARDS[section]))


def _printer(table: Any, file: Path) -> PrinterCard:
    keys = read_keys(table, _CARD | _ORIENTATION, f"{file} [printer]")
    card = load_printer(keys.get("card", DEFAULT_CARDS["printer"]), file.parent)
    return replace(card, up=keys.get("up", card.up))


def _goal(table: Any, mm: float, file: Path) -> Goal:
    keys = read_keys(table, _GOAL, f"{file} [goal]")
    if "tolerance" in keys:
        keys["tolerance"] *= mm
    return Goal(**keys)


def _clamp(tables: Any, mm: float, file: Path) -> tuple[ClampRegion, ...]:
    if not isinstance(tables, list):
        msg = f"{file}: a clamp region is written [[rig.clamp]], with double brackets"
        raise SceneError(msg)
    return tuple(_clamp_region(table, mm, f"{file} [[rig.clamp]] {k + 1}") for k, table in enumerate(tables))


def _clamp_region(table: Any, mm: float, where: str) -> ClampRegion:
    keys = read_keys(table, _CLAMP, where)
    if len(keys) != 1:
        msg = f"{where} needs exactly one of box, vertices and set, and has {', '.join(keys) or 'none'}"
        raise SceneError(msg)
    if "box" not in keys:
        return ClampRegion(vertices=keys.get("vertices"), set_name=keys.get("set"))
    low, high = keys["box"]
    if any(a > b for a, b in zip(low, high, strict=True)):
        msg = f"{where} box must be [lowest corner, highest corner], not {list(low)} and {list(high)}"
        raise SceneError(msg)
    return ClampRegion(box=(tuple(mm * a for a in low), tuple(mm * b for b in high)))


def _gravity(table: Any, file: Path) -> Gravity | None:
    if table is None:
        return None
    direction = read_keys(table, _GRAVITY, f"{file} [gravity]")["direction"]
    length = math.hypot(*direction)
    if length == 0:
        msg = f"{file} [gravity] direction must not be zero"
        raise SceneError(msg)
    # Without supports the free final shape cannot carry its weight, and supports are not part of a scene.
    msg = f"{file}: gravity needs supports, which a scene cannot describe: remove the section [gravity]"
    raise SceneError(msg)


def _refuse_what_does_not_fit(scene: Scene, file: Path) -> None:
    forces = scene.goal.max_forces
    if forces is not None and forces > scene.rig.max_points:
        msg = (
            f'{file} [goal] max_forces is {forces}, but the rig "{scene.rig.name}" pulls at most '
            f"{scene.rig.max_points} points: ask for fewer or choose another rig card"
        )
        raise SceneError(msg)
