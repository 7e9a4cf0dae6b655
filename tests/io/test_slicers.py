"""Real slicers on real bodies, as far as they are installed, and the reading of what they write."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from fab4d.errors import MissingToolError, SliceError
from fab4d.io.cards import card_names, load_printer
from fab4d.io.slicers import (
    PrintFiles,
    Slicer,
    cura_speeds,
    filament_length,
    filament_lengths,
    filament_volume,
    find_slicer,
    installed_slicers,
    print_time,
    prusa_profile,
    slice_bodies,
)
from fab4d.io.stl import stl_bytes
from fab4d.io.threemf import Part, prusa_3mf

PRINTER = load_printer("generic-dual-0.4", Path())
CORNERS = np.array([[k & 1, k >> 1 & 1, k >> 2] for k in range(8)], float)
FACES = [[0, 2, 1], [1, 2, 3], [4, 5, 6], [5, 7, 6], [0, 1, 4], [1, 5, 4]]
FACES = np.array([*FACES, [2, 6, 3], [3, 6, 7], [0, 4, 2], [2, 4, 6], [1, 3, 5], [3, 7, 5]])
SLICERS = [pytest.param(s, id=s.kind) for s in installed_slicers()]
needs_a_slicer = pytest.mark.parametrize(
    "slicer", SLICERS or [pytest.param(None, marks=pytest.mark.skip(reason="no slicer is installed"))]
)


def block(name, extruder, low, sides):
    return Part(name, extruder, "#808080", np.array(low) + CORNERS * np.array(sides), FACES)


def files(*parts):
    stls = {part.extruder: stl_bytes(part.vertices, part.faces, part.name) for part in parts}
    return PrintFiles(prusa_3mf("blocks", parts), stls)


# Below the bed and off its middle, as parts come: SMP 20 x 10 x 8 mm beside TPE 30 x 10 x 8 mm.
SMP = block("SMP", 1, (-20, -5, -4), (20, 10, 8))
TPE = block("TPE", 2, (0, -5, -4), (30, 10, 8))


def volumes(slicer, printer, *parts):
    sliced = slice_bodies(slicer, files(*parts), printer, (0, 1.2))
    assert sliced.print_time_s is None or 60 < sliced.print_time_s < 36000
    return [filament_volume(length, printer) for length in sliced.filament_mm]


@needs_a_slicer
@pytest.mark.parametrize("card", ["generic-dual-0.4", "ultimaker-s5"])
def test_each_tool_lays_down_its_body(slicer, card):
    assert volumes(slicer, load_printer(card, Path()), TPE, SMP) == pytest.approx([1600, 2400], rel=0.03)


@needs_a_slicer
@pytest.mark.parametrize(("part", "expected"), [(SMP, [1600, 0]), (TPE, [0, 2400])])
def test_one_body_leaves_the_other_tool_unused(slicer, part, expected):
    assert volumes(slicer, PRINTER, part) == pytest.approx(expected, rel=0.03)


@needs_a_slicer
def test_a_body_for_the_wrong_tool_is_seen(slicer):
    found = volumes(slicer, PRINTER, replace(TPE, extruder=1), replace(SMP, extruder=2))
    assert found == pytest.approx([2400, 1600], rel=0.03)


@pytest.mark.skipif("prusa" not in {s.kind for s in installed_slicers()}, reason="PrusaSlicer is not installed")
def test_with_one_nozzle_everything_goes_to_one_tool(monkeypatch):
    """Why the filament is judged and not the exit code."""
    one = prusa_profile(PRINTER, (0, 0)) | {"nozzle_diameter": "0.4"}
    monkeypatch.setattr("fab4d.io.slicers.prusa_profile", lambda *_: one)
    assert volumes(find_slicer("prusa"), PRINTER, TPE, SMP) == pytest.approx([4000, 0], rel=0.03)


@needs_a_slicer
def test_a_part_beside_the_bed_is_an_error_or_too_little(slicer):
    small = replace(PRINTER, volume=(10.0, 10.0, 10.0))
    try:
        found = volumes(slicer, small, TPE, SMP)
    except SliceError as error:
        assert str(slicer.program) in str(error)  # noqa: PT017
    else:
        assert slicer.kind == "cura"  # it does not look at the bed: the printability checks do
        assert sum(found) == pytest.approx(4000, rel=0.03)


def test_programs_that_fail_are_named():
    for program, message in (("false", "ended with exit code 1"), ("true", "wrote no G-code")):
        with pytest.raises(SliceError, match=f"{program}.*{message}"):
            slice_bodies(Slicer("prusa", Path(f"/usr/bin/{program}")), files(SMP), PRINTER, (0, 0))
    with pytest.raises(SliceError, match="no-such-slicer cannot slice"):
        slice_bodies(Slicer("prusa", Path("/no-such-slicer")), files(SMP), PRINTER, (0, 0))


def test_without_a_slicer_the_message_says_what_to_install(monkeypatch, tmp_path):
    monkeypatch.setenv("PATH", str(tmp_path))
    assert installed_slicers() == []
    with pytest.raises(MissingToolError, match="install PrusaSlicer"):
        find_slicer()


def test_filament_is_what_is_pushed_out_further_than_before():
    gcode = """
    M82 ; absolute
    T0
    G92 E0
    G1 X1 E2 ; E9 in a comment
    G1 E1 F1800
    G1 E2
    G1 X2 E3.5
    G92 E0
    G0 X5
    T1
    M83
    G1 X1 E-1
    G1 E1
    G1 X3 E4
    G1 E-0.5
    T0
    G1 E.25
    """.splitlines()
    assert filament_lengths(gcode) == (3.75, 4.0)


@pytest.mark.parametrize(
    ("text", "seconds"),
    [
        ("x\n; estimated printing time (normal mode) = 1d 2h 3m 4s\n", 93784.0),
        ("Print time (s): 1761\nPrint time (hr|min|s): 0h 29m 21s", 1761.0),
        (";TIME:6666\n", None),
    ],
)
def test_print_times(text, seconds):
    assert print_time(text) == seconds


@pytest.mark.parametrize("name", card_names("printers"))
def test_profiles_are_of_the_card(name):
    printer = load_printer(name, Path())
    profile = prusa_profile(printer, (0, 1.2))
    assert profile["nozzle_diameter"].split(",") == [f"{printer.nozzle:g}"] * 2
    assert profile["bed_shape"].split(",")[2] == f"{printer.volume[0]:g}x{printer.volume[1]:g}"
    assert 0.8 * printer.nozzle < printer.line_width < 1.5 * printer.nozzle
    assert printer.layer_height <= 0.8 * printer.nozzle
    assert len(printer.source) > 40


def test_cura_keeps_to_the_flow_of_the_filament():
    assert set(cura_speeds(PRINTER, 1.2).values()) == {f"{1.2 / (0.42 * 0.2):g}"}
    assert cura_speeds(PRINTER, 0.0)["speed_infill"] == cura_speeds(PRINTER, 100.0)["speed_infill"] == "60"


@pytest.mark.skipif("cura" not in {s.kind for s in installed_slicers()}, reason="CuraEngine is not installed")
def test_a_slower_flow_takes_longer_with_cura():
    fast, slow = (slice_bodies(find_slicer("cura"), files(TPE), PRINTER, (0, flow)).print_time_s for flow in (0, 1.2))
    assert slow > 2 * fast
    assert slow > 2400 / 1.2


def test_filament_length_and_volume():
    printer = replace(PRINTER, filament_diameter=2.0)
    assert filament_volume(10.0, printer) == pytest.approx(10 * math.pi)
    assert filament_length(filament_volume(7.0, printer), printer) == pytest.approx(7.0)
