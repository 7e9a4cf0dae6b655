"""Cards: what is known about materials, printers and rigs, read from `profiles/` or from the user's own files."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from fab4d.errors import SceneError
from fab4d.io.data import data_folder
from fab4d.io.tables import (
    Key,
    flag,
    in_range,
    list_of,
    nearest,
    non_negative,
    positive,
    read_keys,
    read_toml,
    text,
    whole,
)
from fab4d.materials.cards import MaterialCard, Moduli


@dataclass(frozen=True)
class PrinterCard:
    """A dual-extruder printer. Lengths in mm; `volume` is usable with both tools."""

    name: str
    volume: tuple[float, float, float]
    line_width: float
    layer_height: float
    filament_diameter: float
    source: str
    nozzle: float = 0.4
    """Diameter of both nozzles."""
    purge_per_change: float = 140.0
    """Purged at a change of tool, mm^3. Source: the default of PrusaSlicer, 70 unloading and 70 loading."""
    tool_change_time: float | None = None
    """Of one change of tool, s; None where the card does not tell."""
    up: tuple[float, float, float] = (0.0, 0.0, 1.0)
    """Direction of the permanent shape that points up while printing, unit vector; from the scene, not the card."""


@dataclass(frozen=True)
class RigCard:
    """An actuator rig: how many points it pulls, how hard (N), through pads of what radius (mm)."""

    name: str
    max_points: int
    max_force: float
    patch_radius: float
    pull_only: bool
    source: str
    larger_patch_radii: tuple[float, ...] = ()
    """Of the other pads it has, for parts that the usual ones stretch too far or pull too hard on too small an area."""
    max_travel: float | None = None
    """How far it moves a point, mm; None where the card does not tell."""

    @property
    def patch_radii(self) -> tuple[float, ...]:
        """Of all its pads, the usual ones first, then by size."""
        return self.patch_radius, *sorted(self.larger_patch_radii)


_MODULI = {"mu_MPa": Key(positive, required=True), "kappa_MPa": Key(positive, required=True)}
_TABLE = Key(lambda value: value, required=True)
_STRETCH = in_range(1, 100, open_low=True)

_MATERIAL = {
    "name": Key(text, required=True),
    "source": Key(text, required=True),
    "measured": Key(flag, required=True),
    "transition_temperature_K": Key(positive, required=True),
    "transition_half_width_K": Key(positive, required=True),
    "tpe": _TABLE,
    "smp": _TABLE,
}
_POLYMER = {
    "density_g_per_cm3": Key(positive, required=True),
    "price_usd_per_kg": Key(non_negative, required=True),
    "max_stretch": Key(_STRETCH, required=True),
    "max_flow_mm3_per_s": Key(positive),
}
_TPE = {"max_service_temperature_K": Key(positive)}
_PRINTER = {
    "name": Key(text, required=True),
    "source": Key(text, required=True),
    "volume_mm": Key(list_of(positive, 3), required=True),
    "line_width_mm": Key(positive, required=True),
    "layer_height_mm": Key(positive, required=True),
    "filament_diameter_mm": Key(positive, required=True),
    "nozzle_mm": Key(positive),
    "purge_per_change_mm3": Key(non_negative),
    "tool_change_time_s": Key(non_negative),
}
_RIG = {
    "name": Key(text, required=True),
    "source": Key(text, required=True),
    "max_points": Key(whole(1), required=True),
    "max_force_N": Key(positive, required=True),
    "patch_radius_mm": Key(positive, required=True),
    "larger_patch_radii_mm": Key(list_of(positive)),
    "pull_only": Key(flag, required=True),
    "max_travel_mm": Key(positive),
}


def load_material(name: str, scene_folder: Path) -> MaterialCard:
    """The material card `name`. Raises SceneError, or MaterialError when it describes no elastic solid."""
    path = _card_path("materials", name, scene_folder)
    card = read_keys(read_toml(path), _MATERIAL, str(path))
    tpe = read_keys(card["tpe"], _POLYMER | _TPE | _MODULI, f"{path} [tpe]")
    smp = read_keys(card["smp"], _POLYMER | {"rubbery": _TABLE, "glassy": _TABLE}, f"{path} [smp]")
    return MaterialCard(
        name=card["name"],
        tpe=_moduli(tpe),
        rubbery=_moduli(read_keys(smp["rubbery"], _MODULI, f"{path} [smp.rubbery]")),
        glassy=_moduli(read_keys(smp["glassy"], _MODULI, f"{path} [smp.glassy]")),
        smp_density=smp["density_g_per_cm3"],
        tpe_density=tpe["density_g_per_cm3"],
        smp_price=smp["price_usd_per_kg"],
        tpe_price=tpe["price_usd_per_kg"],
        smp_max_stretch=smp["max_stretch"],
        tpe_max_stretch=tpe["max_stretch"],
        transition_temperature=card["transition_temperature_K"],
        transition_half_width=card["transition_half_width_K"],
        measured=card["measured"],
        source=card["source"],
        tpe_service_temperature=tpe.get("max_service_temperature_K"),
        smp_max_flow=smp.get("max_flow_mm3_per_s"),
        tpe_max_flow=tpe.get("max_flow_mm3_per_s"),
    )


def load_printer(name: str, scene_folder: Path) -> PrinterCard:
    """The printer card `name`. Raises SceneError."""
    path = _card_path("printers", name, scene_folder)
    return PrinterCard(**_without_units(read_keys(read_toml(path), _PRINTER, str(path))))


def load_rig(name: str, scene_folder: Path) -> RigCard:
    """The rig card `name`. Raises SceneError."""
    path = _card_path("rigs", name, scene_folder)
    return RigCard(**_without_units(read_keys(read_toml(path), _RIG, str(path))))


def card_names(kind: str) -> list[str]:
    """Names of the cards of `kind` (materials, printers, rigs) that come with fab4d."""
    return sorted(path.stem for path in (data_folder("profiles") / kind).glob("*.toml"))


def _card_path(kind: str, name: str, scene_folder: Path) -> Path:
    """A card by path (it ends in .toml, relative to the scene) or by the name of one that comes with fab4d."""
    if name.endswith(".toml"):
        return scene_folder / name
    known = card_names(kind)
    if name not in known:
        msg = (
            f'{scene_folder}: no card "{name}" among the {kind}; {nearest(name, known)} '
            "An own card is given as a path that ends in .toml"
        )
        raise SceneError(msg)
    return data_folder("profiles") / kind / f"{name}.toml"


def _moduli(table: Mapping[str, Any]) -> Moduli:
    return Moduli(mu=table["mu_MPa"], kappa=table["kappa_MPa"])


def _without_units(table: Mapping[str, Any]) -> dict[str, Any]:
    """The keys without the unit that they end in: volume_mm is the field volume."""
    return {
        key.removesuffix("_mm").removesuffix("_mm3").removesuffix("_N").removesuffix("_s"): value
        for key, value in table.items()
    }
