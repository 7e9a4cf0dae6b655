"""Where a part may not print well: three views of it as it stands on the printer, with the places of checks."""

import io
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure as Sheet

from fab4d.mesh.tetmesh import BoolArray, FloatArray, IntArray
from fab4d.mesh.topology import face_table
from fab4d.report.labels import place_labels
from fab4d.report.views import FRAMES, Figure, Projection, fitted, picture

PIXELS = 420.0
"""Of the longest side of the part in a view."""
LABEL = 0.045
"""Radius of a number over the longest side of the part."""
WIDTH, HIGHEST, COLUMN, TITLE, LINE = 13.0, 6.0, 2.9, 0.35, 0.22
"""Inches: the sheet, the highest view, the narrowest column, room for a title and for a line of words."""
FAILED, MARGINAL = "#c81e1a", "#b36b00"


@dataclass(frozen=True)
class Place:
    """One place (mm, frame of the printer), what is said about it, and whether a check fails there."""

    where: tuple[float, float, float]
    words: str
    failed: bool


def places_picture(X: FloatArray, tets: IntArray, smp: BoolArray, places: Sequence[Place]) -> bytes | None:
    """PNG of the labelled tets (m, 4) of X (n, 3), mm, built along z, with numbered places; None without places."""
    if not places:
        return None
    outer, inner = face_table(tets).boundary, face_table(tets[smp]).boundary
    figure = Figure(X, X, outer, inner, np.zeros((0, 3), np.int64))
    views = [fitted(frame, X) for frame in FRAMES]
    longest = float(max(view.size.max() for view in views))
    margin = 3 * LABEL * longest
    tall = float(max(view.size[1] for view in views)) + 2 * margin
    scale = _scale([float(view.size[0]) + 2 * margin for view in views], tall)
    height = tall * scale + TITLE + LINE * (len(places) + 1)
    sheet, left = Sheet(figsize=(WIDTH, height)), 0.0
    for view in views:
        width = max((float(view.size[0]) + 2 * margin) * scale, COLUMN)
        box = (left / WIDTH, LINE * (len(places) + 1) / height, width / WIDTH, tall * scale / height)
        axis = sheet.add_axes(box)
        _draw_view(axis, figure, view, longest)
        _draw_places(axis, view, places, longest)
        left += width
    for k, place in enumerate(places):
        y = LINE * (len(places) - k) / height
        sheet.text(0.01, y, f"{k + 1}  {place.words}", color=_colour(place), fontsize=10, va="center")
    buffer = io.BytesIO()
    sheet.savefig(buffer, format="png", dpi=100, metadata={"Software": None})
    return buffer.getvalue()


def _scale(widths: Sequence[float], tall: float) -> float:
    """Inches a mm of the part at which views of `widths` and the height `tall`, mm, fit on the sheet."""
    scales = HIGHEST / tall * np.geomspace(1.0, 1e-2, 200)
    fits = [scale for scale in scales if sum(max(width * scale, COLUMN) for width in widths) <= WIDTH]
    return float(fits[0] if fits else scales[-1])


def _draw_view(axis: Axes, figure: Figure, view: Projection, longest: float) -> None:
    width, height = view.size
    axis.imshow(picture(figure, view, PIXELS / longest), extent=(0, width, 0, height))
    margin = 3 * LABEL * longest
    axis.set(xlim=(-margin, width + margin), ylim=(-margin, height + margin), aspect="equal")
    axis.set_title(f"{view.frame.name} of the printer", fontsize=9.5)
    axis.set_axis_off()
    if view.frame.up == "z":
        axis.axhline(0.0, color="0.5", linewidth=1.2, zorder=0)
        axis.text(-margin, 0.0, "bed", fontsize=8, color="0.4", va="bottom")


def _draw_places(axis: Axes, view: Projection, places: Sequence[Place], longest: float) -> None:
    radius, margin = LABEL * longest, 3 * LABEL * longest
    spots = view(np.array([place.where for place in places]))[:, :2]
    away = spots - 0.5 * view.size
    window = (float(view.size[0] + 2 * margin), float(view.size[1] + 2 * margin))
    labels = place_labels(spots + margin, away, np.stack([spots, spots], axis=1) + margin, radius, window) - margin
    for k, (place, spot, label) in enumerate(zip(places, spots, labels, strict=True)):
        colour = _colour(place)
        axis.plot(*zip(spot, label, strict=True), color=colour, linewidth=0.8)
        axis.plot(spot[0], spot[1], marker="o", markersize=5, color=colour, markeredgecolor="white")
        disc = {"boxstyle": "circle,pad=0.25", "facecolor": "white", "edgecolor": colour}
        axis.text(label[0], label[1], str(k + 1), fontsize=8, ha="center", va="center", color=colour, bbox=disc)


def _colour(place: Place) -> str:
    return FAILED if place.failed else MARGINAL
