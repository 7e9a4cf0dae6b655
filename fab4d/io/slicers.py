"""Slicers that are installed: a profile made from the printer card, a slice, and the filament that each tool uses.

Slicers end with exit code 0 when they drop a body or print everything with one tool, so a slice is judged by the
extrusion in its G-code and by nothing else.
"""

import math
import os
import re
import shutil
import subprocess
import tempfile
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from fab4d.errors import MissingToolError, SliceError
from fab4d.io.cards import PrinterCard
from fab4d.io.stl import stl_arrays

TOOLS = 2
TIME_LIMIT_S = 1800.0
_PRUSA_PROGRAMS = ("prusa-slicer", "PrusaSlicer", "prusa-slicer-console")
_CURA_PROGRAMS = ("CuraEngine", "curaengine")
# CuraEngine's own variable for the folders of definitions.
_CURA_PATH = "CURA_ENGINE_SEARCH_PATH"
_CURA_DEFINITIONS = ("/usr/share/cura/resources/definitions", "/usr/local/share/cura/resources/definitions")
# Of Cura's definition of a printer in general.
_CURA_SPEEDS = {"speed_wall_0": 30.0, "speed_wall_x": 60.0, "speed_infill": 60.0, "speed_topbottom": 30.0}
_DURATION = re.compile(r"(\d+)([dhms])")
_SECONDS = {"d": 86400, "h": 3600, "m": 60, "s": 1}
_TIME_FORMS = re.compile(
    r"^(?:; estimated printing time \(normal mode\) = (.+)|Print time \(s\): (\d+))$", re.MULTILINE
)


@dataclass(frozen=True)
class Slicer:
    """An installed slicer: `prusa` or `cura`, its program, and for Cura the folder of definitions."""

    kind: str
    program: Path
    definitions: Path | None = None


@dataclass(frozen=True)
class PrintFiles:
    """What is sliced: the 3MF file for PrusaSlicer, and the STL file of each extruder (from 1)."""

    part_3mf: bytes
    stls: Mapping[int, bytes]


@dataclass(frozen=True)
class Slice:
    """Filament (mm) of each extruder in turn, and the print time that the slicer expects (s; None: it tells none).

    Neither slicer counts the changes of tool.
    """

    filament_mm: tuple[float, ...]
    print_time_s: float | None


def installed_slicers() -> list[Slicer]:
    """PrusaSlicer and CuraEngine, as far as they are installed; an engine without Cura's definitions does not count."""
    prusa, cura, definitions = _program(_PRUSA_PROGRAMS), _program(_CURA_PROGRAMS), _cura_definitions()
    found = [Slicer("prusa", prusa)] if prusa else []
    return [*found, Slicer("cura", cura, definitions)] if cura and definitions else found


def find_slicer(kind: str | None = None) -> Slicer:
    """The installed slicer of `kind` (None: the first). Raises MissingToolError."""
    slicers = [slicer for slicer in installed_slicers() if kind in (None, slicer.kind)]
    if not slicers:
        msg = (
            "no slicer was found: install PrusaSlicer (prusa-slicer) or Cura (CuraEngine; the folder with its "
            f"fdmprinter.def.json goes into {_CURA_PATH}) and put the program on the PATH"
        )
        raise MissingToolError(msg)
    return slicers[0]


def slice_bodies(slicer: Slicer, files: PrintFiles, printer: PrinterCard, flows: Iterable[float]) -> Slice:
    """Slice the bodies solid, without tower, skirt or supports, so that filament and volume can be compared.

    flows : fastest extrusion of each extruder, mm^3/s; 0 is not limited

    Raises SliceError when the slicer fails or writes no G-code.
    """
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        if slicer.kind == "prusa":
            command = _prusa_command(slicer, files, printer, flows, folder)
        else:
            command = _cura_command(slicer, files, printer, flows, folder)
        said = _run(command, slicer, folder)
        return _slice_of(folder / "part.gcode", slicer, said)


def _slice_of(gcode: Path, slicer: Slicer, said: str) -> Slice:
    if not gcode.is_file() or not gcode.stat().st_size:
        msg = f"{slicer.program} wrote no G-code: {_last_lines(said)}"
        raise SliceError(msg)
    text = gcode.read_text(encoding="utf-8", errors="replace")
    return Slice(filament_lengths(text.splitlines()), print_time(text + "\n" + said))


def filament_lengths(gcode: Iterable[str]) -> tuple[float, ...]:
    """Filament (mm) that each tool pushed out further than ever before: retractions and their return count nothing.

    Reads E of G0 and G1, absolute (M82) or relative (M83), G92 E and T.
    """
    tool, position, relative = 0, 0.0, False
    advanced, furthest = [0.0] * TOOLS, [0.0] * TOOLS
    for line in gcode:
        word, *arguments = line.split(";", 1)[0].split() or [""]
        if word in ("M82", "M83"):
            relative = word == "M83"
        elif word in ("T0", "T1"):
            tool = int(word[1])
        elif word in ("G0", "G1", "G92"):
            e = next((float(a[1:]) for a in arguments if a[0] == "E"), None)
            if e is None:
                continue
            if word != "G92":
                advanced[tool] += e if relative else e - position
                furthest[tool] = max(furthest[tool], advanced[tool])
            position = e
    return tuple(furthest)


def print_time(text: str) -> float | None:
    """The time (s) that a slicer tells in its G-code or output, None when it tells none."""
    found = _TIME_FORMS.search(text)
    if found is None:
        return None
    words, seconds = found.groups()
    return float(seconds) if seconds else float(sum(int(n) * _SECONDS[unit] for n, unit in _DURATION.findall(words)))


def filament_volume(length: float, printer: PrinterCard) -> float:
    """Volume (mm^3) of a length (mm) of filament."""
    return length * math.pi * printer.filament_diameter**2 / 4.0


def filament_length(volume: float, printer: PrinterCard) -> float:
    """Length (mm) of filament that holds a volume (mm^3)."""
    return volume / filament_volume(1.0, printer)


def prusa_profile(printer: PrinterCard, flows: Iterable[float]) -> dict[str, str]:
    """Settings of PrusaSlicer for two tools that lay down the bodies and nothing else."""
    width, depth, height = printer.volume
    return {
        "printer_technology": "FFF",
        "gcode_flavor": "marlin2",
        "bed_shape": f"0x0,{width:g}x0,{width:g}x{depth:g},0x{depth:g}",
        "max_print_height": f"{height:g}",
        # The length of this list is the number of tools: with one, everything would be printed with the first.
        "nozzle_diameter": _twice(printer.nozzle),
        "filament_diameter": _twice(printer.filament_diameter),
        "filament_max_volumetric_speed": ",".join(f"{flow:g}" for flow in flows),
        "extruder_offset": "0x0,0x0",
        "single_extruder_multi_material": "0",
        "use_relative_e_distances": "1",
        "layer_gcode": "G92 E0",
        "start_gcode": "",
        "end_gcode": "",
        "layer_height": f"{printer.layer_height:g}",
        "first_layer_height": f"{printer.layer_height:g}",
        "extrusion_width": f"{printer.line_width:g}",
        "first_layer_extrusion_width": f"{printer.line_width:g}",
        "interface_shells": "1",
        "fill_density": "100%",
        "fill_pattern": "rectilinear",
        # At which infill and perimeters lay down the volume of a block: the default, 25 %, gives up to 3 % more.
        "infill_overlap": "15%",
        "support_material": "0",
        "wipe_tower": "0",
        "skirts": "0",
        "brim_width": "0",
    }


def cura_settings(printer: PrinterCard) -> dict[str, str]:
    """Settings of CuraEngine that hold for both tools; it evaluates no formula, so dependent ones are given too."""
    layer, line = f"{printer.layer_height:g}", f"{printer.line_width:g}"
    widths = ("line_width", "wall_line_width_0", "wall_line_width_x", "infill_line_width", "skin_line_width")
    return dict.fromkeys(widths, line) | {
        "layer_height": layer,
        "layer_height_0": layer,
        "infill_sparse_thickness": layer,
        "infill_line_distance": line,
        "infill_pattern": "lines",
        # With it a block gets up to 3 % more than its volume.
        "infill_overlap_mm": "0",
        "top_layers": "0",
        "bottom_layers": "0",
        "initial_bottom_layers": "0",
        "meshfix_union_all": "false",
        # The bodies share their interface: the default grows one of them into the other.
        "multiple_mesh_overlap": "0",
        "carve_multiple_volumes": "false",
        "filter_out_tiny_gaps": "false",
        "minimum_polygon_circumference": "0",
        "material_diameter": f"{printer.filament_diameter:g}",
        "machine_nozzle_size": f"{printer.nozzle:g}",
    }


def cura_speeds(printer: PrinterCard, flow: float) -> dict[str, str]:
    """Speeds (mm/s) of a tool that extrudes at most `flow` (mm^3/s; 0: no limit), which CuraEngine knows nothing of."""
    fastest = flow / (printer.line_width * printer.layer_height) if flow > 0 else math.inf
    return {name: f"{min(speed, fastest):g}" for name, speed in _CURA_SPEEDS.items()}


def _cura_machine(printer: PrinterCard) -> dict[str, str]:
    width, depth, height = (f"{side:g}" for side in printer.volume)
    return cura_settings(printer) | {
        "machine_width": width,
        "machine_depth": depth,
        "machine_height": height,
        "machine_extruder_count": str(TOOLS),
        "extruders_enabled_count": str(TOOLS),
        "machine_start_gcode": "",
        "machine_end_gcode": "",
        "center_object": "false",
        "adhesion_type": "none",
        "prime_tower_enable": "false",
    }


def _prusa_command(
    slicer: Slicer, files: PrintFiles, printer: PrinterCard, flows: Iterable[float], folder: Path
) -> list[str]:
    profile = prusa_profile(printer, flows)
    (folder / "dual.ini").write_text("".join(f"{key} = {value}\n" for key, value in profile.items()), encoding="utf-8")
    (folder / "part.3mf").write_bytes(files.part_3mf)
    options = ["--loglevel", "1", "--load", "dual.ini", "--export-gcode", "--output", "part.gcode", "part.3mf"]
    return [str(slicer.program), *options]


def _cura_command(
    slicer: Slicer, files: PrintFiles, printer: PrinterCard, flows: Iterable[float], folder: Path
) -> list[str]:
    if slicer.definitions is None:
        msg = f"{slicer.program}: {_CURA_PATH} names no folder with fdmprinter.def.json"
        raise MissingToolError(msg)
    command = [str(slicer.program), "slice", "-v", "-j", str(slicer.definitions / "fdmprinter.def.json")]
    command += [*_as_options(_cura_machine(printer)), "-o", "part.gcode"]
    for tool, flow in enumerate(flows):
        settings = _as_options(cura_settings(printer) | cura_speeds(printer, flow) | {"extruder_nr": str(tool)})
        command += [f"-e{tool}", "-j", str(slicer.definitions / "fdmextruder.def.json"), *settings]
    place = _as_options(_on_the_bed(files, printer))
    for extruder, stl in sorted(files.stls.items()):
        (folder / f"{extruder}.stl").write_bytes(stl)
        command += [f"-e{extruder - 1}", "-l", f"{extruder}.stl", "-s", f"extruder_nr={extruder - 1}", *place]
    return command


def _on_the_bed(files: PrintFiles, printer: PrinterCard) -> dict[str, str]:
    """The same shift of every body, into the middle of the bed: what is below it CuraEngine leaves out."""
    corners = np.concatenate([stl_arrays(stl, f"{extruder}.stl")[0] for extruder, stl in files.stls.items()])
    low, high = corners.min(axis=0), corners.max(axis=0)
    middle = 0.5 * np.array(printer.volume) - 0.5 * (low + high)
    shift = (middle[0], middle[1], -low[2])
    return {f"mesh_position_{axis}": f"{value:.6f}" for axis, value in zip("xyz", shift, strict=True)}


def _as_options(settings: Mapping[str, str]) -> list[str]:
    return [word for key, value in settings.items() for word in ("-s", f"{key}={value}")]


def _twice(value: float) -> str:
    return ",".join([f"{value:g}"] * TOOLS)


def _run(command: list[str], slicer: Slicer, folder: Path) -> str:
    # Standard error too: CuraEngine tells everything there.
    search = {_CURA_PATH: str(slicer.definitions)} if slicer.definitions else {}
    try:
        done = subprocess.run(
            command,
            cwd=folder,
            env=os.environ | search,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            timeout=TIME_LIMIT_S,
            check=False,
        )
    except (OSError, subprocess.TimeoutExpired) as error:
        msg = f"{slicer.program} cannot slice the bodies: {error}"
        raise SliceError(msg) from error
    said = done.stdout.decode("utf-8", "replace")
    if done.returncode:
        msg = f"{slicer.program} ended with exit code {done.returncode}: {_last_lines(said)}"
        raise SliceError(msg)
    return said


def _last_lines(text: str) -> str:
    return " / ".join(line.strip()[:200] for line in text.splitlines()[-3:]) or "it said nothing"


def _program(names: Iterable[str]) -> Path | None:
    return next((Path(found) for found in map(shutil.which, names) if found), None)


def _cura_definitions() -> Path | None:
    named = os.environ.get(_CURA_PATH, "").split(os.pathsep)
    folders = [Path(folder) for folder in [*named, *_CURA_DEFINITIONS] if folder]
    return next((folder for folder in folders if (folder / "fdmprinter.def.json").is_file()), None)
