"""From the relaxed density to labels that can be printed: one material a tet, and what that changed."""

from dataclasses import dataclass

import numpy as np

from fab4d.fabrication.bodies import Bodies, bodies_from_labels
from fab4d.fabrication.features import without_thin_places
from fab4d.fabrication.layers import FEW_LEVELS, MOST_LEVELS, unfilled
from fab4d.fabrication.wellcomposed import pinched_vertices, well_composed
from fab4d.mesh.measures import tet_volumes
from fab4d.mesh.tetmesh import BoolArray, FloatArray, IntArray, frozen
from fab4d.mesh.topology import component_labels, face_table

AMBIGUOUS = 0.05, 0.95


MAX_UNFILLED = 0.025
"""Share of a body that lines may leave empty at its interface before the smallest feature grows; slices keep 3 %."""
# Where a few layers leave less than this share of MAX_UNFILLED empty, so many more are not looked at.
_CLEARLY_FILLED = 0.5
MAX_GROWTHS = 2
_GROWTH = 1.25, 2.0
_SMALL_CHANGE = 0.02


@dataclass(frozen=True, eq=False)
class LabelResult:
    """Printable labels."""

    smp: BoolArray
    """(m,) whether each tet is SMP."""
    cluster: IntArray
    """(m,) 0 for TPE, 1.. for face-connected SMP clusters by falling volume."""
    changed_fraction: dict[str, float]
    """Volume fraction that each clean-up step changed; "total" against the labels given, after all steps."""
    feature: tuple[float, float]
    """Smallest feature across and along the build direction that was kept in the end, mm."""
    defects_left: IntArray
    """(k,) vertices outside `part_defects` where the boundary of a material is still pinched."""
    part_defects: IntArray
    """(k,) vertices where the part's own surface is pinched: labels cannot help there."""


@dataclass(frozen=True)
class Lines:
    """Of a printer, mm: width and height of a line, smallest feature across and along the build direction."""

    width: float
    height: float
    feature_xy: float
    feature_z: float


def printable_labels(
    X: FloatArray,
    tets: IntArray,
    rho_or_labels: FloatArray | BoolArray,
    lines: Lines,
    flip_cost: FloatArray | None = None,
) -> LabelResult:
    """Labels near the given ones that both extruders can lay down as solid bodies.

    X : (n, 3), mm, built along z        tets : (m, 4)
    rho_or_labels : (m,) density in [0, 1], SMP above 0.5, or bool labels
    flip_cost : (m,) cost of changing each tet while defects are repaired; None: its volume

    Steps: clusters smaller than one feature go to the material around them, then places thinner than a feature do,
    then labels are made well composed. Clusters are absorbed again after each later step. Where lines would still
    leave too much of a body empty (many sharp corners), the steps are taken again with a larger smallest feature, as
    long as that changes no more than the first time: noise goes, a design stays.
    Raises BodyError for a part that cannot be printed whatever its labels.
    """
    rounded = rounded_labels(rho_or_labels)
    volumes = np.abs(tet_volumes(X, tets))
    cost = volumes if flip_cost is None else np.asarray(flip_cost, dtype=np.float64)
    feature = lines.feature_xy, lines.feature_z
    steps = _cleaned(X, tets, volumes, rounded, cost, *feature)
    smp, feature = _with_larger_features(X, tets, volumes, rounded, steps["well_composed"], cost, lines)
    steps["larger_features"] = smp
    changed = _changes(rounded, steps, volumes)
    clusters = smp_clusters(tets, volumes, smp)
    part_defects = pinched_vertices(tets)
    defects = np.setdiff1d(pinched_vertices(tets, smp), part_defects)
    return LabelResult(frozen(smp, np.bool_), frozen(clusters, np.int64), changed, feature, defects, part_defects)


def _cleaned(
    X: FloatArray,
    tets: IntArray,
    volumes: FloatArray,
    labels: BoolArray,
    cost: FloatArray,
    feature_xy: float,
    feature_z: float,
) -> dict[str, BoolArray]:
    """Labels (m,) after each step in turn."""
    smallest = feature_xy * feature_xy * feature_z
    clustered = without_small_clusters(tets, volumes, labels, smallest)
    opened = without_thin_places(X, tets, clustered, feature_xy, feature_z)
    thick = without_small_clusters(tets, volumes, opened, smallest)
    repaired = well_composed(tets, thick, cost)
    composed = without_small_clusters(tets, volumes, repaired, smallest)
    return {"clusters": clustered, "features": thick, "well_composed": composed}


def _with_larger_features(
    X: FloatArray,
    tets: IntArray,
    volumes: FloatArray,
    given: BoolArray,
    cleaned: BoolArray,
    cost: FloatArray,
    lines: Lines,
) -> tuple[BoolArray, tuple[float, float]]:
    """Labels (m,) whose bodies lines fill better than `cleaned`, and the smallest feature that made them."""
    best = smp = cleaned
    feature = best_feature = lines.feature_xy, lines.feature_z
    allowed = max(_SMALL_CHANGE * volumes.sum(), volumes[cleaned != given].sum())
    empty = least = _unfilled_inside(bodies_from_labels(X, tets, smp), lines)
    for _ in range(MAX_GROWTHS):
        if least <= MAX_UNFILLED:
            break
        # What is empty falls with the square of the size.
        growth = float(np.clip(np.sqrt(empty / MAX_UNFILLED), *_GROWTH))
        feature = growth * feature[0], growth * feature[1]
        smp = _cleaned(X, tets, volumes, smp, cost, *feature)["well_composed"]
        if volumes[smp != cleaned].sum() > allowed:
            break
        empty = _unfilled_inside(bodies_from_labels(X, tets, smp), lines)
        if empty < least:
            best, best_feature, least = smp, feature, empty
    return best, best_feature


def _unfilled_inside(bodies: Bodies, lines: Lines) -> float:
    """Share of the worse body that lines leave empty because of the interface; 0 with one material."""
    if len(bodies.printed) < 2:
        return 0.0

    def share(most_levels: int) -> float:
        found = unfilled(bodies, lines.width, lines.height, most_levels)
        return max(body.share_inside for body in found.values())

    first_look = share(FEW_LEVELS)
    return first_look if first_look <= _CLEARLY_FILLED * MAX_UNFILLED else share(MOST_LEVELS)


def rounded_labels(rho_or_labels: FloatArray | BoolArray) -> BoolArray:
    """SMP where the density (m,) is above 0.5; labels stay what they are."""
    return np.asarray(rho_or_labels, dtype=np.float64) > 0.5


def ambiguous_fraction(rho: FloatArray) -> float:
    """Share of the tets, by count, with rho in [0.05, 0.95]. Source: the paper's first acceptance check."""
    low, high = AMBIGUOUS
    return float(np.mean((rho >= low) & (rho <= high)))


def isolated_fraction(tets: IntArray, smp: BoolArray) -> float:
    """Share of the SMP tets without a face-adjacent SMP tet; 0 without SMP. Source: the paper's second check."""
    first, second = face_table(tets).interior_tets.T
    together = smp[first] & smp[second]
    joined = np.zeros(len(tets), bool)
    joined[first[together]] = True
    joined[second[together]] = True
    isolated, total = int(np.sum(smp & ~joined)), int(np.sum(smp))
    return isolated / max(1, total)


def clusters_of(tets: IntArray, labels: BoolArray) -> IntArray:
    """Number (m,) from 0 of the face-connected cluster of equal labels that each tet belongs to."""
    return _clusters(face_table(tets).interior_tets, labels)


def _clusters(pairs: IntArray, labels: BoolArray) -> IntArray:
    return component_labels(len(labels), pairs[labels[pairs[:, 0]] == labels[pairs[:, 1]]])


def enclosed(tets: IntArray, labels: BoolArray) -> BoolArray:
    """Tets (m,) of clusters that nowhere reach the surface of the part: pockets of one material in the other."""
    faces = face_table(tets)
    cluster = _clusters(faces.interior_tets, labels)
    open_ones = np.unique(cluster[faces.boundary_tets])
    return ~np.isin(cluster, open_ones)


def smp_clusters(tets: IntArray, volumes: FloatArray, smp: BoolArray) -> IntArray:
    """0 for TPE, 1.. for the face-connected clusters of SMP by falling volume (equal ones by their first tet), (m,)."""
    cluster = clusters_of(tets, smp)
    names, first = np.unique(cluster[smp], return_index=True)
    sizes = np.bincount(cluster, volumes).astype(np.float64)[names]
    rank = np.zeros(int(cluster.max()) + 1, np.int64)
    rank[names[np.lexsort([first, -sizes])]] = np.arange(1, len(names) + 1)
    return np.where(smp, rank[cluster], 0)


def without_small_clusters(tets: IntArray, volumes: FloatArray, smp: BoolArray, smallest: float) -> BoolArray:
    """Labels (m,) whose clusters of either material below `smallest` (mm^3) went to the material around them.

    A cluster with nothing around it (a piece of the part by itself) stays. Every absorption joins clusters, so it ends.
    """
    result = np.array(smp, dtype=bool)
    pairs = face_table(tets).interior_tets
    part = component_labels(len(tets), pairs)
    changed = True
    while changed:
        changed = False
        for label in (True, False):
            small = _small_clusters(pairs, volumes, result, part, smallest) & (result == label)
            result[small] = not label
            changed = changed or bool(small.any())
    return result


def _small_clusters(
    pairs: IntArray, volumes: FloatArray, labels: BoolArray, part: IntArray, smallest: float
) -> BoolArray:
    cluster = _clusters(pairs, labels)
    surrounded = np.bincount(part)[part] > np.bincount(cluster)[cluster]
    return surrounded & (np.bincount(cluster, volumes)[cluster] < smallest)


def _changes(before: BoolArray, steps: dict[str, BoolArray], volumes: FloatArray) -> dict[str, float]:
    total, rounded, changes = float(volumes.sum()), before, {}
    for name, labels in steps.items():
        changes[name] = float(volumes[labels != before].sum()) / total
        before = labels
    changes["total"] = float(volumes[before != rounded].sum()) / total
    return changes
