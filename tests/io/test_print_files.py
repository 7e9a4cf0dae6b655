"""STL and 3MF files hold the bodies exactly, and equal bodies give equal bytes."""

import io
import xml.etree.ElementTree as ET
import zipfile

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fab4d.errors import BodyError
from fab4d.io.stl import stl_arrays, stl_bytes
from fab4d.io.threemf import Part, components_3mf, prusa_3mf

CORE = "{http://schemas.microsoft.com/3dmanufacturing/core/2015/02}"
TETRAHEDRON = np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]])
coordinates = st.integers(-(2**23), 2**23).map(lambda k: k * 2.0**-14)


def tetrahedron(offset=0.0):
    return np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1.25]]) + offset


def part(name, extruder, offset=0.0):
    return Part(name, extruder, "#112233", tetrahedron(offset), TETRAHEDRON)


def files_of(data):
    with zipfile.ZipFile(io.BytesIO(data)) as package:
        assert package.testzip() is None
        return {name: package.read(name) for name in package.namelist()}


def meshes_of(files):
    model = ET.fromstring(files["3D/3dmodel.model"])
    assert model.get("unit") == "millimeter"
    for mesh in model.iter(CORE + "mesh"):
        vertices = [[float(v.get(axis)) for axis in "xyz"] for v in mesh.iter(CORE + "vertex")]
        yield (
            np.array(vertices),
            np.array([[int(t.get(v)) for v in ("v1", "v2", "v3")] for t in mesh.iter(CORE + "triangle")]),
        )


class TestStl:
    @given(st.lists(st.tuples(coordinates, coordinates, coordinates), min_size=4, max_size=4, unique=True))
    def test_round_trip_is_exact(self, points):
        X = np.array(points)
        if np.linalg.matrix_rank(X[1:] - X[0]) < 3:
            return
        vertices, faces = stl_arrays(stl_bytes(X, TETRAHEDRON, "smp"), "smp.stl")
        assert np.array_equal(vertices[faces], X[TETRAHEDRON])
        assert len(vertices) == 4

    def test_layout(self):
        data = stl_bytes(tetrahedron(), TETRAHEDRON, "smp")
        assert len(data) == 84 + 4 * 50
        assert not data.startswith(b"solid")
        assert np.frombuffer(data, "<f4", 12, 84).tolist() == [0, 0, -1, 0, 0, 0, 0, 1, 0, 1, 0, 0]
        assert data == stl_bytes(tetrahedron(), TETRAHEDRON, "smp")

    def test_zero_has_no_sign(self):
        X = tetrahedron()
        X[0] = -0.0
        X[1, 1] = 0.0
        assert len(stl_arrays(stl_bytes(X, TETRAHEDRON, "smp"), "smp.stl")[0]) == 4

    def test_inexact_coordinates_are_refused(self):
        with pytest.raises(BodyError, match=r"body tpe: vertex 3 at \[0.1, 0.1, 1.35\] mm is not exact"):
            stl_bytes(np.vstack([np.eye(3), [0.1, 0.1, 1.35]]), TETRAHEDRON, "tpe")

    @pytest.mark.parametrize("damage", [lambda d: d[:-1], lambda d: d + b"x", lambda d: d[:40], lambda _: b""])
    def test_damaged_files_are_refused(self, damage):
        with pytest.raises(BodyError, match=r"x\.stl: \d+ bytes are not a binary STL"):
            stl_arrays(damage(stl_bytes(tetrahedron(), TETRAHEDRON, "smp")), "x.stl")


class TestPrusa:
    files = files_of(prusa_3mf('a "b" <c>', [part("TPE", 2), part("SMP", 1, 2.0**-14)]))

    def test_one_mesh_with_ranges_of_triangles(self):
        ((vertices, faces),) = meshes_of(self.files)
        assert np.array_equal(vertices, np.vstack([tetrahedron(), tetrahedron(2.0**-14)]))
        assert np.array_equal(faces, np.vstack([TETRAHEDRON, TETRAHEDRON + 4]))
        volumes = ET.fromstring(self.files["Metadata/Slic3r_PE_model.config"]).findall("./object/volume")
        found = [
            (
                v.get("firstid"),
                v.get("lastid"),
                v.find("*[@key='name']").get("value"),
                v.find("*[@key='extruder']").get("value"),
            )
            for v in volumes
        ]
        assert found == [("0", "3", "TPE", "2"), ("4", "7", "SMP", "1")]

    def test_title_is_quoted(self):
        config = ET.fromstring(self.files["Metadata/Slic3r_PE_model.config"])
        assert config.find("./object/metadata[@key='name']").get("value") == 'a "b" <c>'

    def test_package_names_its_model(self):
        relation = ET.fromstring(self.files["_rels/.rels"])[0]
        assert relation.get("Target").lstrip("/") in self.files
        types = {t.get("Extension") for t in ET.fromstring(self.files["[Content_Types].xml"])}
        assert {name.rsplit(".", 1)[1] for name in self.files if name != "[Content_Types].xml"} <= types

    def test_equal_parts_give_equal_bytes(self):
        parts = [part("TPE", 2), part("SMP", 1)]
        assert prusa_3mf("x", parts) == prusa_3mf("x", parts)
        assert prusa_3mf("x", parts) != prusa_3mf("y", parts)


class TestComponents:
    files = files_of(components_3mf("x & y", [part("TPE", 2), part("SMP", 1, 1.0)]))

    def test_each_part_is_an_object_with_its_extruder(self):
        model = ET.fromstring(self.files["3D/3dmodel.model"])
        objects = model.findall(f"./{CORE}resources/{CORE}object")
        assert [o.get("name") for o in objects] == ["TPE", "SMP", "x & y"]
        numbers = [o.find(f".//{CORE}metadata[@name='cura:extruder_nr']").text for o in objects[:2]]
        assert numbers == ["1", "0"]
        components = objects[2].findall(f".//{CORE}component")
        assert [c.get("objectid") for c in components] == [o.get("id") for o in objects[:2]]
        assert model.find(f"./{CORE}build/{CORE}item").get("objectid") == objects[2].get("id")
        for (vertices, faces), offset in zip(meshes_of(self.files), (0.0, 1.0), strict=True):
            assert np.array_equal(vertices, tetrahedron(offset))
            assert np.array_equal(faces, TETRAHEDRON)

    def test_settings_name_the_same_objects(self):
        config = ET.fromstring(self.files["Metadata/model_settings.config"])
        parts = config.findall("./object/part")
        assert [p.get("id") for p in parts] == ["2", "3"]
        assert [p.find("*[@key='extruder']").get("value") for p in parts] == ["2", "1"]


@pytest.mark.parametrize("writer", [prusa_3mf, components_3mf])
def test_files_are_valid_by_the_strict_reader_of_the_3mf_consortium(writer, tmp_path):
    """lib3mf in strict mode, which has no wheel for every platform."""
    lib3mf = pytest.importorskip("lib3mf")
    path = tmp_path / "part.3mf"
    path.write_bytes(writer('a "b" <c>', [part("TPE", 2), part("SMP", 1, 2.0)], 2.5, "REJECTED; <why>"))
    model = lib3mf.get_wrapper().CreateModel()
    reader = model.QueryReader("3mf")
    reader.SetStrictModeActive(True)
    reader.ReadFromFile(str(path))
    assert [reader.GetWarning(k) for k in range(reader.GetWarningCount())] == []
    triangles, meshes = 0, model.GetMeshObjects()
    while meshes.MoveNext():
        triangles += meshes.GetCurrentMeshObject().GetTriangleCount()
    assert triangles == 8
