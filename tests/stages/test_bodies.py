"""The stage that writes the print files: exact solids, masses, prices, and nothing at all when a body is wrong."""

import io
import zipfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from fab4d.errors import BodyError
from fab4d.io.cards import load_material, load_printer
from fab4d.io.stl import stl_arrays
from fab4d.stages import bodies
from fab4d.stages.monitor import SilentMonitor

CARD = load_material("paper-corrected", Path())
PRINTER = load_printer("generic-dual-0.4", Path())


def run(mesh, smp, up=(0.0, 0.0, 1.0), rejected=()):
    profile = {"name": "box", "printer": replace(PRINTER, up=up), "materials": CARD}
    labels = {"smp": smp, "cluster": smp.astype(int)}
    return bodies.run(
        {"mesh": mesh, "labels": labels, "verdict_report": {"reasons": list(rejected)}}, profile, SilentMonitor()
    )


def left(mesh):
    return mesh["X"][mesh["tets"]].mean(axis=1)[:, 0] < 10


def test_files_hold_both_bodies(mesh):
    out = run(mesh, left(mesh))
    for name, volume, x in (("smp", 5000.0, (0, 10)), ("tpe", 10000.0, (10, 30))):
        vertices, faces = stl_arrays(out[f"{name}_stl"], name)
        a, b, c = np.moveaxis(vertices[faces], 1, 0)
        assert np.sum(a * np.cross(b, c)) / 6 == pytest.approx(volume, rel=1e-12)
        assert (vertices[:, 0].min(), vertices[:, 0].max()) == x
    config = zipfile.ZipFile(io.BytesIO(out["part_3mf"])).read("Metadata/Slic3r_PE_model.config").decode()
    assert config.index('value="TPE"') < config.index('value="SMP"')


def test_report_weighs_and_prices(mesh):
    report = run(mesh, left(mesh))["bodies_report"]
    smp, tpe = report["bodies"]["smp"], report["bodies"]["tpe"]
    assert smp["volume_mm3"] + tpe["volume_mm3"] == report["volume_mm3"] == 15000.0
    assert smp["mass_g"] == pytest.approx(5.0 * CARD.smp_density)
    assert tpe["cost_usd"] == pytest.approx(10.0 * CARD.tpe_density / 1000 * CARD.tpe_price)
    assert report["mass_g"] == pytest.approx(smp["mass_g"] + tpe["mass_g"])
    assert report["cost_usd"] == pytest.approx(smp["cost_usd"] + tpe["cost_usd"])
    assert (smp["extruder"], tpe["extruder"], smp["genus"], smp["shells"]) == (1, 2, 0, 1)
    assert report["left_out"] == []


def test_equal_runs_give_equal_bytes(mesh):
    assert run(mesh, left(mesh)) == run(mesh, left(mesh))


@pytest.mark.parametrize(("value", "there", "missing"), [(False, "tpe_stl", "smp_stl"), (True, "smp_stl", "tpe_stl")])
def test_one_material_leaves_the_other_out(mesh, value, there, missing):
    out = run(mesh, np.full(len(mesh["tets"]), value))
    assert out[missing] is None
    assert len(out[there]) > 84
    assert [entry["what"] for entry in out["bodies_report"]["left_out"]] == [f"{missing[:3].upper()} body"]


def test_labels_that_are_no_solids_write_nothing(mesh):
    with pytest.raises(BodyError):
        run(mesh, np.random.default_rng(0).random(len(mesh["tets"])) < 0.5)


def test_what_the_stl_file_lost_is_noticed(mesh, monkeypatch):
    written = bodies.stl_bytes
    monkeypatch.setattr(bodies, "stl_bytes", lambda v, f, name: written(v, f[1:], name))
    with pytest.raises(BodyError, match="body smp"):
        run(mesh, left(mesh))


@pytest.mark.parametrize("up", [(1.0, 0.0, 0.0), (0.0, -1.0, 0.0), (0.0, 0.0, -1.0), (0.48, 0.6, 0.64)])
def test_files_hold_the_part_as_it_stands(mesh, up):
    out = run(mesh, left(mesh), up)
    report = out["bodies_report"]
    along = mesh["X"] @ np.array(up)
    corners = [stl_arrays(out[f"{name}_stl"], name)[0] for name in ("smp", "tpe")]
    z = np.concatenate(corners)[:, 2]
    assert (z.min(), z.max()) == pytest.approx((along.min(), along.max()), abs=1e-4)
    exact = 0 if max(np.abs(up)) == 1 else 1e-4
    assert report["bodies"]["smp"]["volume_mm3"] == pytest.approx(5000, rel=exact)
    assert report["volume_error"] < 1e-12
    # Back in the part's frame the SMP is where it was.
    x = (corners[0] @ np.array(report["printer_axes"]))[:, 0]
    assert (x.min(), x.max()) == pytest.approx((0, 10), abs=1e-4)
    for name in ("part_3mf", "part_orca_3mf"):
        model = zipfile.ZipFile(io.BytesIO(out[name])).read("3D/3dmodel.model").decode()
        lift = float(model.split('transform="1 0 0 0 1 0 0 0 1 0 0 ')[1].split('"')[0])
        assert z.min() + lift == 0


def test_places_are_told_in_the_frame_of_the_part(mesh):
    smp = np.zeros(len(mesh["tets"]), bool)
    smp[:6] = True
    cell = mesh["X"][mesh["tets"][:6]].mean(axis=(0, 1))
    for up in ((0.0, 0.0, 1.0), (0.0, 1.0, 0.0)):
        checks = run(mesh, smp, up)["bodies_report"]["checks"]
        found = next(check for check in checks if check["check"] == "smallest cluster")
        assert found["where"] == pytest.approx(cell.tolist())


def test_the_height_is_measured_along_the_printer(mesh):
    """30 x 25 x 20 mm of 1 mm walls would fall over when they stand on a narrow side."""
    thin = {"X": mesh["X"] * np.array([1.0, 0.02, 1.0]), "tets": mesh["tets"]}
    name = "height over the root of the first layer's area"

    def value(up):
        checks = run(thin, left(thin), up)["bodies_report"]["checks"]
        return next(check["value"] for check in checks if check["check"] == name)

    assert value((0.0, 0.0, 1.0)) == pytest.approx(20 / np.sqrt(30 * 0.5), rel=1e-3)
    assert value((1.0, 0.0, 0.0)) == pytest.approx(30 / np.sqrt(20 * 0.5), rel=1e-3)
    assert value((0.0, 1.0, 0.0)) == pytest.approx(0.5 / np.sqrt(30 * 20), rel=1e-3)


def test_files_of_a_rejected_design_say_so(mesh):
    good, bad = (run(mesh, left(mesh), rejected=why) for why in ((), ["RMS error is <9> mm", "too many forces"]))
    assert bad["smp_stl"] == good["smp_stl"]
    for name in ("part_3mf", "part_orca_3mf"):
        model = zipfile.ZipFile(io.BytesIO(bad[name])).read("3D/3dmodel.model").decode()
        assert '<metadata name="Title">box (REJECTED)</metadata>' in model
        assert "REJECTED; RMS error is &lt;9&gt; mm; too many forces" in model
        assert "REJECTED" not in zipfile.ZipFile(io.BytesIO(good[name])).read("3D/3dmodel.model").decode()


def test_places_that_may_not_print_well_are_drawn(mesh):
    assert run(mesh, left(mesh))["print_places"] is None
    smp = np.zeros(len(mesh["tets"]), bool)
    smp[:6] = True
    small = {"X": mesh["X"] / 10, "tets": mesh["tets"]}
    out = run(small, smp)
    assert any(check["where"] and not check["ok"] for check in out["bodies_report"]["checks"])
    assert out["print_places"].startswith(b"\x89PNG")
