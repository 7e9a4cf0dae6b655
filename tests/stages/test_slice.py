"""The test slice: real slicers keep the bodies' volumes, wrong ones are told, none is no failure."""

from pathlib import Path

import numpy as np
import pytest

from fab4d.io.cards import load_material, load_printer
from fab4d.io.meshes import RawMesh, read_mesh
from fab4d.io.slicers import Slice, Slicer, filament_length, installed_slicers
from fab4d.stages import bodies
from fab4d.stages import slice as slicing
from fab4d.stages._labelled import labelled_bodies
from fab4d.stages.monitor import SilentMonitor

PRINTER = load_printer("generic-dual-0.4", Path())
PROFILE = {"name": "box", "printer": PRINTER, "materials": load_material("paper-corrected", Path())}
SAMPLES = Path(__file__).parents[2] / "samples"
every_sample = pytest.mark.parametrize("sample", ["strip", "twist-bar", "tower", "gripper", "fin", "smiley", "snake"])
FAKE = Slicer("prusa", Path("fake"))


@pytest.fixture(scope="module")
def files(mesh):
    smp = mesh["X"][mesh["tets"]].mean(axis=1)[:, 0] < 10
    return bodies.run(
        {"mesh": mesh, "labels": {"smp": smp}, "verdict_report": {"reasons": []}}, PROFILE, SilentMonitor()
    )


def run(files):
    return slicing.run(files, {}, SilentMonitor())["slice_report"]


@pytest.fixture(params=["prusa", "cura"])
def slicer(request):
    found = [slicer for slicer in installed_slicers() if slicer.kind == request.param]
    return found[0] if found else pytest.skip(f"{request.param} is not installed")


def test_bodies_are_laid_down_by_their_tools(files, slicer):
    report = slicing.slice_report(slicer, files)
    assert [check["ok"] for check in report["checks"]] == [True, True]
    assert report["bodies"]["smp"]["sliced_mm3"] == pytest.approx(5000, rel=0.03)
    assert report["bodies"]["tpe"]["sliced_mm3"] == pytest.approx(10000, rel=0.03)
    assert report["print_time_s"] > 600


@pytest.mark.parametrize("size", [1.5, 2.0])
def test_coin_toss_labels_are_laid_down_too(mesh, slicer, size):
    raw = RawMesh(mesh["X"] * size / 5, mesh["tets"], {}, "box.vtu")
    smp = np.random.default_rng(1).random(len(raw.tets)) < 0.5
    files = labelled_bodies(raw, smp, 1.0, "box", PROFILE["printer"], PROFILE["materials"])
    report = slicing.slice_report(slicer, files)
    assert min(body["volume_mm3"] for body in report["bodies"].values()) > 0.2 * 120 * size**3
    assert [check["ok"] for check in report["checks"]] == [True, True]


def stripes(centres):
    """Five, of both materials in turn, across the longest side."""
    along = centres[:, np.argmax(np.ptp(centres, axis=0))]
    return np.floor(4.999 * (along - along.min()) / np.ptp(along)).astype(int) % 2 == 0


def coins(centres):
    return np.random.default_rng(1).random(len(centres)) < 0.5


def sliced_sample(slicer, sample, labels):
    raw = read_mesh(SAMPLES / sample / "perm.vtu")
    smp = labels(raw.points[raw.tets].mean(axis=1))
    files = labelled_bodies(raw, smp, 1.0, sample, PROFILE["printer"], PROFILE["materials"])
    return slicing.slice_report(slicer, files)


@every_sample
def test_samples_are_laid_down_in_stripes_too(slicer, sample):
    report = sliced_sample(slicer, sample, stripes)
    assert [(check["ok"], check["value"]) for check in report["checks"] if not check["ok"]] == []


@pytest.mark.slow
@every_sample
def test_samples_are_laid_down_with_tossed_coins_too(slicer, sample):
    report = sliced_sample(slicer, sample, coins)
    assert [(check["ok"], check["value"]) for check in report["checks"] if not check["ok"]] == []
    assert min(body["volume_mm3"] for body in report["bodies"].values()) > 0


def lay_down(monkeypatch, *volumes):
    lengths = tuple(filament_length(volume, PRINTER) for volume in volumes)
    monkeypatch.setattr(slicing, "find_slicer", lambda: FAKE)
    monkeypatch.setattr(slicing, "slice_bodies", lambda *_: Slice(lengths, 600.0))


@pytest.mark.parametrize(
    ("volumes", "ok"),
    [((5000, 10000), [True, True]), ((4840, 10310), [False, False]), ((0, 15000), [False, False])],
)
def test_other_volumes_are_told(files, monkeypatch, volumes, ok):
    lay_down(monkeypatch, *volumes)
    report = run(files)
    assert [check["ok"] for check in report["checks"]] == ok
    assert "reasons" not in report


def test_a_tool_without_a_body_must_not_print(mesh, monkeypatch):
    smp = np.ones(len(mesh["tets"]), bool)
    files = bodies.run(
        {"mesh": mesh, "labels": {"smp": smp}, "verdict_report": {"reasons": []}}, PROFILE, SilentMonitor()
    )
    lay_down(monkeypatch, 15000, 1)
    assert [check["ok"] for check in run(files)["checks"]] == [True, False]


def test_without_a_slicer_the_slice_is_left_out(files, monkeypatch, tmp_path):
    monkeypatch.setenv("PATH", str(tmp_path))
    report = run(files)
    assert report["left_out"][0]["what"] == "test slice"
    assert report["checks"] == []


def test_a_slicer_that_fails_is_told(files, monkeypatch):
    monkeypatch.setattr(slicing, "find_slicer", lambda: Slicer("prusa", Path("/usr/bin/false")))
    (check,) = run(files)["checks"]
    assert not check["ok"]
    assert "exit code 1" in check["message"]


@pytest.mark.parametrize(("change", "seconds", "without"), [(None, 600, 2), (10.0, 1600, 1)])
def test_changes_of_tool_take_the_time_of_the_card(files, monkeypatch, change, seconds, without):
    lay_down(monkeypatch, 5000, 10000)
    bodies_report = files["bodies_report"]
    assert bodies_report["purge"]["tool_changes"] == 100
    printer = bodies_report["printer"] | {"tool_change_time": change}
    report = run(files | {"bodies_report": bodies_report | {"printer": printer}})
    assert report["print_time_s"] == seconds
    assert len(report["print_time_without"]) == without
