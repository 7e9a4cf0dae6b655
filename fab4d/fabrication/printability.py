"""What no slicer checks: whether labelled bodies come out of the printer as they are.

Slicers drop what is thinner than a line, print what does not hang together, and leave a part that is too large or that
falls over to the user.
"""

from dataclasses import dataclass

import manifold3d
import numpy as np
from scipy.spatial import ConvexHull

from fab4d.fabrication.bodies import Bodies, as_manifold
from fab4d.fabrication.features import thin_places
from fab4d.fabrication.labels import clusters_of
from fab4d.fabrication.layers import unfilled
from fab4d.fabrication.wellcomposed import pinched_vertices
from fab4d.mesh.measures import face_area_vectors, tet_volumes
from fab4d.mesh.tetmesh import BoolArray, FloatArray, IntArray
from fab4d.mesh.topology import component_labels, face_table

# A feature without a limit across or along the build direction is this share of the other one.
_NO_LIMIT = 1e-3
MAX_THIN_SHARE = 1e-3
"""Share of the volume that sharp edges may have in walls that are too thin."""
MAX_EMPTY_SHARE = 0.03
"""Share of a body that lines may leave empty: as much as a slice may differ from its body."""
MARGIN = 0.2
"""A figure this near to its limit, as a share of it, is worth a look although it holds."""
MAX_SLENDERNESS = 10.0
"""Height over the root of the first layer's area: above, the nozzle knocks a part over."""
MAX_PURGE_SHARE = 1.0
"""Purge over the volume of the part."""


@dataclass(frozen=True)
class PrintLimits:
    """What a printer can do: usable volume (mm), nozzle diameter, width and height of a line (mm), purge (mm^3)."""

    volume: tuple[float, float, float]
    nozzle: float
    line_width: float
    layer_height: float
    purge_per_change: float


@dataclass(frozen=True)
class PrintCheck:
    """One figure against its limit; `where` is the place (mm) of the worst."""

    check: str
    ok: bool
    value: float
    sense: str
    """`at most` or `at least` the limit"""
    limit: float
    unit: str
    where: tuple[float, float, float] | None = None

    @property
    def marginal(self) -> bool:
        """Whether it holds by little only."""
        if not self.ok or self.limit == 0:
            return False
        gap = self.value - self.limit if self.sense == "at least" else self.limit - self.value
        return gap < MARGIN * abs(self.limit) and not float(self.value).is_integer()


def print_checks(
    X: FloatArray, tets: IntArray, smp: BoolArray, bodies: Bodies, limits: PrintLimits
) -> list[PrintCheck]:
    """Every check of labelled tets and their bodies, built along z.

    X : (n, 3), mm        tets : (m, 4)        smp : (m,)
    """
    return [
        *_thin(X, tets, smp, limits),
        *_unfilled(bodies, limits),
        *_clusters(X, tets, smp, limits),
        _pieces(tets),
        _held_by_an_edge(X, tets, smp),
        *_first_layer(bodies, limits),
        _fits(X, limits),
        _purge(X, tets, smp, limits),
    ]


def tool_changes(X: FloatArray, tets: IntArray, smp: BoolArray, layer_height: float) -> int:
    """Changes of tool: one in each layer that holds both materials, for the next layer begins with the last tool."""
    bottom = X[:, 2].min()
    first, last = (
        np.rint(z(X[tets][:, :, 2], axis=1) / layer_height - bottom / layer_height).astype(np.int64)
        for z in (np.min, np.max)
    )
    n_layers = int(last.max()) + 1
    holds = []
    for label in (True, False):
        inside = smp == label
        steps = np.bincount(first[inside], minlength=n_layers) - np.bincount(last[inside], minlength=n_layers)
        holds.append(np.cumsum(steps) > 0)
    return int(np.sum(holds[0] & holds[1]))


def _thin(X: FloatArray, tets: IntArray, smp: BoolArray, limits: PrintLimits) -> list[PrintCheck]:
    nozzle, layer = limits.nozzle, limits.layer_height
    features = {
        "walls below the nozzle": (nozzle, _NO_LIMIT * nozzle),
        "places below a layer": (_NO_LIMIT * layer, layer),
    }
    return [_thin_share(name, X, tets, thin_places(X, tets, smp, *feature)) for name, feature in features.items()]


def _thin_share(name: str, X: FloatArray, tets: IntArray, thin: BoolArray) -> PrintCheck:
    volumes = np.abs(tet_volumes(X, tets))
    share = float(volumes[thin].sum() / volumes.sum())
    where = _middle(X, tets[[np.argmax(np.where(thin, volumes, 0.0))]]) if thin.any() else None
    return PrintCheck(name, share <= MAX_THIN_SHARE, share, "at most", MAX_THIN_SHARE, "of the volume", where)


def _unfilled(bodies: Bodies, limits: PrintLimits) -> list[PrintCheck]:
    """Sharp corners and walls of each body that are narrower than a line."""
    return [
        PrintCheck(
            f"{name.upper()} that lines leave empty",
            found.share <= MAX_EMPTY_SHARE,
            found.share,
            "at most",
            MAX_EMPTY_SHARE,
            "of its volume",
            found.where,
        )
        for name, found in unfilled(bodies, limits.line_width, limits.layer_height).items()
    ]


def _clusters(X: FloatArray, tets: IntArray, smp: BoolArray, limits: PrintLimits) -> list[PrintCheck]:
    """The smallest cluster, and the cluster that is held by the least area of the other material."""
    cluster = clusters_of(tets, smp)
    line, layer = limits.line_width, limits.layer_height
    volumes = np.bincount(cluster, np.abs(tet_volumes(X, tets))).astype(np.float64)
    checks = [_least("smallest cluster", volumes, 4 * line * line * 2 * layer, "mm^3", X, tets, cluster)]
    areas = _interface_areas(X, tets, smp, cluster)
    if areas.any():
        checks.append(_least("smallest contact of a cluster", areas, 4 * line * line, "mm^2", X, tets, cluster))
    return checks


def _least(
    name: str, values: FloatArray, limit: float, unit: str, X: FloatArray, tets: IntArray, cluster: IntArray
) -> PrintCheck:
    worst = int(np.argmin(values))
    value = float(values[worst])
    return PrintCheck(name, value >= limit, value, "at least", limit, unit, _middle(X, tets[cluster == worst]))


def _interface_areas(X: FloatArray, tets: IntArray, smp: BoolArray, cluster: IntArray) -> FloatArray:
    faces = face_table(tets)
    between = smp[faces.interior_tets[:, 0]] != smp[faces.interior_tets[:, 1]]
    areas = np.linalg.norm(face_area_vectors(X, faces.interior[between]), axis=1)
    sides = faces.interior_tets[between]
    return np.bincount(cluster[sides].T.ravel(), np.tile(areas, 2), minlength=int(cluster.max()) + 1).astype(np.float64)


def _pieces(tets: IntArray) -> PrintCheck:
    pieces = int(component_labels(len(tets), face_table(tets).interior_tets).max()) + 1
    return PrintCheck("pieces of the part", pieces == 1, pieces, "at most", 1, "")


def _held_by_an_edge(X: FloatArray, tets: IntArray, smp: BoolArray) -> PrintCheck:
    pinched = pinched_vertices(tets, smp)
    x, y, z = X[pinched[0]] if len(pinched) else (0.0, 0.0, 0.0)
    where = (float(x), float(y), float(z)) if len(pinched) else None
    return PrintCheck(
        "places held by an edge or a point", len(pinched) == 0, len(pinched), "at most", 0, "vertices", where
    )


def _first_layer(bodies: Bodies, limits: PrintLimits) -> list[PrintCheck]:
    whole = bodies.whole
    low, high = whole.vertices[:, 2].min(), whole.vertices[:, 2].max()
    section = as_manifold(whole).slice(low + 0.5 * limits.layer_height)
    area = section.area()
    slenderness = float((high - low) / np.sqrt(area)) if area > 0 else float("inf")
    x, y, z = _centre_of_mass(whole.vertices, whole.faces).tolist()
    name, foot = "height over the root of the first layer's area", (x, y, float(low))
    checks = [_at_most(name, slenderness, MAX_SLENDERNESS, "", foot)]
    if area > 0:
        margin = _inside_hull(section, np.array([x, y]))
        name = "centre of mass inside the first layer's hull"
        checks.append(PrintCheck(name, margin >= 0, margin, "at least", 0.0, "mm", (x, y, z)))
    return checks


def _inside_hull(section: manifold3d.CrossSection, point: FloatArray) -> float:
    """How far (mm) `point` is inside the convex hull of a cross-section; negative outside."""
    hull = ConvexHull(np.concatenate(section.to_polygons()))
    return float(-np.max(hull.equations[:, :2] @ point + hull.equations[:, 2]))


def _centre_of_mass(vertices: FloatArray, faces: IntArray) -> FloatArray:
    """Of the solid inside closed faces, from the tets between them and the first vertex."""
    a, b, c = np.moveaxis((vertices - vertices[0])[faces], 1, 0)
    volumes = np.einsum("fi,fi->f", a, np.cross(b, c))
    centre: FloatArray = vertices[0] + volumes @ (a + b + c) / (4.0 * volumes.sum())
    return centre


def _fits(X: FloatArray, limits: PrintLimits) -> PrintCheck:
    """How far the part as it stands sticks out of the volume, turned by 90 degrees about z if that helps."""
    sides = np.ptp(X, axis=0)
    volume = np.array(limits.volume)
    outside = min(float(np.max(sides[order] - volume)) for order in ([0, 1, 2], [1, 0, 2]))
    return _at_most("reach beyond the volume of both tools", outside, 0.0, "mm")


def _purge(X: FloatArray, tets: IntArray, smp: BoolArray, limits: PrintLimits) -> PrintCheck:
    purge = tool_changes(X, tets, smp, limits.layer_height) * limits.purge_per_change
    share = float(purge / np.abs(tet_volumes(X, tets)).sum())
    return _at_most("purge of the tool changes", share, MAX_PURGE_SHARE, "of the volume")


def _at_most(
    name: str, value: float, limit: float, unit: str, where: tuple[float, float, float] | None = None
) -> PrintCheck:
    return PrintCheck(name, value <= limit, value, "at most", limit, unit, where)


def _middle(X: FloatArray, tets: IntArray) -> tuple[float, float, float]:
    x, y, z = X[tets].mean(axis=(0, 1))
    return float(x), float(y), float(z)
