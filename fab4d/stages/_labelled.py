"""Bodies of a labelled tet mesh that was made elsewhere: the mesh doctor, the label repair, the print files."""

from dataclasses import asdict
from typing import Any

import numpy as np

from fab4d.errors import BodyError, MeshError
from fab4d.fabrication.labels import LabelResult, printable_labels
from fab4d.fabrication.orientation import standing
from fab4d.io.cards import PrinterCard
from fab4d.io.meshes import RawMesh
from fab4d.materials.cards import MaterialCard
from fab4d.mesh.doctor import Pair, check_tets, clean, orient
from fab4d.mesh.findings import Finding
from fab4d.mesh.tetmesh import BoolArray
from fab4d.stages.bodies import print_files
from fab4d.stages.threshold import lines_of

OUTSIZE = 10.0
"""Longest side over that of the printer's volume from which the unit must be wrong."""


def labelled_bodies(
    raw: RawMesh, smp: BoolArray, mm: float, name: str, printer: PrinterCard, materials: MaterialCard
) -> dict[str, Any]:
    """What stage `bodies` writes, for the tets of `raw` with labels smp (m,), made printable first.

    mm : length of the file's unit

    The report tells what the mesh doctor found and how much volume each step of the repair changed.
    Raises MeshError for an unusable mesh, BodyError for bodies that are no solids.
    """
    _require_usable(raw, mm, printer)
    pair, findings = _cleaned(raw, mm)
    try:
        result = printable_labels(standing(pair.X, printer.up), pair.tets, smp[pair.tet_map], lines_of(printer))
        files = print_files(pair.X, pair.tets, result.smp, name, printer, materials)
    except BodyError as error:
        msg = f"{raw.file}: {error}"
        raise BodyError(msg) from error
    files["bodies_report"] |= {
        "labels": _label_figures(result),
        "findings": [asdict(found) | {"indices": list(found.indices)} for found in findings],
    }
    return files


def _require_usable(raw: RawMesh, mm: float, printer: PrinterCard) -> None:
    """Raise MeshError for coordinates that are no numbers, or of a size that tells of another unit."""
    used = np.unique(raw.tets)
    wrong = used[~np.isfinite(raw.points[used]).all(axis=1)]
    if len(wrong):
        msg = f"{raw.file}: vertex {wrong[0]} is at {raw.points[wrong[0]].tolist()}: export the mesh again"
        raise MeshError(msg)
    sides = mm * np.ptp(raw.points[used], axis=0)
    small, large = sides.max() < printer.line_width, sides.max() > OUTSIZE * max(printer.volume)
    if small or large:
        found = " x ".join(f"{side:.3g}" for side in sides)
        than = f"narrower than a line of {printer.line_width:g} mm" if small else "far beyond the printer's volume"
        msg = f"{raw.file}: the part would be {found} mm, {than}: give the unit of the mesh with --units"
        raise MeshError(msg)


def _cleaned(raw: RawMesh, mm: float) -> tuple[Pair, list[Finding]]:
    n, m = len(raw.points), len(raw.tets)
    points = raw.points * mm
    pair = Pair(points, points, raw.tets, np.arange(n), np.arange(m), (raw.file, raw.file))
    findings: list[Finding] = []
    for step in (clean, orient, check_tets):
        pair, found = step(pair)
        findings += found
        errors = [item.message for item in found if item.severity == "error"]
        if errors:
            raise MeshError("\n".join(errors))
    return pair, findings


def _label_figures(result: LabelResult) -> dict[str, Any]:
    return {
        "changed_fraction": result.changed_fraction,
        "feature_mm": list(result.feature),
        "defects_left": result.defects_left.tolist(),
        "part_defects": result.part_defects.tolist(),
    }
