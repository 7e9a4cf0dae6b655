"""The two printed solids: closed surfaces of SMP and TPE that share one interface, and the proof that they are."""

import math
from dataclasses import dataclass

import manifold3d
import numpy as np

from fab4d.errors import BodyError
from fab4d.fabrication._links import split_fans
from fab4d.mesh.measures import tet_volumes
from fab4d.mesh.quality import non_manifold_edges
from fab4d.mesh.tetmesh import BoolArray, FloatArray, IntArray, frozen
from fab4d.mesh.topology import component_labels, face_table

# Coordinates are multiples of this, mm: below 1 m they are exact in float32, so an STL file holds the same solid.
FINEST_STEP = 2.0**-14
# How far the tip of a cone is drawn back where the part touches itself at a vertex, mm: less than any printer resolves.
TIP_GAP = 2.0**-7
RELATIVE_VOLUME_ERROR = 1e-12
_FACE_EDGES = np.array([[0, 1], [1, 2], [2, 0]])


@dataclass(frozen=True, eq=False)
class Body:
    """A closed triangle mesh: vertices (n, 3) in mm, all used; faces (b, 3), outward."""

    name: str
    vertices: FloatArray
    faces: IntArray

    def __post_init__(self) -> None:
        object.__setattr__(self, "vertices", frozen(self.vertices, np.float64))
        object.__setattr__(self, "faces", frozen(self.faces, np.int64))

    @property
    def volume(self) -> float:
        """Enclosed volume, mm^3: the exact sum of the tets between the faces and the first vertex."""
        a, b, c = np.moveaxis((self.vertices - self.vertices[0])[self.faces], 1, 0)
        return math.fsum(np.einsum("fi,fi->f", a, np.cross(b, c))) / 6.0


@dataclass(frozen=True, eq=False)
class Bodies:
    """The printed solids. `smp` or `tpe` is None when the design has none of it."""

    smp: Body | None
    tpe: Body | None
    whole: Body
    interface_triangles: int
    tips_drawn_back: int
    """Vertices at which the part touched itself and was parted by TIP_GAP."""

    @property
    def printed(self) -> list[Body]:
        """The bodies that exist, SMP first."""
        return [body for body in (self.smp, self.tpe) if body is not None]


def bodies_from_labels(X: FloatArray, tets: IntArray, smp: BoolArray) -> Bodies:
    """The surfaces of the SMP and the TPE of labelled tets; both take the same interface triangles, one reversed.

    X : (n, 3), mm        tets : (m, 4), positively oriented        smp : (m,)

    Raises BodyError when the part is in pieces, touches itself along an edge, or has a tet too flat to print.
    """
    _require_one_piece(X, tets)
    _require_no_double_edge(X, face_table(tets).boundary)
    vertices = split_fans(tets)
    faces = face_table(vertices)
    points = _fan_points(X, tets, vertices)
    boundary, points = _surface_fans(points, faces.boundary)
    points = snapped(points)
    _require_positive(points, vertices, tets)
    owners, (first, second) = smp[faces.boundary_tets], smp[faces.interior_tets].T
    bodies = {}
    for name, label in (("smp", True), ("tpe", False)):
        outward = faces.interior[(first == label) & (second != label)]
        inward = faces.interior[(first != label) & (second == label)][:, ::-1]
        bodies[name] = _body(name, points, np.concatenate([boundary[owners == label], outward, inward]))
    whole = _body("part", points, boundary)
    assert whole is not None  # a mesh with a tet has a surface
    drawn_back = len(points) - int(tets.max()) - 1
    return Bodies(bodies["smp"], bodies["tpe"], whole, int(np.sum(first != second)), drawn_back)


def snapped(X: FloatArray) -> FloatArray:
    """X (n, 3) rounded to multiples of 2^-14 mm; beyond 1 m, of the finest step that float32 holds."""
    largest = float(np.abs(X).max(initial=1.0))
    step = max(FINEST_STEP, 2.0 ** (math.ceil(math.log2(largest)) - 24))
    # Adding zero turns -0.0 into 0.0.
    return np.round(X / step) * step + 0.0


def _body(name: str, points: FloatArray, faces: IntArray) -> Body | None:
    if len(faces) == 0:
        return None
    used, compact = np.unique(faces, return_inverse=True)
    return Body(name, points[used], compact.reshape(-1, 3))


# Places where the part touches itself.


def _require_one_piece(X: FloatArray, tets: IntArray) -> None:
    piece = component_labels(len(tets), face_table(tets).interior_tets)
    if piece.max() == 0:
        return
    sizes = np.bincount(piece, np.abs(tet_volumes(X, tets)))
    loose = int(np.argmin(sizes))
    vertex = int(tets[piece == loose][0, 0])
    msg = (
        f"the part falls into {len(sizes)} pieces that share no face; the smallest, {sizes[loose]:.3g} mm^3, is that "
        f"of vertex {vertex} at {_place(X[vertex])}: join or remove it in the mesh"
    )
    raise BodyError(msg)


def _require_no_double_edge(points: FloatArray, boundary: IntArray) -> None:
    edges = non_manifold_edges(boundary)
    if len(edges):
        msg = (
            f"the part touches itself along {len(edges)} edges, the first at {_place(points[edges[0]].mean(axis=0))}: "
            "it would be held by an edge alone; thicken the mesh there"
        )
        raise BodyError(msg)


def _require_positive(points: FloatArray, vertices: IntArray, tets: IntArray) -> None:
    volumes = tet_volumes(points, vertices)
    worst = int(np.argmin(volumes))
    if volumes[worst] <= 0:
        msg = (
            f"tet {worst} (vertices {tets[worst].tolist()}, at {_place(points[vertices[worst]].mean(axis=0))}) is flat "
            f"or inverted once its coordinates are rounded to {FINEST_STEP:.2g} mm: mesh the part anew there"
        )
        raise BodyError(msg)


def _fan_points(X: FloatArray, tets: IntArray, vertices: IntArray) -> FloatArray:
    """Positions (n', 3) of the vertices of `split_fans`: where fans of tets meet in one vertex, all but the largest
    fan draw their tip back into themselves."""
    n = int(vertices.max()) + 1
    origin, size = np.zeros(n, np.int64), np.bincount(vertices.ravel(), minlength=n)
    origin[vertices] = tets
    inner = np.stack([_means(vertices.ravel(), np.repeat(X[tets].mean(axis=1)[:, k], 4), n) for k in range(3)], axis=1)
    return _drawn_back(X, origin, inner, size)


def _surface_fans(points: FloatArray, boundary: IntArray) -> tuple[IntArray, FloatArray]:
    """The faces (b, 3) with one vertex per fan of triangles, and the positions: where cones of air touch inside the
    part, all but the largest cone draw their tip back."""
    corner_fan = _corner_fans(boundary)
    n_fans = int(corner_fan.max()) + 1
    origin, size = np.zeros(n_fans, np.int64), np.bincount(corner_fan.ravel())
    origin[corner_fan] = boundary
    centre = points[boundary].mean(axis=1)
    inner = np.stack([_means(corner_fan.ravel(), np.repeat(centre[:, k], 3), n_fans) for k in range(3)], axis=1)
    moved = _drawn_back(points, origin, inner, size)
    extra = np.flatnonzero(_is_extra(origin, size))
    number = origin.copy()
    number[extra] = len(points) + np.arange(len(extra))
    return number[corner_fan], np.concatenate([points, moved[extra]])


def _corner_fans(faces: IntArray) -> IntArray:
    """Number (b, 3) of the fan that each corner belongs to: triangles around a vertex joined by edges."""
    corners = np.arange(faces.size).reshape(-1, 3)
    ends = faces[:, _FACE_EDGES].reshape(-1, 2)
    order = np.lexsort([np.max(ends, axis=1), np.min(ends, axis=1)])
    here, there = corners[:, _FACE_EDGES].reshape(-1, 2)[order].reshape(-1, 2, 2).transpose(1, 0, 2)
    # The two triangles of an edge run along it in opposite directions.
    pairs = np.concatenate([np.column_stack([here[:, 0], there[:, 1]]), np.column_stack([here[:, 1], there[:, 0]])])
    return component_labels(faces.size, pairs).reshape(-1, 3)


def _means(owner: IntArray, values: FloatArray, n: int) -> FloatArray:
    return np.bincount(owner, values, minlength=n) / np.bincount(owner, minlength=n)


def _is_extra(origin: IntArray, size: IntArray) -> BoolArray:
    """Which copies of a vertex are not its largest one (the first of equal ones)."""
    order = np.lexsort([-size, origin])
    extra = np.zeros(len(origin), bool)
    extra[order[1:]] = origin[order[1:]] == origin[order[:-1]]
    return extra


def _drawn_back(X: FloatArray, origin: IntArray, inner: FloatArray, size: IntArray) -> FloatArray:
    """X[origin], the extra copies moved by TIP_GAP (at most a tenth of the way) towards `inner`."""
    way = inner - X[origin]
    share = np.minimum(0.1, TIP_GAP / np.maximum(np.linalg.norm(way, axis=1), TIP_GAP))
    return X[origin] + np.where(_is_extra(origin, size), share, 0.0)[:, None] * way


# The gate.


def require_solid(body: Body) -> None:
    """Raise BodyError unless `body` is a closed, oriented 2-manifold that manifold3d keeps triangle by triangle."""
    # Both volumes are summed from the body itself, so that they do not lose digits far from the origin.
    solid = _solid(body.vertices - body.vertices[0], body.faces)
    if solid.status() != manifold3d.Error.NoError:
        msg = f"body {body.name}: {solid.status().name}{_defect(body)}; check the mesh there"
        raise BodyError(msg)
    if solid.num_tri() != len(body.faces):
        lost = len(body.faces) - solid.num_tri()
        msg = f"body {body.name}: {lost} of {len(body.faces)} triangles are degenerate or paired wrongly{_defect(body)}"
        raise BodyError(msg)
    if body.volume <= 0 or _differ(solid.volume(), body.volume):
        msg = f"body {body.name}: volume {body.volume!r} mm^3, but manifold3d finds {solid.volume()!r}{_defect(body)}"
        raise BodyError(msg)


def require_bodies(bodies: Bodies) -> None:
    """Raise BodyError unless every body is solid, the volumes add up, and SMP and TPE overlap in nothing."""
    for body in [*bodies.printed, bodies.whole]:
        require_solid(body)
    total = math.fsum(body.volume for body in bodies.printed)
    if _differ(total, bodies.whole.volume):
        msg = f"SMP and TPE add up to {total!r} mm^3, the part is {bodies.whole.volume!r} mm^3: the labels miss tets"
        raise BodyError(msg)
    if bodies.smp is not None and bodies.tpe is not None:
        smp, tpe = (as_manifold(body) for body in (bodies.smp, bodies.tpe))
        # By way of the union: manifold3d's intersection and difference of bodies that share faces are not always exact.
        overlap = math.fsum([bodies.smp.volume, bodies.tpe.volume, -(smp + tpe).volume()])
        if abs(overlap) > RELATIVE_VOLUME_ERROR * bodies.whole.volume:
            msg = f"SMP and TPE overlap in {overlap:.3g} mm^3: the part's tets overlap; check the mesh for folds"
            raise BodyError(msg)


def genus(body: Body) -> int:
    """Handles of a solid's surface, all its shells together."""
    # manifold3d counts 1 - (V - E + F) / 2, as if there were one shell.
    return int(as_manifold(body).genus()) + shells(body) - 1


def shells(body: Body) -> int:
    """Closed surfaces that a body consists of: its pieces and its enclosed pockets."""
    edges = body.faces[:, _FACE_EDGES].reshape(-1, 2)
    return int(component_labels(len(body.vertices), edges).max()) + 1


def as_manifold(body: Body) -> manifold3d.Manifold:
    """The body as a solid of manifold3d."""
    return _solid(body.vertices, body.faces)


def _solid(vertices: FloatArray, faces: IntArray) -> manifold3d.Manifold:
    return manifold3d.Manifold(manifold3d.Mesh64(vertices.copy(), faces.astype(np.uint64)))


def _differ(volume: float, expected: float) -> bool:
    return abs(volume - expected) > RELATIVE_VOLUME_ERROR * expected


def _defect(body: Body) -> str:
    """Where the first edge is that has not two faces, if there is one."""
    edges = non_manifold_edges(body.faces)
    if len(edges) == 0:
        return ""
    return f"; {len(edges)} edges have not two faces, the first at {_place(body.vertices[edges[0]].mean(axis=0))}"


def _place(point: FloatArray) -> str:
    return "(" + ", ".join(f"{value:.4g}" for value in point) + ") mm"
