"""Mesh files of many formats and with many faults; all end in arrays or in one error that names the file."""

import re
import struct
from pathlib import Path

import meshio
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from fab4d.errors import MeshError
from fab4d.io.meshes import RawMesh, read_mesh, vtu_bytes, write_vtu

X = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 1.1]]) + 1 / 3
TETS = np.array([[0, 1, 2, 3], [1, 4, 2, 3]])
FORMATS = {
    "ascii.msh": {"file_format": "gmsh22", "binary": False},
    "binary.msh": {"file_format": "gmsh22", "binary": True},
    "v41.msh": {"file_format": "gmsh", "binary": True},
    "v41a.msh": {"file_format": "gmsh", "binary": False},
    "legacy.vtk": {"file_format": "vtk", "binary": True},
    "legacy42.vtk": {"file_format": "vtk42", "binary": False},
    "medit.mesh": {"file_format": "medit"},
    "zlib.vtu": {"file_format": "vtu", "compression": "zlib"},
    "lzma.vtu": {"file_format": "vtu", "compression": "lzma"},
    "plain.vtu": {"file_format": "vtu", "compression": None},
    "abaqus.inp": {"file_format": "abaqus"},
    "nastran.bdf": {"file_format": "nastran"},
}


def written(path: Path, mesh: meshio.Mesh | None = None, **how: object) -> Path:
    meshio.write(path, mesh or meshio.Mesh(X, [("tetra", TETS)]), **how)
    return path


@pytest.mark.parametrize("name", FORMATS)
def test_tets_and_vertices_arrive_in_order_as_native_float64(tmp_path: Path, name: str) -> None:
    mesh = read_mesh(written(tmp_path / name, **FORMATS[name]))
    np.testing.assert_array_equal(mesh.tets, TETS)
    np.testing.assert_allclose(mesh.points, X, rtol=1e-9)
    for array, kind in ((mesh.points, np.float64), (mesh.tets, np.int64)):
        assert array.dtype == kind
        assert array.dtype.isnative
        assert array.flags.c_contiguous
        assert not array.flags.writeable
    assert mesh.file == name


def test_big_endian_vtk_and_single_precision_medit_become_native_doubles(tmp_path: Path) -> None:
    """What numba would refuse: meshio itself hands out these types."""
    vtk = written(tmp_path / "a.vtk", file_format="vtk", binary=True)
    assert not meshio.read(vtk).points.dtype.isnative
    assert read_mesh(vtk).points.dtype.isnative
    medit = tmp_path / "a.mesh"
    rows = "".join(f"{x} {y} {z} 0\n" for x, y, z in X.tolist())
    medit.write_text(
        f"MeshVersionFormatted 1\nDimension 3\nVertices\n5\n{rows}Tetrahedra\n2\n1 2 3 4 0\n2 5 3 4 0\nEnd\n",
        encoding="utf-8",
    )
    assert meshio.read(medit).points.dtype == np.float32
    mesh = read_mesh(medit)
    assert mesh.points.dtype == np.float64
    np.testing.assert_allclose(mesh.points, X, rtol=1e-6)


def test_the_content_decides_and_not_the_suffix(tmp_path: Path) -> None:
    path = written(tmp_path / "a.vtu")
    for suffix in (".msh", ".vtk", ".dat"):
        np.testing.assert_array_equal(read_mesh(path.rename(path.with_suffix(suffix))).tets, TETS)
        path = path.with_suffix(suffix)


def test_all_blocks_of_tets_are_joined_and_other_cells_ignored(tmp_path: Path) -> None:
    cells = [("triangle", TETS[:, :3]), ("tetra", TETS[:1]), ("line", TETS[:, :2]), ("tetra", TETS[1:])]
    mesh = read_mesh(written(tmp_path / "a.msh", meshio.Mesh(X, cells), file_format="gmsh22", binary=False))
    np.testing.assert_array_equal(mesh.tets, TETS)


def test_ten_node_tets_are_kept(tmp_path: Path) -> None:
    points, tets = np.random.default_rng(0).random((14, 3)), np.array([[0, 1, 2, 3, *range(5, 11)]])
    path = tmp_path / "a.vtu"
    write_vtu(path, points, tets)
    np.testing.assert_array_equal(read_mesh(path).tets, tets)
    mixed = meshio.Mesh(points, [("tetra10", tets), ("tetra", TETS)])
    np.testing.assert_array_equal(read_mesh(written(path, mixed)).tets, np.vstack([tets[:, :4], TETS]))


def test_named_sets_become_vertices(tmp_path: Path) -> None:
    gmsh = meshio.Mesh(
        X,
        [("triangle", TETS[:1, :3]), ("tetra", TETS)],
        cell_data={
            "gmsh:physical": [np.array([7]), np.array([1, 2])],
            "gmsh:geometrical": [np.array([7]), np.array([1, 1])],
        },
        field_data={"foot": np.array([7, 2]), "top": np.array([2, 3])},
    )
    sets = read_mesh(written(tmp_path / "a.msh", gmsh, file_format="gmsh22", binary=False)).sets
    assert {name: rows.tolist() for name, rows in sets.items()} == {"foot": [0, 1, 2], "top": [1, 2, 3, 4]}
    abaqus = meshio.Mesh(X, [("tetra", TETS)], point_sets={"grip": np.array([3, 1])})
    assert read_mesh(written(tmp_path / "a.inp", abaqus)).sets["grip"].tolist() == [1, 3]
    write_vtu(tmp_path / "a.vtu", X, TETS, {"clamp": X[:, 0] > 1, "number": np.arange(5)})
    assert {k: v.tolist() for k, v in read_mesh(tmp_path / "a.vtu").sets.items()} == {"clamp": [1, 4]}


def refused(path: Path, message: str) -> None:
    with pytest.raises(MeshError, match=rf"{re.escape(str(path))}: {message}"):
        read_mesh(path)


@pytest.mark.parametrize("name", ["a.vtu", "a.vtk", "a.msh", "a.mesh", "a.inp", "a.xyz", "a"])
@pytest.mark.parametrize("content", [b"", b"this is not a mesh\n" * 20, bytes(range(256)) * 4])
def test_what_is_no_mesh_is_refused(
    tmp_path: Path, name: str, content: bytes, capfd: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / name).write_bytes(content)
    refused(tmp_path / name, "")
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize("name", FORMATS)
@pytest.mark.parametrize("share", [0.35, 0.6, 0.9])
def test_truncated_files_never_end_in_another_error(tmp_path: Path, name: str, share: float) -> None:
    """Whatever a format's reader makes of half a file, it is an error that names it or a smaller mesh."""
    path = written(tmp_path / name, **FORMATS[name])
    path.write_bytes(path.read_bytes()[: int(share * path.stat().st_size)])
    try:
        mesh = read_mesh(path)
    except MeshError:
        return
    assert len(mesh.tets) < 2 or len(mesh.points) == 5


@pytest.mark.parametrize("share", [0.1, 0.5, 0.9, 0.99])
def test_a_truncated_vtu_is_refused(tmp_path: Path, share: float) -> None:
    data = vtu_bytes(X, TETS)
    (tmp_path / "a.vtu").write_bytes(data[: int(share * len(data))])
    refused(tmp_path / "a.vtu", "cannot be read as a mesh")


def test_a_missing_file_and_a_folder_are_refused(tmp_path: Path) -> None:
    refused(tmp_path / "none.vtu", r"cannot be opened \(No such file .*\[shape\]")
    refused(tmp_path, "cannot be opened")


def test_lz4_is_refused_with_what_to_do(tmp_path: Path) -> None:
    data = vtu_bytes(X, TETS).replace(b"vtkZLibDataCompressor", b"vtkLZ4DataCompressor")
    (tmp_path / "a.vtu").write_bytes(data)
    refused(tmp_path / "a.vtu", "cannot be read .*LZ4 compression is not supported; save it with ZLib")


def test_several_pieces_are_refused_since_meshio_would_read_one(tmp_path: Path) -> None:
    data = vtu_bytes(X, TETS)
    piece = data[data.index(b"<Piece") : data.index(b"</Piece>") + 8]
    (tmp_path / "a.vtu").write_bytes(data.replace(piece, piece + piece))
    refused(tmp_path / "a.vtu", "the VTU file has several pieces")


PARTIAL_GROUPS = """$MeshFormat
4.1 0 8
$EndMeshFormat
$PhysicalNames
1
3 1 "left"
$EndPhysicalNames
$Entities
0 0 0 2
1 0 0 0 1 1 1 1 1 0
2 0 0 0 1 1 1 0 0
$EndEntities
$Nodes
1 5 1 5
3 1 0 5
1
2
3
4
5
0 0 0
1 0 0
0 1 0
0 0 1
1 1 1
$EndNodes
$Elements
2 2 1 2
3 1 4 1
1 1 2 3 4
3 2 4 1
2 2 5 3 4
$EndElements
"""


def test_partial_groups_of_gmsh_4_are_refused_with_what_to_do(tmp_path: Path) -> None:
    (tmp_path / "a.msh").write_text(PARTIAL_GROUPS, encoding="utf-8")
    refused(tmp_path / "a.msh", r".*physical groups on a part .* export it as Gmsh version 2\.2")


def test_a_surface_is_refused_for_having_no_tets(tmp_path: Path) -> None:
    triangles = meshio.Mesh(X, [("triangle", TETS[:, :3])])
    refused(written(tmp_path / "a.vtu", triangles), "no tets, only triangle; export the volume mesh")


def test_vtu_bytes_are_equal_for_equal_arrays_and_keep_every_field(tmp_path: Path) -> None:
    point_data = {"force": X * 7, "held": np.arange(-1, 4), "clamp": X[:, 0] > 1, 'a "<name>"': X[:, 0]}
    cell_data = {"rho": np.array([0.25, 1.0]), "smp": np.array([True, False])}
    data = vtu_bytes(X, TETS, point_data, cell_data)
    assert data == vtu_bytes(X.copy(order="F"), TETS.copy(), point_data, cell_data)
    (tmp_path / "a.vtu").write_bytes(data)
    mesh = meshio.read(tmp_path / "a.vtu")
    for name, array in point_data.items():
        np.testing.assert_array_equal(mesh.point_data[name], array)
    for name, array in cell_data.items():
        np.testing.assert_array_equal(mesh.cell_data[name][0], array)


def test_a_vtu_block_header_is_what_vtk_expects() -> None:
    """One block: count, its size, the size of a last partial block, the compressed size."""
    import base64
    import zlib

    text = re.search(rb'Name="Points"[^>]*>([^<]*)<', vtu_bytes(X, TETS))
    assert text
    header = struct.unpack("<4Q", base64.b64decode(text[1][:44]))
    assert header[:3] == (1, X.nbytes, X.nbytes)
    assert zlib.decompress(base64.b64decode(text[1][44:])) == X.tobytes()
    assert header[3] == len(base64.b64decode(text[1][44:]))


@given(arrays(np.float64, (5, 3), elements=st.floats(-1e300, 1e300)))
def test_vtu_keeps_every_bit(tmp_path_factory: pytest.TempPathFactory, points: np.ndarray) -> None:
    path = tmp_path_factory.mktemp("bits") / "a.vtu"
    write_vtu(path, points, TETS)
    assert read_mesh(path).points.tobytes() == points.tobytes()


def test_a_raw_mesh_cannot_be_changed_from_outside() -> None:
    points = X.copy()
    mesh = RawMesh(points, TETS, {}, "a.vtu")
    points[0] = 9
    assert mesh.points[0, 0] == X[0, 0]
