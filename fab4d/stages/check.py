"""The mesh doctor: two shapes as a user brings them become one clean pair in mm, or a list of what is wrong."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from typing import Any

import numpy as np

from fab4d.errors import MeshError, SceneError
from fab4d.io.cards import PrinterCard
from fab4d.io.meshes import RawMesh
from fab4d.io.scene import ClampRegion, Goal
from fab4d.materials.cards import MaterialCard
from fab4d.mesh.compatibility import compare_tets, has_repeated_vertex, same_degrees
from fab4d.mesh.distance import prescribed_displacement
from fab4d.mesh.doctor import (
    COINCIDENT,
    Pair,
    check_boundary,
    check_crossings,
    check_mirror,
    check_motion,
    check_tets,
    clamp_deformation,
    clean,
    orient,
    rigid_residuals,
)
from fab4d.mesh.findings import Finding, finding, named
from fab4d.mesh.grid import snapped
from fab4d.mesh.measures import deformation_gradients, face_area_vectors, tet_volumes, vertex_areas
from fab4d.mesh.quality import (
    largest_stretches,
    min_dihedral_angles,
    smallest_surface_stretches,
    vertex_components,
)
from fab4d.mesh.tetmesh import BoolArray, FloatArray, IntArray
from fab4d.mesh.topology import face_table
from fab4d.report.verdict import default_tolerance
from fab4d.stages._advice import clamp_findings, fewest_points, point_findings, suggested_clamp, travel_findings
from fab4d.stages._target import Target, reachable_target
from fab4d.stages.monitor import Monitor
from fab4d.units import MM_PER_UNIT, mm_per

SMALLEST_PART_MM, LARGEST_PART_MM = 1.0, 2000.0
_LARGEST_SIZE_RATIO = 20.0
# Surfaces that are squeezed farther turn unstable in short waves (Biot, Appl. Sci. Res. A 12 (1963) 168). Where that is
# less than this share of them, designs come near all the same.
CREASED_STRETCH, CREASED_SHARE = 0.54, 0.01


Step = Callable[[Pair], tuple[Pair, list[Finding]]]


def run(inputs: Mapping[str, Any], profile: Mapping[str, Any], monitor: Monitor) -> dict[str, Any]:
    """Clean, check and convert the pair of shapes.

    Raises MeshError listing every finding of the first check that failed, SceneError for a clamp that catches nothing.
    """
    permanent, temporary = inputs["permanent"], inputs["temporary"]
    findings = [
        *_material_findings(profile["materials"]),
        *_refuse(_check_files(permanent, temporary)),
        *_refuse(_check_units(permanent, temporary, profile["units"], profile["printer"])),
        *_refuse(_check_compatibility(permanent, temporary)),
    ]
    pair = _pair(permanent, temporary, mm_per(profile["units"]))
    for name, step in _STEPS.items():
        monitor.progress(name)
        pair, found = step(pair)
        findings += _refuse(found)
    clamp = resolve_clamp(profile["clamp"], pair, permanent)
    nothing_to_program, found = check_motion(pair, clamp)
    findings += [*_refuse(found), *_refuse(check_boundary(pair, clamp))]
    target, suggested, fewest = Target(pair, []), None, 0
    tolerance = _tolerance(profile["goal"], pair, clamp)
    if not nothing_to_program:
        monitor.progress("target")
        target = reachable_target(
            pair, clamp, profile["materials"], tolerance, lambda what: monitor.progress(f"target: {what}")
        )
        findings += [*_refuse(target.findings), *_strong_deformation(target.pair, profile["materials"])]
        monitor.progress("outlook")
        suggested = None if clamp.any() else suggested_clamp(target.pair, tolerance, profile["units"])
        fewest, found = _outlook(target, clamp, tolerance, profile)
        findings += [*found, *clamp_findings(target.pair, suggested)]
    monitor.progress("self-intersection")
    findings += _refuse(_self_intersections(target.pair, nothing_to_program))
    report = _report(target, clamp, profile["goal"], findings, nothing_to_program)
    report |= {"fewest_points": fewest, "suggested_clamp": suggested}
    return {"mesh": _arrays(target, clamp), "check_report": report}


_STEPS: Mapping[str, Step] = {
    "clean": clean,
    "orientation": orient,
    "tets": check_tets,
    "mirror image": check_mirror,
}


def _self_intersections(pair: Pair, nothing_to_program: bool) -> list[Finding]:
    printed = check_crossings(
        pair, pair.X, pair.files[0], "error", "such a part cannot be printed; move these places apart"
    )
    if nothing_to_program or printed:
        return printed
    advice = "the part would have to pass through itself, and nothing here keeps it from doing so; move them apart"
    return check_crossings(pair, pair.X_temp, pair.files[1], "warning", advice)


def _outlook(
    target: Target, clamp: BoolArray, tolerance: float, profile: Mapping[str, Any]
) -> tuple[int, list[Finding]]:
    """The fewest points that the limbs need, and what limits the scene."""
    pair, rig = target.pair, profile["rig"]
    wanted = pair.X_temp if target.wanted is None else target.wanted
    fewest, costs = fewest_points(pair, clamp, wanted, tolerance)
    found = [
        *point_findings(pair, fewest, costs, tolerance, profile["goal"], rig),
        *travel_findings(pair, clamp, rig),
    ]
    return fewest, found


def _tolerance(goal: Goal, pair: Pair, clamp: BoolArray) -> float:
    if goal.tolerance is not None:
        return goal.tolerance
    faces = face_table(pair.tets).boundary
    on = np.unique(faces)
    moved = prescribed_displacement(pair.X, pair.X_temp, on, vertex_areas(pair.X, faces)[on], bool(clamp.any()))
    return default_tolerance(pair.diagonal, moved.rms)


def _arrays(target: Target, clamp: BoolArray) -> dict[str, np.ndarray]:
    pair = target.pair
    asked = {} if target.wanted is None else {"X_wanted": snapped(target.wanted)}
    return asked | {
        # On the grid, a scene in metres and the same one in millimetres are the same numbers, and so the same design.
        "X": snapped(pair.X),
        "X_temp": snapped(pair.X_temp),
        "tets": pair.tets,
        "clamp": clamp,
        "vertex_map": pair.vertex_map,
        "tet_map": pair.tet_map,
    }


def _report(
    target: Target, clamp: BoolArray, goal: Goal, findings: list[Finding], nothing_to_program: bool
) -> dict[str, Any]:
    return {
        "findings": [asdict(found) | {"indices": list(found.indices)} for found in findings],
        "nothing_to_program": nothing_to_program,
        "statistics": _statistics(target.pair, clamp),
        "target_projection": target.projection,
        "left_out": _left_out(target, clamp, goal, nothing_to_program),
    }


def _refuse(findings: list[Finding]) -> list[Finding]:
    """The findings, unless some are errors: then MeshError with all of these."""
    errors = [found for found in findings if found.severity == "error"]
    if errors:
        raise MeshError("\n".join(error.message for error in errors))
    return findings


def _material_findings(materials: MaterialCard) -> list[Finding]:
    return [Finding("material", "warning", materials.name, message, 1) for message in materials.warnings()]


# 1. Each file by itself.


def _check_files(permanent: RawMesh, temporary: RawMesh) -> list[Finding]:
    return [*_check_file(permanent), *_check_file(temporary)]


def _check_file(raw: RawMesh) -> list[Finding]:
    if len(raw.tets) == 0:
        return [finding("no-tets", "error", raw.file, "no tets: export the volume mesh")]
    wild = np.flatnonzero(((raw.tets < 0) | (raw.tets >= len(raw.points))).any(axis=1))
    if len(wild):
        message = (
            f"{named('tet', wild)} use vertices outside 0..{len(raw.points) - 1} (tet {wild[0]}: "
            f"{raw.tets[wild[0]].tolist()}): the file is damaged, export it again"
        )
        return [finding("index-out-of-range", "error", raw.file, message, wild)]
    used = _used(raw)
    bad = used[~np.isfinite(raw.points[used]).all(axis=1)]
    if len(bad):
        message = f"{named('vertex', bad)} at {raw.points[bad[0]].tolist()}: not finite; export the file again"
        return [finding("not-finite", "error", raw.file, message, bad)]
    return []


def _used(raw: RawMesh) -> IntArray:
    return np.unique(raw.tets[:, :4])


# 2. Units.


def _sides(points: FloatArray) -> FloatArray:
    sides: FloatArray = points.max(axis=0) - points.min(axis=0)
    return sides


def _check_units(permanent: RawMesh, temporary: RawMesh, units: str, printer: PrinterCard) -> list[Finding]:
    points, temp_points = permanent.points[_used(permanent)], temporary.points[_used(temporary)]
    longest = float(_sides(points).max())
    if not SMALLEST_PART_MM <= longest * mm_per(units) <= LARGEST_PART_MM:
        return [_wrong_units(permanent.file, longest, units, printer)]
    ratio = np.linalg.norm(_sides(temp_points)) / np.linalg.norm(_sides(points))
    if not 1 / _LARGEST_SIZE_RATIO <= ratio <= _LARGEST_SIZE_RATIO:
        message = (
            f"its diagonal is {ratio:.4g} times that of {permanent.file}: do the units differ? "
            f"Both files must be in {units}"
        )
        return [finding("units-differ", "error", temporary.file, message)]
    if not _fits(points * mm_per(units), printer):
        shown = " x ".join(f"{side:.4g}" for side in _sides(points) * mm_per(units))
        volume = " x ".join(f"{side:g}" for side in printer.volume)
        message = (
            f'{shown} mm do not fit into the {volume} mm of the printer "{printer.name}": '
            f'check units = "{units}"{_likely(longest, units, printer)}, scale the part or choose another printer card'
        )
        return [finding("too-large", "error", permanent.file, message)]
    return []


def _wrong_units(file: str, longest: float, units: str, printer: PrinterCard) -> Finding:
    message = (
        f'its longest side is {longest * mm_per(units):.4g} mm with the scene\'s units = "{units}"; parts from '
        f"{SMALLEST_PART_MM:g} mm to {LARGEST_PART_MM:g} mm are possible: correct the units"
        f"{_likely(longest, units, printer)}"
    )
    return finding("units", "error", file, message)


def _likely(longest: float, units: str, printer: PrinterCard) -> str:
    """The units in which a longest side (in the file's numbers) is a common size of a printed part."""
    fitting = [u for u, mm in MM_PER_UNIT.items() if u != units and 10 <= longest * mm <= max(printer.volume)]
    return f" (likely {' or '.join(fitting)})" if fitting else ""


def _fits(points: FloatArray, printer: PrinterCard) -> bool:
    """Whether the part fits into the print volume as it is, or turned to its principal axes."""
    centred = points - points.mean(axis=0)
    turned = centred @ np.linalg.svd(centred, full_matrices=False)[2].T
    return any(bool(np.all(np.sort(_sides(p)) <= np.sort(printer.volume))) for p in (points, turned))


# 3. Compatibility.


def _check_compatibility(permanent: RawMesh, temporary: RawMesh) -> list[Finding]:
    counts = len(permanent.points), len(temporary.points)
    if counts[0] != counts[1]:
        message = (
            f"{counts[1]} vertices, but {permanent.file} has {counts[0]}: both files must hold the same tets of the "
            "same vertices; deform the permanent mesh instead of meshing the temporary shape anew"
        )
        return [finding("vertex-count", "error", temporary.file, message)]
    rows = [np.flatnonzero(~has_repeated_vertex(raw.tets[:, :4])) for raw in (permanent, temporary)]
    tets = [raw.tets[kept, :4] for raw, kept in zip((permanent, temporary), rows, strict=True)]
    difference = compare_tets(*tets)
    if len(difference.only_first) or len(difference.only_second):
        return [_different_tets(permanent, temporary, tets, rows, difference.only_first, difference.only_second)]
    if len(difference.opposite):
        odd = rows[1][difference.opposite]
        message = (
            f"{len(odd)} tets list their vertices in the opposite sense of {permanent.file} ({named('tet', odd)}, an "
            "odd permutation): export both files with the same vertex order in each tet"
        )
        return [finding("odd-permutation", "error", temporary.file, message, odd)]
    return []


def _different_tets(
    permanent: RawMesh,
    temporary: RawMesh,
    tets: list[IntArray],
    rows: list[IntArray],
    only_first: IntArray,
    only_second: IntArray,
) -> Finding:
    if len(tets[0]) == len(tets[1]) and same_degrees(*tets):
        message = (
            f"it seems to be the mesh of {permanent.file} with its vertices renumbered by the exporter "
            "(equal counts, other numbers): export both files with the vertex order kept"
        )
        return finding("renumbered", "error", temporary.file, message, rows[1][only_second])
    file, raw, where = (
        (permanent.file, permanent, rows[0][only_first])
        if len(only_first)
        else (temporary.file, temporary, rows[1][only_second])
    )
    other = temporary.file if len(only_first) else permanent.file
    message = (
        f"{len(tets[0])} and {len(tets[1])} tets, of which {len(only_first)} are only in {permanent.file} and "
        f"{len(only_second)} only in {temporary.file}: tet {where[0]} of {file} with vertices "
        f"{raw.tets[where[0], :4].tolist()} is not in {other}. Both must hold the same tets"
    )
    return finding("different-tets", "error", temporary.file, message, where)


def _pair(permanent: RawMesh, temporary: RawMesh, mm: float) -> Pair:
    # Corners of the permanent file's tets serve both shapes; curved sides are judged when 10-node tets are cleaned.
    n, m = len(permanent.points), len(permanent.tets)
    return Pair(
        permanent.points * mm,
        temporary.points * mm,
        permanent.tets,
        np.arange(n),
        np.arange(m),
        (permanent.file, temporary.file),
    )


# 7. Deformation to the temporary shape.


def _strong_deformation(pair: Pair, materials: MaterialCard) -> list[Finding]:
    stretch = largest_stretches(deformation_gradients(pair.X, pair.X_temp, pair.tets))
    findings = []
    for polymer, limit in (("SMP", materials.smp_max_stretch), ("TPE", materials.tpe_max_stretch)):
        torn = pair.tet_map[stretch > limit]
        if len(torn):
            message = (
                f"{len(torn)} tets are stretched beyond the {limit:g} that {polymer} of the card "
                f'"{materials.name}" bears ({named("tet", torn)}, up to {stretch.max():.3g})'
            )
            findings.append(finding(f"stretch-{polymer.lower()}", "warning", pair.files[1], message, torn))
    return findings + _creased(pair)


def _creased(pair: Pair) -> list[Finding]:
    table = face_table(pair.tets)
    stretch = smallest_surface_stretches(pair.X, pair.X_temp, table.boundary)
    areas = np.linalg.norm(face_area_vectors(pair.X, table.boundary), axis=1)
    creased = stretch < CREASED_STRETCH
    share = float(areas[creased].sum() / areas.sum())
    if share < CREASED_SHARE:
        return []
    tets = pair.tet_map[np.unique(table.boundary_tets[creased])]
    message = (
        f"{share:.1%} of the surface is squeezed to less than {CREASED_STRETCH:g} of its length "
        f"({named('tet', tets)}, down to {stretch.min():.2g}): a solid creases there, which few designs can hold, and "
        "finding that out takes long; bend the part over a longer piece or less"
    )
    return [finding("creased-surface", "warning", pair.files[1], message, tets)]


# The clamp.


def resolve_clamp(regions: Sequence[ClampRegion], pair: Pair, permanent: RawMesh) -> BoolArray:
    """Vertices (n,) of `pair` inside any of the regions; none without regions.

    Raises SceneError for a region that catches no vertex or names what the mesh does not have, and for a clamp that
    holds every vertex.
    """
    clamp = np.zeros(len(pair.X), bool)
    for number, region in enumerate(regions, 1):
        caught = _caught(region, f"[[rig.clamp]] {number}", pair, permanent)
        if not caught.any():
            msg = f"[[rig.clamp]] {number} catches no vertex of {permanent.file}{_where_it_is(region, pair)}"
            raise SceneError(msg)
        clamp |= caught
    if clamp.all():
        msg = f"the clamp holds all {len(clamp)} vertices of {permanent.file}: nothing could move; make it smaller"
        raise SceneError(msg)
    return clamp


def _caught(region: ClampRegion, where: str, pair: Pair, permanent: RawMesh) -> BoolArray:
    if region.box is not None:
        # A face of the box through vertices must catch them whatever the unit was.
        slack = COINCIDENT * pair.diagonal
        low, high = np.array(region.box)
        inside: BoolArray = np.all((low - slack <= pair.X) & (high + slack >= pair.X), axis=1)
        return inside
    if region.vertices is not None:
        wild = [v for v in region.vertices if v >= len(permanent.points)]
        if wild:
            last = len(permanent.points) - 1
            msg = f"{where}: vertex {wild[0]} is not in {permanent.file}, whose vertices are 0..{last}"
            raise SceneError(msg)
        return np.isin(pair.vertex_map, region.vertices)
    if region.set_name not in permanent.sets:
        known = ", ".join(sorted(permanent.sets)) or "none"
        msg = f'{where}: {permanent.file} has no vertex set "{region.set_name}"; it has: {known}'
        raise SceneError(msg)
    return np.isin(pair.vertex_map, permanent.sets[str(region.set_name)])


def _where_it_is(region: ClampRegion, pair: Pair) -> str:
    if region.box is None:
        return ": its vertices belong to no tet"
    low, high = pair.X.min(axis=0), pair.X.max(axis=0)
    return f": its box is {_box(*region.box)}, the part's {_box(low, high)} (mm)"


def _box(low: Sequence[float] | FloatArray, high: Sequence[float] | FloatArray) -> str:
    return " x ".join(f"[{a:.4g}, {b:.4g}]" for a, b in zip(low, high, strict=True))


# What is told.


def _statistics(pair: Pair, clamp: BoolArray) -> dict[str, float | int]:
    F = deformation_gradients(pair.X, pair.X_temp, pair.tets)
    stretch = largest_stretches(F)
    residuals = rigid_residuals(pair.X, pair.X_temp)
    boundary = np.unique(face_table(pair.tets).boundary)
    return {
        "vertices": len(pair.X),
        "tets": len(pair.tets),
        "interior_vertices": len(pair.X) - len(boundary),
        "clamp_vertices": int(clamp.sum()),
        "components": int(vertex_components(len(pair.X), pair.tets).max()) + 1,
        "diagonal_mm": pair.diagonal,
        "volume_mm3": float(tet_volumes(pair.X, pair.tets).sum()),
        "min_dihedral_deg": float(min_dihedral_angles(pair.X, pair.tets).min()),
        "min_det_F": float(np.linalg.det(F).min()),
        "max_stretch": float(stretch.max()),
        "p99_stretch": float(np.percentile(stretch, 99)),
        "target_rms_mm": float(np.sqrt(np.mean(residuals**2))),
        "target_max_mm": float(residuals.max()),
        "clamp_deformation_mm": clamp_deformation(pair, clamp),
    }


def _left_out(target: Target, clamp: BoolArray, goal: Goal, nothing_to_program: bool) -> list[dict[str, str]]:
    left_out = [
        {"what": "gravity", "why": "the scene has none"},
    ]
    if not clamp.any():
        left_out.append({"what": "clamp", "why": "the scene has none: the forces balance each other"})
    if target.projection is None and not nothing_to_program:
        left_out.append({"what": "projection of the temporary shape", "why": "an elastic part can take it as it is"})
    if goal.smp == "enough" and not nothing_to_program:
        why = 'the scene does not ask for it ([goal] smp = "least" does)'
        left_out.append({"what": "search for the least SMP", "why": why})
    if nothing_to_program:
        why = "the temporary shape is the permanent one, moved rigidly"
        left_out.append({"what": "design, forces and rig sheet", "why": why})
    return left_out
