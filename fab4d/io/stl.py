"""Binary STL: triangles without a unit, in float32."""

import numpy as np

from fab4d.errors import BodyError
from fab4d.mesh.measures import face_area_vectors
from fab4d.mesh.tetmesh import FloatArray, IntArray

_HEADER_SIZE = 80
_TRIANGLE = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])


def stl_bytes(vertices: FloatArray, faces: IntArray, name: str) -> bytes:
    """A binary STL file of the triangles faces (b, 3) over vertices (n, 3); equal bodies give equal bytes.

    Raises BodyError when a coordinate is not exact in float32: the file would hold another solid.
    """
    single = vertices.astype("<f4")
    inexact = np.flatnonzero((single != vertices).any(axis=1))
    if len(inexact):
        place = vertices[inexact[0]].tolist()
        msg = f"body {name}: vertex {inexact[0]} at {place} mm is not exact in float32; snap it first"
        raise BodyError(msg)
    triangles = np.zeros(len(faces), _TRIANGLE)
    areas = face_area_vectors(vertices, faces)
    triangles["normal"] = areas / np.linalg.norm(areas, axis=1, keepdims=True)
    triangles["corners"] = single[faces]
    # A header that begins with "solid" would be taken for the text form.
    header = f"fab4d {name}, binary STL, lengths in mm".encode("ascii", "replace")[:_HEADER_SIZE]
    return header.ljust(_HEADER_SIZE) + np.uint32(len(faces)).astype("<u4").tobytes() + triangles.tobytes()


def stl_arrays(data: bytes, name: str) -> tuple[FloatArray, IntArray]:
    """Vertices (n, 3) and faces (b, 3) of a binary STL file, equal coordinates welded as slicers do.

    Raises BodyError when the file is cut off or is not binary STL.
    """
    start = _HEADER_SIZE + 4
    count = int.from_bytes(data[_HEADER_SIZE:start], "little")
    if len(data) < start or len(data) != start + count * _TRIANGLE.itemsize:
        msg = f"{name}: {len(data)} bytes are not a binary STL file of {count} triangles; write it again"
        raise BodyError(msg)
    corners = np.frombuffer(data, _TRIANGLE, count, start)["corners"].reshape(-1, 3)
    vertices, faces = np.unique(corners.astype(np.float64), axis=0, return_inverse=True)
    return vertices, faces.reshape(-1, 3).astype(np.int64)
