"""The stage that writes the print files: exact solids, masses, prices, and nothing at all when a body is wrong."""

import io
import zipfile
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


def run(mesh, smp):
    profile = {"name": "box", "printer": PRINTER, "materials": CARD}
    labels = {"smp": smp, "cluster": smp.astype(int)}
    return bodies.run({"mesh": mesh, "labels": labels}, profile, SilentMonitor())


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
