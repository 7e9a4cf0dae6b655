"""Bodies of a labelled mesh from elsewhere, whatever its labels, orientation and unit."""

import json
from pathlib import Path

import numpy as np
import pytest

from fab4d.errors import MeshError
from fab4d.io.cards import load_material, load_printer
from fab4d.io.meshes import RawMesh, read_labelled_mesh, write_vtu
from fab4d.stages._labelled import labelled_bodies

CARDS = load_printer("generic-dual-0.4", Path()), load_material("paper-corrected", Path())


def bodies(raw, smp, mm=1.0):
    return labelled_bodies(raw, smp, mm, "part", *CARDS)


@pytest.fixture
def raw(mesh):
    return RawMesh(mesh["X"], mesh["tets"], {}, "box.vtu")


def test_coin_toss_labels_become_solids(raw):
    smp = np.random.default_rng(3).random(len(raw.tets)) < 0.5
    report = bodies(raw, smp)["bodies_report"]
    assert sum(body["volume_mm3"] for body in report["bodies"].values()) == pytest.approx(15000, rel=1e-12)
    assert 0 < report["labels"]["changed_fraction"]["total"] < 0.5
    assert report["labels"]["defects_left"] == []
    held = next(c for c in report["checks"] if c["check"] == "places held by an edge or a point")
    assert held["ok"]
    json.dumps(report, allow_nan=False)


def test_good_labels_stay_and_the_unit_is_obeyed(raw):
    smp = raw.points[raw.tets].mean(axis=1)[:, 0] < 10
    in_cm = RawMesh(raw.points / 10, raw.tets, {}, "box.vtu")
    files, same = bodies(raw, smp), bodies(in_cm, smp, 10.0)
    assert files["smp_stl"] == same["smp_stl"]
    assert files["bodies_report"]["labels"]["changed_fraction"]["total"] == 0
    assert files["bodies_report"]["bodies"]["smp"]["volume_mm3"] == 5000


def test_tets_listed_the_wrong_way_round_are_turned(raw):
    tets = raw.tets.copy()
    tets[::3] = tets[::3][:, [0, 1, 3, 2]]
    smp = raw.points[raw.tets].mean(axis=1)[:, 0] < 10
    report = bodies(RawMesh(raw.points, tets, {}, "box.vtu"), smp)["bodies_report"]
    assert [found["code"] for found in report["findings"]] == ["left-handed"]
    assert report["bodies"]["smp"]["volume_mm3"] == 5000


def test_tets_without_volume_are_refused(raw):
    points = raw.points.copy()
    points[:, 2] = 0
    with pytest.raises(MeshError, match=r"box\.vtu.*no volume"):
        bodies(RawMesh(points, raw.tets, {}, "box.vtu"), np.ones(len(raw.tets), bool))


class TestReading:
    @pytest.fixture
    def file(self, raw, tmp_path):
        smp = np.arange(len(raw.tets)) % 3 == 0
        path = tmp_path / "labelled.vtu"
        write_vtu(path, raw.points, raw.tets, {}, {"smp": smp, "rho": np.where(smp, 0.7, 0.2), "region": smp + 1})
        return path

    @pytest.mark.parametrize("field", ["smp", "rho"])
    def test_labels_and_densities(self, file, raw, field):
        read, smp = read_labelled_mesh(file, field)
        assert np.array_equal(read.tets, raw.tets)
        assert np.array_equal(smp, np.arange(len(raw.tets)) % 3 == 0)

    def test_other_values_are_refused(self, file):
        with pytest.raises(MeshError, match=r'tet 0 has 2\.0 in "region"; 0 is TPE'):
            read_labelled_mesh(file, "region")

    def test_an_unknown_field_names_the_known_ones(self, file):
        with pytest.raises(MeshError, match='no cell field "labels"; it has: region, rho, smp'):
            read_labelled_mesh(file, "labels")
