"""From labels to the files that a slicer reads, each proven to be a solid before it is written."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from typing import Any

import numpy as np

from fab4d.fabrication.bodies import (
    Bodies,
    Body,
    bodies_from_labels,
    genus,
    require_bodies,
    require_solid,
    shells,
)
from fab4d.fabrication.labels import clusters_of, enclosed
from fab4d.fabrication.orientation import printer_axes, standing
from fab4d.fabrication.printability import PrintCheck, PrintLimits, print_checks, tool_changes
from fab4d.io.cards import PrinterCard
from fab4d.io.slicers import filament_length
from fab4d.io.stl import stl_arrays, stl_bytes
from fab4d.io.threemf import Part, components_3mf, prusa_3mf
from fab4d.materials.cards import MaterialCard
from fab4d.mesh.measures import tet_volumes
from fab4d.mesh.tetmesh import BoolArray, FloatArray, IntArray
from fab4d.report.places import Place, places_picture
from fab4d.report.verdict import print_checks_of
from fab4d.rig.schedule import BATH_MARGIN
from fab4d.stages.monitor import Monitor

EXTRUDERS = {"smp": 1, "tpe": 2}
COLOURS = {"smp": "#D9483B", "tpe": "#8FA3B0"}


def run(inputs: Mapping[str, Any], profile: Mapping[str, Any], monitor: Monitor) -> dict[str, Any]:
    """The SMP and TPE bodies as STL files and as two 3MF files, and whether they can be printed.

    Raises BodyError when a body is no solid, before and after its STL file is read back, or when the two do not fit.
    """
    mesh, labels = inputs["mesh"], inputs["labels"]
    monitor.progress("surfaces", tets=len(mesh["tets"]))
    smp, cards = labels["smp"].astype(bool), (profile["printer"], profile["materials"])
    return print_files(mesh["X"], mesh["tets"], smp, profile["name"], *cards, inputs["verdict_report"]["reasons"])


def print_files(
    X: FloatArray,
    tets: IntArray,
    smp: BoolArray,
    name: str,
    printer: PrinterCard,
    materials: MaterialCard,
    rejected: Sequence[str] = (),
) -> dict[str, Any]:
    """What the stage writes for the tets (m, 4) of X (n, 3), mm, with labels smp (m,). Raises BodyError.

    The files hold the part as it stands on the printer, turned about the origin; places in the report are of X.
    rejected : why the design is rejected, which the 3MF files say in their title and description
    """
    axes = printer_axes(printer.up)
    X = standing(X, printer.up)
    bodies = bodies_from_labels(X, tets, smp)
    require_bodies(bodies)
    files = {body.name: _proven_stl(body) for body in bodies.printed}
    # In a 3MF file the last part wins where two overlap.
    parts = [_part(body) for body in reversed(bodies.printed)]
    found = print_checks(X, tets, smp, bodies, _print_limits(printer))
    plain = [_plain(_in_part_frame(check, axes)) for check in found]
    title = f"{name} (REJECTED)" if rejected else name
    says = "; ".join(["REJECTED", *rejected]) if rejected else ""
    bottom = float(bodies.whole.vertices[:, 2].min())
    changes = tool_changes(X, tets, smp, printer.layer_height)
    return {
        "smp_stl": files.get("smp"),
        "tpe_stl": files.get("tpe"),
        "part_3mf": prusa_3mf(title, parts, -bottom, says),
        "part_orca_3mf": components_3mf(title, parts, -bottom, says),
        "print_places": places_picture(X, tets, smp, _places(found, plain)),
        "bodies_report": _report(bodies, _cluster_count(tets, smp), printer, materials)
        | {"checks": [*plain, *(_plain(check) for check in _bath_check(materials))]}
        | {"purge": {"tool_changes": changes, "volume_mm3": changes * printer.purge_per_change}}
        | {"pockets": {"smp": _pockets(X, tets, smp, smp), "tpe": _pockets(X, tets, smp, ~smp)}}
        | {"printer": asdict(printer), "printer_axes": axes.tolist()},
    }


def _places(found: Sequence[PrintCheck], plain: Sequence[Mapping[str, Any]]) -> list[Place]:
    """The places of checks that fail, then of those that hold by little only, in the printer's frame."""
    told = [
        Place(check.where, ("" if not check.ok else "holds barely: ") + reason.reason, not check.ok)
        for check, reason in zip(found, print_checks_of({"checks": plain}), strict=True)
        if check.where is not None and (check.marginal or not check.ok)
    ]
    return sorted(told, key=lambda place: not place.failed)


def _in_part_frame(check: PrintCheck, axes: FloatArray) -> PrintCheck:
    if check.where is None:
        return check
    x, y, z = (np.round(np.array(check.where) @ axes, 3) + 0.0).tolist()
    return replace(check, where=(x, y, z))


def _print_limits(printer: PrinterCard) -> PrintLimits:
    return PrintLimits(
        volume=printer.volume,
        nozzle=printer.nozzle,
        line_width=printer.line_width,
        layer_height=printer.layer_height,
        purge_per_change=printer.purge_per_change,
    )


def _bath_check(materials: MaterialCard) -> list[PrintCheck]:
    """Whether the TPE bears the bath in which the SMP is programmed; nothing where the card does not tell."""
    limit = materials.tpe_service_temperature
    if limit is None:
        return []
    bath = materials.transition_temperature + materials.transition_half_width + BATH_MARGIN
    return [PrintCheck("bath against the service limit of TPE", bath <= limit, bath, "at most", limit, "K")]


def _cluster_count(tets: IntArray, smp: BoolArray) -> int:
    return len(np.unique(clusters_of(tets, smp)[smp]))


def _pockets(X: FloatArray, tets: IntArray, smp: BoolArray, material: BoolArray) -> dict[str, Any]:
    """Clusters of the tets `material` (m,) that are enclosed in the other one."""
    inside = enclosed(tets, smp) & material
    count = len(np.unique(clusters_of(tets, smp)[inside]))
    return {"count": count, "volume_mm3": float(tet_volumes(X, tets)[inside].sum())}


def _plain(check: PrintCheck) -> dict[str, Any]:
    """As JSON holds it: no value stands for one that is not finite."""
    return asdict(check) | {"value": check.value if math.isfinite(check.value) else None}


def _proven_stl(body: Body) -> bytes:
    data = stl_bytes(body.vertices, body.faces, body.name)
    require_solid(Body(body.name, *stl_arrays(data, f"{body.name}.stl")))
    return data


def _part(body: Body) -> Part:
    return Part(body.name.upper(), EXTRUDERS[body.name], COLOURS[body.name], body.vertices, body.faces)


def _report(bodies: Bodies, clusters: int, printer: PrinterCard, materials: MaterialCard) -> dict[str, Any]:
    figures = {body.name: _figures(body, printer, materials) for body in bodies.printed}
    total = sum(figure["volume_mm3"] for figure in figures.values())
    return {
        "bodies": figures,
        "smp_clusters": clusters,
        "volume_mm3": bodies.whole.volume,
        "volume_error": abs(total / bodies.whole.volume - 1.0),
        "interface_triangles": bodies.interface_triangles,
        "tips_drawn_back": bodies.tips_drawn_back,
        "mass_g": sum(figure["mass_g"] for figure in figures.values()),
        "cost_usd": sum(figure["cost_usd"] for figure in figures.values()),
        "left_out": _left_out(bodies),
    }


def _figures(body: Body, printer: PrinterCard, materials: MaterialCard) -> dict[str, Any]:
    density = {"smp": materials.smp_density, "tpe": materials.tpe_density}[body.name]
    price = {"smp": materials.smp_price, "tpe": materials.tpe_price}[body.name]
    flow = {"smp": materials.smp_max_flow, "tpe": materials.tpe_max_flow}[body.name]
    mass = body.volume / 1000.0 * density
    return {
        "extruder": EXTRUDERS[body.name],
        "triangles": len(body.faces),
        "volume_mm3": body.volume,
        "mass_g": mass,
        "cost_usd": mass / 1000.0 * price,
        "max_flow_mm3_per_s": flow,
        "filament_m": filament_length(body.volume, printer) / 1000.0,
        "shells": shells(body),
        "genus": genus(body),
    }


def _left_out(bodies: Bodies) -> list[dict[str, str]]:
    missing = [name for name, body in (("SMP", bodies.smp), ("TPE", bodies.tpe)) if body is None]
    return [{"what": f"{name} body", "why": f"the design has no {name}: one material is printed"} for name in missing]
