"""Bodies of a labelled mesh from elsewhere, whatever its labels, orientation and unit."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from fab4d.errors import BodyError, MeshError
from fab4d.io.cards import load_material, load_printer
from fab4d.io.meshes import RawMesh, read_labelled_mesh, write_vtu
from fab4d.runner.summary import body_lines
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


@pytest.mark.parametrize(("inner", "pocket"), [(True, "smp"), (False, "tpe")])
def test_a_pocket_is_kept_reported_and_a_hole_of_the_other_body(raw, inner, pocket):
    centres = raw.points[raw.tets].mean(axis=1)
    box = ((centres > [10, 10, 5]) & (centres < [20, 15, 15])).all(axis=1)
    report = bodies(raw, box == inner)["bodies_report"]
    around = {"smp": "tpe", "tpe": "smp"}[pocket]
    assert report["pockets"][pocket] == {"count": 1, "volume_mm3": pytest.approx(500)}
    assert report["pockets"][around] == {"count": 0, "volume_mm3": 0}
    assert (report["bodies"][pocket]["shells"], report["bodies"][around]["shells"]) == (1, 2)
    assert report["bodies"][pocket]["volume_mm3"] == 500
    assert f"  {pocket.upper()} enclosed in the other material: 1 places, 500 mm^3" in body_lines(report)


def test_pockets_too_small_to_print_are_absorbed_and_counted(raw):
    smp = np.zeros(len(raw.tets), bool)
    smp[300] = True
    small = RawMesh(raw.points * 0.1, raw.tets, {}, "box.vtu")
    report = bodies(small, smp)["bodies_report"]
    assert report["bodies"].keys() == {"tpe"}
    share = 1 / len(raw.tets)
    assert report["labels"]["changed_fraction"]["clusters"] == pytest.approx(share)
    lines = "\n".join(body_lines(report))
    assert f"labels changed to print: {100 * share:.2g} % of the volume; small clusters {100 * share:.2g} %" in lines


@pytest.mark.parametrize(
    ("points", "message"),
    [
        (lambda X: X / 1e4, r"box.vtu: the part would be 0.003 x 0.0025 x 0.002 mm, narrower than a line"),
        (lambda X: X * 1e3, r"box.vtu: the part would be 3e\+04 x .* beyond the printer's volume: give the unit"),
        (lambda X: np.where(np.arange(len(X))[:, None] == 7, np.nan, X), r"box.vtu: vertex 7 is at \[nan, nan, nan\]"),
    ],
)
def test_a_wrong_unit_or_no_number_is_refused(raw, points, message):
    with pytest.raises(MeshError, match=message):
        bodies(RawMesh(points(raw.points), raw.tets, {}, "box.vtu"), np.ones(len(raw.tets), bool))


def test_a_part_that_cannot_be_a_body_is_refused_by_the_name_of_its_file(raw):
    far = RawMesh(np.vstack([raw.points, raw.points + 100]), np.vstack([raw.tets, raw.tets + len(raw.points)]), {}, "b")
    with pytest.raises(BodyError, match="b: the part falls into 2 pieces"):
        bodies(far, np.ones(len(far.tets), bool))


def test_the_build_direction_decides_which_features_are_too_thin(raw):
    """A sheet of 0.5 mm SMP: two layers high when it lies, thinner than two lines when it stands."""
    thin = RawMesh(raw.points * 0.1, raw.tets, {}, "box.vtu")
    centres = thin.points[thin.tets].mean(axis=1)
    sheet = (centres[:, 2] > 1.0) & (centres[:, 2] < 1.5)
    card, materials = CARDS
    for up, kept in (((0.0, 0.0, 1.0), True), ((1.0, 0.0, 0.0), False)):
        found = labelled_bodies(thin, sheet, 1.0, "part", replace(card, up=up), materials)["bodies_report"]
        assert ("smp" in found["bodies"]) == kept
        assert (found["labels"]["changed_fraction"]["features"] > 0) == (not kept)
