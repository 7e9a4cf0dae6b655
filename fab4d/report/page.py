"""report.html: one file with verdict, figures, turnable view, checks and origin, readable without a network."""

import base64
import json
from collections.abc import Iterable, Mapping, Sequence
from html import escape
from importlib.resources import files
from string import Template
from typing import Any

import numpy as np

from fab4d.mesh.tetmesh import FloatArray, IntArray
from fab4d.mesh.topology import face_table
from fab4d.report.careful import JUMPS, Deviation, deviations, is_measured, warnings
from fab4d.report.metrics import Shapes, final_as_wanted
from fab4d.report.verdict import ACCEPTED, Check
from fab4d.report.wording import plain

ASSETS = files("fab4d.report") / "assets"


def report_page(
    name: str,
    report: Mapping[str, Any],
    checks: Sequence[Check],
    scene: Mapping[str, Any],
    plot: bytes | None,
    places: bytes | None = None,
) -> bytes:
    """The page of part `name`.

    report : report.json      scene : from `view_data`      plot : PNG of error against run time, None without a solver
    places : PNG of where the part may not print well, None where there is nothing to show
    """
    text = Template(_asset("page.html")).substitute(
        title=escape(name),
        css=_asset("page.css"),
        verdict=report["verdict"],
        verdict_class=report["verdict"].lower(),
        reasons=_bullets(report["reasons"]) if report["verdict"] != ACCEPTED else "",
        figures=_figures(report),
        checks=_checks(checks),
        places=_image(places, "places of the checks of printing", ""),
        plot=_image(plot, "error against run time", "<p>Nothing was solved.</p>"),
        forces=_forces(scene["points"]),
        careful=_careful(report["sensitivity"]),
        stages=_stages(report),
        findings=_bullets(f"{found['severity']}: {found['message']}" for found in report["findings"]),
        left_out=_bullets(f"{item['what']}: {item['why']}" for item in report["left_out"]),
        origin=_origin(report),
        # Numbers and base64 only: nothing in it can end the script element.
        data=json.dumps(scene, allow_nan=False),
        three=_asset("three.min.js"),
        viewer=_asset("viewer.js"),
    )
    return text.encode()


def view_data(shapes: Shapes, tets: IntArray, smp: np.ndarray, clamp: np.ndarray, state: Any) -> dict[str, Any]:
    """What the viewer draws: only the vertices of the outer surface and of the SMP body, as base64 arrays.

    tets : (m, 4)       smp : (m,) bool      clamp : (n,) bool       state : the verified state, or None
    """
    bodies = {"outer": shapes.faces, "smp": face_table(tets[smp]).boundary}
    bodies["clamp"] = shapes.faces[clamp[shapes.faces].all(axis=1)]
    used = np.unique(np.concatenate([faces.ravel() for faces in bodies.values()]))
    renumber = np.full(len(shapes.X), -1, np.int64)
    renumber[used] = np.arange(len(used))
    positions = {"permanent": shapes.X, "median": shapes.x, "final": final_as_wanted(shapes), "wanted": shapes.X_temp}
    return (
        {key: _packed(faces, renumber) for key, faces in bodies.items()}
        | {key: _base64(x[used].astype("<f4")) for key, x in positions.items()}
        | {"points": [] if state is None else _points(state, renumber)}
    )


def _points(state: Mapping[str, np.ndarray], renumber: IntArray) -> list[dict[str, Any]]:
    sizes = np.linalg.norm(state["patch_force"], axis=1)
    return [
        {
            "vertex": int(renumber[vertex]),
            "size": float(size),
            "direction": (force / (size or 1.0)).tolist(),
            "hold": held.tolist(),
        }
        for vertex, force, size, held in zip(
            state["patch_center"], state["patch_force"], sizes, state["patch_held"], strict=True
        )
    ]


def _packed(faces: IntArray, renumber: IntArray) -> str:
    return _base64(renumber[faces].astype("<u4"))


def _base64(array: FloatArray | IntArray) -> str:
    return base64.b64encode(np.ascontiguousarray(array).tobytes()).decode()


def _asset(name: str) -> str:
    return (ASSETS / name).read_text(encoding="utf-8")


def _projection(projection: Mapping[str, Any] | None) -> dict[str, str]:
    """The figure of a temporary shape that was projected to the nearest one that the part can take."""
    if projection is None:
        return {}
    return {"nearest shape that the part can take, RMS from the wanted": f"{plain(projection['rms_mm'])} mm"}


def _force_trust(report: Mapping[str, Any]) -> dict[str, str]:
    """The largest force in linear and quadratic elements, and what the mesh leaves uncertain."""
    change, uncertainty = report.get("force_change"), report.get("force_uncertainty")
    shown = {}
    if change:
        largest = f"{plain(max(change['linear_N']))} / {plain(max(change['quadratic_N']))} N"
        shown["largest force in linear / quadratic elements"] = largest
    if uncertainty:
        shown["uncertainty of the forces"] = f"{plain(max(uncertainty['N']))} N"
    return shown


def _figures(report: Mapping[str, Any]) -> str:
    error, residual = report["error"], report["equilibrium_residual"]
    shown = {
        "RMS error": f"{plain(error['rms_mm'])} mm",
        "RMS error, of the diagonal": plain(error["rms_rel"]),
        "largest error": f"{plain(error['max_mm'])} mm",
        "Hausdorff distance": f"{plain(error['hausdorff_mm'])} mm",
        "prescribed displacement, RMS": f"{plain(report['target_displacement_mm'])} mm",
        **_projection(report.get("target_projection")),
        "SMP share of the volume": plain(report["smp_fraction"]),
        "forces": str(report["forces"]),
        **_force_trust(report),
        "fixity": _or_dash(report["fixity"]),
        "undesired deformation": _or_dash(report["undesired_deformation"]),
        "smallest det F": _or_dash(report["min_det_F"]),
        "residual, median / final": f"{_power(residual['median'])} / {_power(residual['final'])}",
        "mass": f"{plain(report['mass_g'])} g",
        "material": f"{plain(report['cost_usd'])} USD",
        **_print_time(report["printing"]),
        "run time": f"{plain(report['wall_s'])} s",
    }
    return "".join(f"<div><span>{escape(k)}</span><strong>{escape(v)}</strong></div>" for k, v in shown.items())


def _print_time(printing: Mapping[str, Any]) -> dict[str, str]:
    """The slicer's, with what it leaves out; nothing where nothing was sliced."""
    seconds = printing["print_time_s"]
    if seconds is None:
        return {}
    return {f"print time, without {' and '.join(printing['print_time_without'])}": f"{plain(seconds / 3600)} h"}


def _or_dash(value: float | None) -> str:
    return "–" if value is None else plain(value)


def _power(value: float | None) -> str:
    """A size so small that only its power of ten matters."""
    return "–" if value is None else f"{value:.0e}"


def _checks(checks: Sequence[Check]) -> str:
    rows = "".join(
        f'<tr class="{_outcome(c)}"><td>{escape(c.name)}</td><td>{escape(c.found)}</td>'
        f'<td>{escape(c.allowed)}</td><td class="outcome">{_outcome(c)}</td></tr>'
        for c in checks
    )
    return f"<table><tr><th>what</th><th>found</th><th>allowed</th><th></th></tr>{rows}</table>"


def _outcome(check: Check) -> str:
    """Also a class of the style sheet."""
    if check.passed:
        return "holds"
    return "warns" if check.warning else "fails"


def _forces(points: Sequence[Mapping[str, Any]]) -> str:
    if not points:
        return "<p>None: there is nothing to program.</p>"
    rows = "".join(
        f'<tr><td>{k}</td><td class="number">{plain(p["size"])}</td><td>{_triple(p["direction"], 3)}</td>'
        f"<td>{_triple(p['hold'], 1)}</td></tr>"
        for k, p in enumerate(points, 1)
    )
    head = '<tr><th>no</th><th class="number">N</th><th>direction</th><th>held at, mm</th></tr>'
    return f"<table>{head}{rows}</table><p>All that the bench needs is in rig/rig-sheet.pdf and rig/forces.csv.</p>"


def _careful(sensitivity: Mapping[str, Any] | None) -> str:
    if not is_measured(sensitivity):
        return f"{_warnings(sensitivity)}<p>How the error moves was not measured: see what is left out.</p>"
    designed = Deviation("nothing: all as designed", sensitivity["rms_mm"])
    rows = "".join(_deviation(d) for kind in [[designed], *deviations(sensitivity)] for d in kind)
    head = '<tr><th>what is off</th><th class="number">RMS error, mm</th><th class="number">by the model</th></tr>'
    note = (
        "RMS error of the finished shape with the equilibria solved anew; the model is of second order in the held "
        "positions about the designed ones. Where it holds for the worst two pads, it stands in for the others and for "
        f"random directions. {JUMPS.capitalize()}: no such shape was found near the designed one."
    )
    return f"{_warnings(sensitivity)}<table>{head}{rows}</table><p>{note}</p>{_softest(sensitivity['softest'])}"


def _softest(softest: Mapping[str, Any] | None) -> str:
    """How near the held part is to buckling."""
    if softest is None:
        return ""
    share, place = f"{100 * softest['stiffness_left']:.0f} %", _triple(softest["at_mm"], 0)
    return (
        f"<p>Held at its points, the hot part gives way most easily near ({place}) mm of the printed part: of its "
        f"stiffness at rest {share} is left there; at 0 % it buckles.</p>"
    )


def _warnings(sensitivity: Mapping[str, Any] | None) -> str:
    return "".join(f'<p class="warning">{escape(words)}</p>' for words in warnings(sensitivity))


def _deviation(d: Deviation) -> str:
    model = "" if d.model is None else plain(d.model)
    return f'<tr><td>{escape(d.what)}</td><td class="number">{d.words}</td><td class="number">{model}</td></tr>'


def _triple(vector: Sequence[float], decimals: int) -> str:
    return ", ".join(f"{v:z.{decimals}f}" for v in vector)


def _stages(report: Mapping[str, Any]) -> str:
    rows = "".join(
        f'<tr><td>{escape(s["name"])}</td><td class="number">{s["wall_s"]:.2f}</td>'
        f'<td class="number">{_whole(s["tau"])}</td><td class="number">{_whole(s["peak_rss_mb"])}</td></tr>'
        for s in report["stages"]
    )
    head = (
        '<tr><th>stage</th><th class="number">s</th><th class="number">factorisations (tau)</th>'
        '<th class="number">memory so far, MB</th></tr>'
    )
    return f"<table>{head}{rows}</table>{_growth(report['growth'])}"


def _growth(growth: Mapping[str, Any]) -> str:
    """What finer meshes would take, by the laws fitted to the samples."""
    expected = "; ".join(
        f"{finer['tets']:,} tets {plain(finer['wall_s'])} s and {_whole(finer['peak_rss_mb'])} MB"
        for finer in growth["finer"]
    )
    power = growth["powers"].get("solve")
    grows = "" if power is None else f", the search as their number to the power {power:g}"
    return f"<p>This mesh has {growth['tets']:,} tets. By the growth measured on the samples{grows}: {expected}.</p>"


def _whole(value: float | None) -> str:
    return "–" if value is None else format(value, ".0f")


def _origin(report: Mapping[str, Any]) -> str:
    rows = [*report["inputs"].items(), *report["versions"].items()]
    cells = "".join(f"<tr><td>{escape(str(k))}</td><td>{escape(str(v))}</td></tr>" for k, v in rows)
    return f"<table>{cells}</table>"


def _bullets(lines: Iterable[str]) -> str:
    items = "".join(f"<li>{escape(line)}</li>" for line in lines)
    return f"<ul>{items}</ul>" if items else "<p>Nothing.</p>"


def _image(png: bytes | None, words: str, without: str) -> str:
    if png is None:
        return without
    return f'<img alt="{words}" src="data:image/png;base64,{base64.b64encode(png).decode()}">'
