"""From labels to the files that a slicer reads, each proven to be a solid before it is written."""

from collections.abc import Mapping
from typing import Any

from fab4d.fabrication.bodies import (
    Bodies,
    Body,
    bodies_from_labels,
    genus,
    require_bodies,
    require_solid,
    shells,
)
from fab4d.io.stl import stl_arrays, stl_bytes
from fab4d.io.threemf import Part, prusa_3mf
from fab4d.materials.cards import MaterialCard
from fab4d.stages.monitor import Monitor

EXTRUDERS = {"smp": 1, "tpe": 2}
COLOURS = {"smp": "#D9483B", "tpe": "#8FA3B0"}


def run(inputs: Mapping[str, Any], profile: Mapping[str, Any], monitor: Monitor) -> dict[str, Any]:
    """The SMP and TPE bodies as STL files and one 3MF file.

    Raises BodyError when a body is no solid, before and after its STL file is read back, or when the two do not fit.
    """
    mesh, labels = inputs["mesh"], inputs["labels"]
    monitor.progress("bodies", tets=len(mesh["tets"]))
    bodies = bodies_from_labels(mesh["X"], mesh["tets"], labels["smp"])
    require_bodies(bodies)
    files = {body.name: _proven_stl(body) for body in bodies.printed}
    # In a 3MF file the last part wins where two overlap.
    parts = [_part(body) for body in reversed(bodies.printed)]
    return {
        "smp_stl": files.get("smp"),
        "tpe_stl": files.get("tpe"),
        "part_3mf": prusa_3mf(profile["name"], parts),
        "bodies_report": _report(bodies, int(labels["cluster"].max()), profile["materials"]),
    }


def _proven_stl(body: Body) -> bytes:
    data = stl_bytes(body.vertices, body.faces, body.name)
    require_solid(Body(body.name, *stl_arrays(data, f"{body.name}.stl")))
    return data


def _part(body: Body) -> Part:
    return Part(body.name.upper(), EXTRUDERS[body.name], COLOURS[body.name], body.vertices, body.faces)


def _report(bodies: Bodies, clusters: int, materials: MaterialCard) -> dict[str, Any]:
    figures = {body.name: _figures(body, materials) for body in bodies.printed}
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


def _figures(body: Body, materials: MaterialCard) -> dict[str, Any]:
    density = {"smp": materials.smp_density, "tpe": materials.tpe_density}[body.name]
    price = {"smp": materials.smp_price, "tpe": materials.tpe_price}[body.name]
    mass = body.volume / 1000.0 * density
    return {
        "extruder": EXTRUDERS[body.name],
        "triangles": len(body.faces),
        "volume_mm3": body.volume,
        "mass_g": mass,
        "cost_usd": mass / 1000.0 * price,
        "shells": shells(body),
        "genus": genus(body),
    }


def _left_out(bodies: Bodies) -> list[dict[str, str]]:
    missing = [name for name, body in (("SMP", bodies.smp), ("TPE", bodies.tpe)) if body is None]
    return [{"what": f"{name} body", "why": f"the design has no {name}: one material is printed"} for name in missing]
