"""Checks 4 to 6, 8 and 9 of a pair of shapes: clean, consistently oriented, of solid tets, and all in one piece."""

from dataclasses import dataclass, replace

import numpy as np

from fab4d.mesh.compatibility import has_repeated_vertex
from fab4d.mesh.findings import Finding, finding, named
from fab4d.mesh.intersection import MOST_PAIRS, self_intersections
from fab4d.mesh.measures import bounding_box_diagonal, tet_volumes
from fab4d.mesh.quality import (
    coincident_vertices,
    crowded_tets,
    min_dihedral_angles,
    non_manifold_edges,
    non_manifold_vertices,
    overlapping_tets,
    side_curvature,
)
from fab4d.mesh.rigid import best_rigid_motion
from fab4d.mesh.rows import repeats, row_ids
from fab4d.mesh.tetmesh import BoolArray, FloatArray, IntArray
from fab4d.mesh.topology import component_labels, face_table

_FLAT_VOLUME = 1e-12  # of the diagonal cubed
_FLAT_ANGLE, _THIN_ANGLE = 0.05, 5.0  # degrees
_RIGID_RESIDUAL = 1e-6  # of the diagonal, as are the next three
COINCIDENT = 1e-9
_CURVED_SIDE = 1e-6
_CLAMP_MOTION = 5e-3


@dataclass(frozen=True, eq=False)
class Pair:
    """Both shapes on one list of tets, in mm, and the numbers that vertices and tets have in the permanent file."""

    X: FloatArray
    X_temp: FloatArray
    tets: IntArray
    vertex_map: IntArray
    tet_map: IntArray
    files: tuple[str, str]

    @property
    def diagonal(self) -> float:
        return bounding_box_diagonal(self.X)


# 4. Cleaning.


def clean(pair: Pair) -> tuple[Pair, list[Finding]]:
    findings = _curved_sides(pair)
    used_by_file = np.unique(pair.tets)
    corners = replace(pair, tets=np.ascontiguousarray(pair.tets[:, :4]))
    kept, found = _without_tets(corners, has_repeated_vertex(corners.tets), "repeated-vertex", "use a vertex twice")
    findings += found
    duplicate = repeats(row_ids(np.sort(kept.tets, axis=1)))
    kept, found = _without_tets(kept, duplicate, "duplicate-tet", "are listed before")
    findings += found
    if len(kept.tets) == 0:
        return kept, [*findings, finding("no-tets", "error", pair.files[0], "no tet has four different vertices")]
    unused = np.setdiff1d(np.arange(len(pair.X)), used_by_file)
    if len(unused):
        message = f"{len(unused)} vertices belong to no tet ({named('vertex', unused)}): left out"
        findings.append(finding("unreferenced-vertex", "repaired", pair.files[0], message, unused))
    return _without_unused_vertices(kept), findings


def _curved_sides(pair: Pair) -> list[Finding]:
    if pair.tets.shape[1] == 4:
        return []
    findings = []
    for points, file in zip((pair.X, pair.X_temp), pair.files, strict=True):
        sag = side_curvature(points, pair.tets)
        curved = np.flatnonzero(sag > _CURVED_SIDE * bounding_box_diagonal(points[pair.tets].reshape(-1, 3)))
        if len(curved):
            message = (
                f"{len(curved)} of the 10-node tets have curved sides ({named('tet', curved)}, up to {sag.max():.3g} "
                "mm): straight ones are used"
            )
            findings.append(finding("curved-sides", "warning", file, message, curved))
    return findings


def _without_tets(pair: Pair, drop: BoolArray, code: str, what: str) -> tuple[Pair, list[Finding]]:
    if not drop.any():
        return pair, []
    dropped = pair.tet_map[drop]
    message = f"{len(dropped)} tets {what} ({named('tet', dropped)}): left out"
    kept = replace(pair, tets=pair.tets[~drop], tet_map=pair.tet_map[~drop])
    return kept, [finding(code, "repaired", pair.files[0], message, dropped)]


def _without_unused_vertices(pair: Pair) -> Pair:
    used, numbers = np.unique(pair.tets, return_inverse=True)
    return replace(
        pair,
        X=pair.X[used],
        X_temp=pair.X_temp[used],
        tets=numbers.reshape(-1, 4).astype(np.int64),
        vertex_map=pair.vertex_map[used],
    )


# 5. Orientation.


def orient(pair: Pair) -> tuple[Pair, list[Finding]]:
    crowded = pair.tet_map[crowded_tets(pair.tets)]
    file = pair.files[0]
    if len(crowded):
        message = f"more than two tets share a face ({named('tet', crowded)}): the mesh overlaps itself, mesh it anew"
        return pair, [finding("shared-face", "error", file, message, crowded)]
    volumes = tet_volumes(pair.X, pair.tets)
    # Tets without volume have no side; the next check refuses them.
    solid = np.abs(volumes) > _FLAT_VOLUME * pair.diagonal**3
    negative = solid & (volumes < 0)
    tets = np.where(negative[:, None], pair.tets[:, [0, 1, 3, 2]], pair.tets)
    folded = np.zeros(len(tets), bool)
    folded[solid] = overlapping_tets(tets[solid])
    if folded.any():
        return pair, [_fold(pair, volumes, folded & negative if (folded & negative).any() else folded)]
    if not negative.any():
        return pair, []
    flipped = pair.tet_map[negative]
    message = f"{len(flipped)} of {len(tets)} tets are listed left-handed ({named('tet', flipped)}): turned round"
    return replace(pair, tets=tets), [finding("left-handed", "repaired", file, message, flipped)]


def _fold(pair: Pair, volumes: FloatArray, folded: BoolArray) -> Finding:
    rows = np.flatnonzero(folded)
    where = pair.tet_map[rows]
    vertices = pair.vertex_map[pair.tets[rows[0]]].tolist()
    message = (
        f"{named('tet', where)} ({len(where)}) lie on the wrong side of a neighbour: the permanent shape is folded "
        f"(tet {where[0]} with vertices {vertices} has volume {volumes[rows[0]]:.3g} mm^3); move these vertices or "
        "mesh it anew"
    )
    return finding("folded", "error", pair.files[0], message, where)


# 6. Shape of the tets.


def check_tets(pair: Pair) -> tuple[Pair, list[Finding]]:
    volumes, angles = tet_volumes(pair.X, pair.tets), min_dihedral_angles(pair.X, pair.tets)
    file = pair.files[0]
    empty = np.abs(volumes) <= _FLAT_VOLUME * pair.diagonal**3
    flat = ~empty & (angles < _FLAT_ANGLE)
    thin = ~empty & ~flat & (angles < _THIN_ANGLE)
    findings = []
    if empty.any():
        worst = int(np.argmax(empty))
        message = (
            f"{empty.sum()} tets have no volume ({named('tet', pair.tet_map[empty])}; tet {pair.tet_map[worst]} with "
            f"vertices {pair.vertex_map[pair.tets[worst]].tolist()}: {volumes[worst]:.3g} mm^3): mesh the part anew"
        )
        findings.append(finding("zero-volume", "error", file, message, pair.tet_map[empty]))
    if flat.any():
        message = (
            f"{flat.sum()} tets are flat ({named('tet', pair.tet_map[flat])}; smallest dihedral angle "
            f"{angles[flat].min():.3g} degrees, at least {_FLAT_ANGLE:g} is needed): mesh the part anew"
        )
        findings.append(finding("flat-tet", "error", file, message, pair.tet_map[flat]))
    if thin.any():
        message = (
            f"{thin.sum()} tets are thin ({named('tet', pair.tet_map[thin])}; smallest dihedral angle "
            f"{angles[thin].min():.3g} degrees): forces there are less exact"
        )
        findings.append(finding("thin-tet", "warning", file, message, pair.tet_map[thin]))
    return pair, findings


# 7. Mirror image.


def check_mirror(pair: Pair) -> tuple[Pair, list[Finding]]:
    """Whether the surface of the temporary shape is inside out: the volume in it does not depend on inner vertices."""
    if tet_volumes(pair.X_temp, pair.tets).sum() > 0:
        return pair, []
    message = (
        f"the mirror image of {pair.files[0]} (its surface is inside out): an axis conversion of the exporter "
        "exchanged or negated one axis in one of the files"
    )
    return pair, [finding("mirrored", "error", pair.files[1], message, pair.tet_map)]


# 8. Rigid motion.


def rigid_residuals(X: FloatArray, X_temp: FloatArray) -> FloatArray:
    R, t = best_rigid_motion(X, X_temp)
    return np.linalg.norm(X @ R.T + t - X_temp, axis=1)


def check_motion(pair: Pair, clamp: BoolArray) -> tuple[bool, list[Finding]]:
    """Whether both surfaces are equal up to a rigid motion, and whether the clamp itself would have to deform."""
    surface = np.unique(face_table(pair.tets).boundary)
    if rigid_residuals(pair.X[surface], pair.X_temp[surface]).max() < _RIGID_RESIDUAL * pair.diagonal:
        message = f"equal to {pair.files[0]} up to a rigid motion: nothing to program"
        return True, [finding("nothing-to-program", "warning", pair.files[1], message)]
    moved = clamp_deformation(pair, clamp)
    if moved <= _CLAMP_MOTION * pair.diagonal:
        return False, []
    message = (
        f"the clamp region differs from its permanent shape by up to {moved:.3g} mm, but the rig holds it as it is: "
        "make the clamp smaller or leave it undeformed"
    )
    return False, [finding("clamp-deforms", "warning", pair.files[1], message, pair.vertex_map[clamp])]


def clamp_deformation(pair: Pair, clamp: BoolArray) -> float:
    held = wanted_clamp(pair, clamp)
    return float(rigid_residuals(pair.X[held], pair.X_temp[held]).max()) if clamp.any() else 0.0


def wanted_clamp(pair: Pair, clamp: BoolArray) -> BoolArray:
    """The clamp's vertices (n,) on the surface, for only this is wanted; all of the clamp where they could turn."""
    on_surface = clamp.copy()
    on_surface[np.setdiff1d(np.arange(len(clamp)), face_table(pair.tets).boundary)] = False
    return on_surface if _holds(pair.X[on_surface]) else clamp


# 9. The boundary and what hangs together.


def check_boundary(pair: Pair, clamp: BoolArray) -> list[Finding]:
    faces = face_table(pair.tets).boundary
    return [
        *_non_manifold(pair, faces),
        *_pieces(pair),
        *_clamp_turns(pair, clamp),
        *_unmerged(pair),
        *_no_interior(pair, faces),
    ]


def _non_manifold(pair: Pair, faces: IntArray) -> list[Finding]:
    edges = pair.vertex_map[non_manifold_edges(faces)]
    vertices = pair.vertex_map[non_manifold_vertices(faces)]
    findings = []
    if len(edges):
        message = (
            f"the surface touches itself along {len(edges)} edges (vertices {edges[0, 0]} and {edges[0, 1]}): "
            "such a part cannot be printed; thicken it there"
        )
        findings.append(finding("non-manifold-edge", "error", pair.files[0], message, edges[:, 0]))
    if len(vertices):
        message = (
            f"the surface touches itself at {len(vertices)} single vertices ({named('vertex', vertices)}): "
            "the part is pinched there"
        )
        findings.append(finding("non-manifold-vertex", "warning", pair.files[0], message, vertices))
    return findings


# 10. Self-intersection.


def check_crossings(pair: Pair, x: FloatArray, file: str, severity: str, advice: str) -> list[Finding]:
    """Whether the surface of the shape x (n, 3) passes through itself."""
    faces = face_table(pair.tets).boundary
    pairs = self_intersections(x, faces)
    if not len(pairs):
        return []
    first, second = faces[pairs[0]]
    place = ", ".join(f"{c:.4g}" for c in x[first].mean(axis=0))
    some = np.unique(faces[pairs])
    message = (
        f"the surface passes through itself ({len(pairs)}{' or more' if len(pairs) == MOST_PAIRS else ''} pairs of "
        f"triangles, one of vertices {pair.vertex_map[first].tolist()} and {pair.vertex_map[second].tolist()} near "
        f"({place}) mm): {advice}"
    )
    return [finding("self-intersection", severity, file, message, pair.vertex_map[some])]


def _pieces(pair: Pair) -> list[Finding]:
    """A part is printed as one body, and tets that share no face are not printed as one.

    Clamps do not help: once unloaded, pieces have no place relative to each other that could be right or wrong.
    """
    piece = component_labels(len(pair.tets), face_table(pair.tets).interior_tets)
    n_pieces = int(piece.max()) + 1
    if n_pieces == 1:
        return []
    volumes = np.bincount(piece, np.abs(tet_volumes(pair.X, pair.tets)))
    smallest = int(np.argmin(volumes))
    vertices = pair.vertex_map[np.unique(pair.tets[piece == smallest])]
    message = (
        f"the part is in {n_pieces} pieces that share no face, the smallest ({volumes[smallest]:.3g} mm^3) that of "
        f"{named('vertex', vertices)}: it must be one body; join the pieces, merge coincident vertices if the "
        "exporter did not, or make a scene of each piece"
    )
    return [finding("pieces", "error", pair.files[0], message, vertices)]


def _clamp_turns(pair: Pair, clamp: BoolArray) -> list[Finding]:
    caught = np.flatnonzero(clamp)
    if len(caught) == 0 or _holds(pair.X[caught]):
        return []
    message = (
        f"the clamp catches only {named('vertex', pair.vertex_map[caught])}, on one line: the part could turn; hold "
        "three vertices that are not in line"
    )
    return [finding("clamp-turns", "error", pair.files[0], message, pair.vertex_map[caught])]


def _holds(points: FloatArray) -> bool:
    """Whether the points (k, 3) are not all on one line."""
    if len(points) < 3:
        return False
    size = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    return bool(size[1] > 1e-6 * size[0])


def _unmerged(pair: Pair) -> list[Finding]:
    pairs = pair.vertex_map[coincident_vertices(pair.X, COINCIDENT * pair.diagonal)]
    if not len(pairs):
        return []
    message = (
        f"{len(pairs)} pairs of vertices lie at one place without being joined (vertices {pairs[0, 0]} and "
        f"{pairs[0, 1]}): a cut, unless the exporter should have merged them"
    )
    return [finding("coincident-vertices", "warning", pair.files[0], message, pairs[:, 0])]


def _no_interior(pair: Pair, faces: IntArray) -> list[Finding]:
    if len(np.unique(faces)) < len(pair.X):
        return []
    message = "no vertex is inside: the part is one tet thick, and linear tets are far too stiff in bending; refine it"
    return [finding("one-tet-thick", "warning", pair.files[0], message)]
