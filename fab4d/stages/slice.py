"""The bodies through an installed slicer: does each tool lay down the volume of its body?"""

from collections.abc import Mapping
from typing import Any

from fab4d.errors import MissingToolError, SliceError
from fab4d.io.cards import PrinterCard
from fab4d.io.slicers import PrintFiles, Slice, Slicer, filament_volume, find_slicer, slice_bodies
from fab4d.stages.bodies import EXTRUDERS
from fab4d.stages.monitor import Monitor

LARGEST_DIFFERENCE = 0.03
"""Of the body's volume. Source: what PrusaSlicer and CuraEngine keep on the samples."""


def run(inputs: Mapping[str, Any], _profile: Mapping[str, Any], monitor: Monitor) -> dict[str, Any]:
    """Filament and time of a test slice; nothing but the reason where no slicer is installed.

    What is wrong is told by the checks of the report: which slicer is installed must not decide about a design.
    """
    try:
        slicer = find_slicer()
    except MissingToolError as error:
        return {"slice_report": {"checks": [], "left_out": [{"what": "test slice", "why": str(error)}]}}
    monitor.progress(f"slice with {slicer.program.name}")
    try:
        report = slice_report(slicer, inputs)
    except SliceError as error:
        report = {"checks": [_failed(slicer, error)], "left_out": []}
    return {"slice_report": report}


def _failed(slicer: Slicer, error: SliceError) -> dict[str, Any]:
    return {"check": f"{slicer.program.name} slices the bodies", "ok": False, "value": None, "message": str(error)}


def slice_report(slicer: Slicer, inputs: Mapping[str, Any]) -> dict[str, Any]:
    """The slice of the files of stage `bodies` compared with its report. Raises SliceError when the slicer fails."""
    bodies = inputs["bodies_report"]["bodies"]
    printer = _printer(inputs["bodies_report"]["printer"])
    stls = {EXTRUDERS["smp"]: inputs["smp_stl"], EXTRUDERS["tpe"]: inputs["tpe_stl"]}
    flows = [bodies.get(name, {}).get("max_flow_mm3_per_s") or 0.0 for name in EXTRUDERS]
    files = PrintFiles(inputs["part_3mf"], {tool: stl for tool, stl in stls.items() if stl is not None})
    found = slice_bodies(slicer, files, printer, flows)
    volumes = {name: bodies.get(name, {}).get("volume_mm3", 0.0) for name in EXTRUDERS}
    figures = {name: _figures(name, volumes[name], found, printer) for name in EXTRUDERS}
    return {
        "slicer": slicer.program.name,
        "bodies": figures,
        **_print_time(found, printer, inputs["bodies_report"]["purge"]["tool_changes"]),
        "checks": [_check(name, figures[name]) for name in EXTRUDERS],
        "left_out": [],
    }


def _print_time(found: Slice, printer: PrinterCard, tool_changes: int) -> dict[str, Any]:
    """The slicer's time with what the card says of changes of tool, and in words what it leaves out."""
    seconds, change = found.print_time_s, printer.tool_change_time
    if seconds is None:
        return {"print_time_s": None, "print_time_without": []}
    without = ["heating"] if change is not None else ["heating", f"{tool_changes} changes of tool"]
    return {"print_time_s": seconds + tool_changes * (change or 0.0), "print_time_without": without}


def _printer(table: Mapping[str, Any]) -> PrinterCard:
    return PrinterCard(**dict(table) | {name: tuple(table[name]) for name in ("volume", "up")})


def _figures(name: str, volume: float, found: Slice, printer: PrinterCard) -> dict[str, Any]:
    length = found.filament_mm[EXTRUDERS[name] - 1]
    return {
        "extruder": EXTRUDERS[name],
        "volume_mm3": volume,
        "sliced_mm3": filament_volume(length, printer),
        "filament_m": length / 1000.0,
    }


def _check(name: str, figures: Mapping[str, Any]) -> dict[str, Any]:
    """A tool without a body must lay down nothing, one with a body its volume."""
    volume, sliced = figures["volume_mm3"], figures["sliced_mm3"]
    difference = abs(sliced - volume) / volume if volume else float(sliced > 0.0)
    return {
        "check": f"{name.upper()} laid down by tool {figures['extruder']} against its body",
        "ok": difference <= LARGEST_DIFFERENCE,
        "value": difference,
        "sense": "at most",
        "limit": LARGEST_DIFFERENCE,
        "unit": "of the volume",
    }
