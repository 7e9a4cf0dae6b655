"""Tet meshes from and to files."""

import base64
import contextlib
import io
import re
import warnings
import zlib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from xml.sax.saxutils import quoteattr

import meshio
import numpy as np

from fab4d.errors import MeshError
from fab4d.mesh.tetmesh import BoolArray, FloatArray, IntArray, frozen

_CELL_NAMES = ("tetra", "tetra10")
_VTK_TYPES = MappingProxyType({4: 10, 10: 24})
# What a file starts with decides, not its suffix: exporters mislabel.
_SIGNATURES = (
    (rb"<VTKFile[^>]*UnstructuredGrid", "vtu"),
    (rb"\$MeshFormat", "gmsh"),
    (rb"# vtk DataFile", "vtk"),
    (rb"\s*MeshVersionFormatted", "medit"),
)
_HEAD_BYTES = 4096


@dataclass(frozen=True, eq=False)
class RawMesh:
    """A tet mesh as read: points (n, 3) in the file's unit, tets (m, 4) or (m, 10), named vertex sets, file name."""

    points: FloatArray
    tets: IntArray
    sets: dict[str, IntArray]
    file: str

    def __post_init__(self) -> None:
        object.__setattr__(self, "points", frozen(self.points, np.float64))
        object.__setattr__(self, "tets", frozen(self.tets, np.int64))


def read_mesh(path: Path) -> RawMesh:
    """All tets of the file `path`, in its order; other cells are ignored. No vertex is merged, moved or dropped.

    10-node tets are kept when there are no others; otherwise their corners are taken.
    Vertex sets: the format's own point and cell sets, Gmsh's physical names, and integer point fields of 0 and 1.
    Raises MeshError naming the file when it is missing, unreadable, or holds no tets.
    """
    return _raw_mesh(_read_anything(path), path)


def read_labelled_mesh(path: Path, field: str) -> tuple[RawMesh, BoolArray]:
    """`read_mesh` and which of its tets (m,) the cell field `field` makes SMP: labels 0 and 1, or densities above 0.5.

    Raises MeshError, also when there is no such field or a value of it is outside [0, 1].
    """
    mesh = _read_anything(path)
    raw = _raw_mesh(mesh, path)
    if field not in mesh.cell_data:
        msg = f'{path}: no cell field "{field}"; it has: {", ".join(sorted(mesh.cell_data)) or "none"}'
        raise MeshError(msg)
    blocks = zip(mesh.cells, mesh.cell_data[field], strict=True)
    values = np.concatenate([np.asarray(v, float) for block, v in blocks if block.type in _CELL_NAMES and len(v)])
    wild = np.flatnonzero(~((values >= 0) & (values <= 1))) if values.ndim == 1 else np.arange(len(values))
    if len(wild):
        found = values[wild[0]].tolist()
        msg = f'{path}: tet {wild[0]} has {found} in "{field}"; 0 is TPE, 1 is SMP, and a density in between is rounded'
        raise MeshError(msg)
    return raw, values > 0.5


def _raw_mesh(mesh: meshio.Mesh, path: Path) -> RawMesh:
    blocks = [block.data for block in mesh.cells if block.type in _CELL_NAMES]
    n_tets = sum(len(block) for block in blocks)
    if n_tets == 0:
        found = ", ".join(sorted({block.type for block in mesh.cells})) or "no cells"
        msg = f"{path}: no tets, only {found}; export the volume mesh (4-node or 10-node tets)"
        raise MeshError(msg)
    if mesh.points.ndim != 2 or mesh.points.shape[1] != 3:
        msg = f"{path}: points have {mesh.points.shape[-1]} coordinates instead of 3"
        raise MeshError(msg)
    nodes = min(block.shape[1] for block in blocks if len(block))
    tets = np.concatenate([block[:, :nodes] for block in blocks if len(block)])
    return RawMesh(mesh.points, tets, _vertex_sets(mesh), path.name)


def vtu_bytes(
    points: FloatArray,
    cells: IntArray,
    point_data: Mapping[str, np.ndarray] | None = None,
    cell_data: Mapping[str, np.ndarray] | None = None,
) -> bytes:
    """A VTU file with zlib compression; equal arrays give equal bytes.

    points (n, 3); cells (m, 4) or (m, 10) in VTK order; point_data (n, ...), cell_data (m, ...)
    Source: VTK File Formats, section "XML File Formats".
    """
    n_cells, nodes = cells.shape
    connectivity = {
        "connectivity": np.asarray(cells, np.int64).ravel(),
        "offsets": nodes * np.arange(1, n_cells + 1),
        "types": np.full(n_cells, _VTK_TYPES[nodes], np.uint8),
    }
    return "\n".join(
        [
            '<?xml version="1.0"?>',
            '<VTKFile type="UnstructuredGrid" version="1.0" byte_order="LittleEndian" header_type="UInt64" '
            'compressor="vtkZLibDataCompressor">',
            f'<UnstructuredGrid><Piece NumberOfPoints="{len(points)}" NumberOfCells="{n_cells}">',
            _vtu_section("Points", {"Points": np.asarray(points, np.float64)}),
            _vtu_section("Cells", connectivity),
            _vtu_section("PointData", point_data or {}),
            _vtu_section("CellData", cell_data or {}),
            "</Piece></UnstructuredGrid></VTKFile>\n",
        ]
    ).encode()


def write_vtu(
    path: Path,
    points: FloatArray,
    cells: IntArray,
    point_data: Mapping[str, np.ndarray] | None = None,
    cell_data: Mapping[str, np.ndarray] | None = None,
) -> None:
    """Write `vtu_bytes` of the arrays to `path`."""
    path.write_bytes(vtu_bytes(points, cells, point_data, cell_data))


def _vtu_section(tag: str, arrays: Mapping[str, np.ndarray]) -> str:
    return f"<{tag}>{''.join(_data_array(name, np.asarray(array)) for name, array in arrays.items())}</{tag}>"


def _data_array(name: str, array: np.ndarray) -> str:
    """One array, compressed as a single block behind the four numbers of VTK's header."""
    # VTK knows no booleans.
    array = np.ascontiguousarray(array, np.int8 if array.dtype == np.bool_ else array.dtype.newbyteorder("<"))
    kind = {"f": "Float", "i": "Int", "u": "UInt"}[array.dtype.kind] + str(8 * array.dtype.itemsize)
    components = f' NumberOfComponents="{array.shape[1]}"' if array.ndim == 2 else ""
    block = zlib.compress(array.tobytes(), 6)
    header = np.array([1, array.nbytes, array.nbytes, len(block)], "<u8").tobytes()
    data = base64.b64encode(header) + base64.b64encode(block)
    return f'<DataArray type="{kind}" Name={quoteattr(name)}{components} format="binary">{data.decode()}</DataArray>'


def _read_anything(path: Path) -> meshio.Mesh:
    """What meshio reads, with its many ways to fail turned into one error that names the file."""
    head = _head(path)
    said = io.StringIO()
    try:
        with (
            contextlib.redirect_stdout(said),
            contextlib.redirect_stderr(said),
            warnings.catch_warnings(record=True) as caught,
        ):
            warnings.simplefilter("always")
            mesh = meshio.read(path, file_format=_format(head))
    # meshio raises whatever its parsers run into, SystemExit included.
    except (Exception, SystemExit) as error:
        msg = f"{path}: cannot be read as a mesh ({_reason(error, said.getvalue())}){_advice(path, head)}"
        raise MeshError(msg) from error
    for warning in caught:
        # numpy's only sign of a text file that ends too early or holds no numbers.
        if "could not be read to its end" in str(warning.message):
            msg = f"{path}: the file holds text where numbers were expected: export it again"
            raise MeshError(msg)
    if _has_pieces(path, head):
        msg = f"{path}: the VTU file has several pieces, of which only one would be read: merge them (Merge Blocks)"
        raise MeshError(msg)
    return mesh


def _head(path: Path) -> bytes:
    try:
        with path.open("rb") as file:
            return file.read(_HEAD_BYTES)
    except OSError as error:
        msg = f"{path}: cannot be opened ({error.strerror}): check the name in section [shape] of the scene"
        raise MeshError(msg) from error


def _format(head: bytes) -> str | None:
    """meshio's name of the format, or None to let it decide by the suffix."""
    for signature, name in _SIGNATURES:
        if re.match(rb"\s*" + signature, head) or (name == "vtu" and re.search(signature, head)):
            return name
    return None


def _has_pieces(path: Path, head: bytes) -> bool:
    return _format(head) == "vtu" and len(re.findall(rb"<Piece\b", path.read_bytes())) > 1


def _reason(error: BaseException, said: str) -> str:
    words = " ".join((said if isinstance(error, SystemExit) else str(error)).split())
    return f"{type(error).__name__}: {words}" if words else type(error).__name__


def _advice(path: Path, head: bytes) -> str:
    if b"LZ4" in head:
        return ": LZ4 compression is not supported; save it with ZLib compression or none"
    if _format(head) == "gmsh" and b"$MeshFormat\n2" not in head:
        return ": physical groups on a part of the mesh are a known cause; export it as Gmsh version 2.2"
    if _format(head) is None and path.suffix.lower() not in meshio.extension_to_filetypes:
        return ": the suffix is of no known mesh format; use .vtu, .vtk, .msh or .mesh"
    return ": the file is damaged or of another format than it says; export it again, best as .vtu"


def _vertex_sets(mesh: meshio.Mesh) -> dict[str, IntArray]:
    sets = {name: np.asarray(rows) for name, rows in mesh.point_sets.items()}
    for name, per_block in mesh.cell_sets.items():
        if not name.startswith("gmsh:"):
            sets[name] = _vertices_of_cells(mesh, per_block)
    for name, (tag, dimension) in _physical_names(mesh).items():
        sets[name] = _vertices_of_group(mesh, tag, dimension)
    for name, values in mesh.point_data.items():
        if values.ndim == 1 and values.dtype.kind in "iub" and set(np.unique(values)) <= {0, 1}:
            sets.setdefault(name, np.flatnonzero(values))
    return {name: np.unique(rows).astype(np.int64) for name, rows in sets.items()}


def _vertices_of_cells(mesh: meshio.Mesh, per_block: list[np.ndarray | None]) -> np.ndarray:
    rows = [
        block.data[np.asarray(cells, int)].ravel()
        for block, cells in zip(mesh.cells, per_block, strict=True)
        if cells is not None
    ]
    return np.concatenate([np.zeros(0, int), *rows])


def _physical_names(mesh: meshio.Mesh) -> dict[str, tuple[int, int]]:
    if "gmsh:physical" not in mesh.cell_data:
        return {}
    return {name: (int(value[0]), int(value[1])) for name, value in mesh.field_data.items() if np.size(value) == 2}


def _vertices_of_group(mesh: meshio.Mesh, tag: int, dimension: int) -> np.ndarray:
    rows = [
        block.data[tags == tag].ravel()
        for block, tags in zip(mesh.cells, mesh.cell_data["gmsh:physical"], strict=True)
        if block.dim == dimension
    ]
    return np.concatenate([np.zeros(0, int), *rows])
