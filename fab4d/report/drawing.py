"""One dimensioned view on paper: picture, extents, mark, numbered arrows."""

from dataclasses import dataclass

import numpy as np
from PIL import Image
from reportlab.lib.colors import Color, black, grey, white
from reportlab.lib.units import mm
from reportlab.lib.utils import ImageReader
from reportlab.pdfbase.pdfmetrics import stringWidth
from reportlab.pdfgen.canvas import Canvas

from fab4d.mesh.measures import unit_vectors
from fab4d.mesh.tetmesh import FloatArray
from fab4d.report.labels import place_labels
from fab4d.report.views import CLAMP_COLOUR, Figure, Projection, hidden_points, picture
from fab4d.report.wording import number, scale_words
from fab4d.rig.plan import RigPlan

DPI = 200.0
LABEL_RADIUS = 2.3
LONGEST_ARROW, SHORTEST_ARROW = 12.0, 4.0
VIEW_MARGIN = 11.0
"""Room around a view for arrows, numbers and dimensions, mm of paper."""
DIMENSION_GAP = 4.5
NUMBER, NUMBER_FONT = 2.4, 6.5
"""Height of a dimension's number, mm of paper, and its font size."""
RED, BLUE, CLAMP = Color(0.78, 0.12, 0.10), Color(0.10, 0.25, 0.65), Color(*(CLAMP_COLOUR / 255))


@dataclass(frozen=True)
class Dimension:
    """A level or upright dimension line from a to b, mm of paper, with its number."""

    a: tuple[float, float]
    b: tuple[float, float]
    words: str
    colour: Color

    @property
    def level(self) -> bool:
        return self.a[1] == self.b[1]

    @property
    def width(self) -> float:
        """Of the number, mm of paper."""
        return float(stringWidth(self.words, "Helvetica", NUMBER_FONT) / mm + 1)


def draw_view(
    canvas: Canvas,
    plan: RigPlan,
    figure: Figure,
    projection: Projection,
    box: tuple[float, float, float, float],
    scale: float,
) -> None:
    """One view in `box` (left, bottom, width, height; mm of paper) at `scale` mm of paper a mm of the part."""
    left, bottom, width, height = box
    size = projection.size * scale
    x0, y0 = left + (width - size[0]) / 2, bottom + (height - 4 - size[1]) / 2
    image = picture(figure, projection, scale * DPI / 25.4)
    canvas.drawImage(ImageReader(Image.fromarray(image)), x0 * mm, y0 * mm, size[0] * mm, size[1] * mm)
    canvas.saveState()
    canvas.translate((left) * mm, bottom * mm)
    shift = np.array([x0 - left, y0 - bottom])
    dimensions = _dimensions(figure, projection, scale, shift)
    for dimension in dimensions:
        _dimension_line(canvas, dimension)
    _clamp_box(canvas, plan, projection, scale, shift)
    _mark(canvas, plan, projection, scale, shift)
    occupied = np.concatenate([_occupied(dimension) for dimension in dimensions])
    _arrows(canvas, plan, figure, projection, scale, shift, occupied, (width, height - 5))
    for dimension in dimensions:  # last: no arrow may cover a number
        _dimension_number(canvas, dimension)
    canvas.restoreState()
    _view_title(canvas, projection, left, bottom + height - 3.5, scale)


def _view_title(canvas: Canvas, projection: Projection, x: float, y: float, scale: float) -> None:
    frame = projection.frame
    canvas.setFillColor(black)
    canvas.setFont("Helvetica-Bold", 7.5)
    canvas.drawString(x * mm, y * mm, f"{frame.name}: {frame.right} right, {frame.up} up, {scale_words(scale)}")


def _dimensions(figure: Figure, projection: Projection, scale: float, shift: FloatArray) -> list[Dimension]:
    """Extents of the median shape below and left, of the permanent shape above and right."""
    dimensions = []
    for shape, colour, side in ((figure.x, BLUE, -1), (figure.X, grey, 1)):
        flat = projection(shape)[:, :2] * scale + shift
        low, high = flat.min(axis=0), flat.max(axis=0)
        across, up = (high - low) / scale
        edge = projection.size * scale + shift if side > 0 else shift
        level, upright = edge[1] + side * DIMENSION_GAP, edge[0] + side * DIMENSION_GAP
        dimensions.append(Dimension((low[0], level), (high[0], level), number(across), colour))
        dimensions.append(Dimension((upright, low[1]), (upright, high[1]), number(up), colour))
    return dimensions


def _occupied(dimension: Dimension) -> FloatArray:
    """Segments (3, 2, 2) to keep numbered circles off: the line, and the long sides of its number."""
    a, b = np.array(dimension.a), np.array(dimension.b)
    axes = np.eye(2) if dimension.level else np.eye(2)[::-1]
    center, along, across = (a + b) / 2, axes[0] * dimension.width / 2, axes[1] * NUMBER / 2
    return np.array([[a, b], *([center - along + s * across, center + along + s * across] for s in (-1, 1))])


def _dimension_line(canvas: Canvas, dimension: Dimension) -> None:
    """A line with ticks at both ends."""
    a, b = dimension.a, dimension.b
    canvas.setStrokeColor(dimension.colour)
    canvas.setLineWidth(0.4)
    canvas.line(a[0] * mm, a[1] * mm, b[0] * mm, b[1] * mm)
    dx, dy = (0, 1) if dimension.level else (1, 0)
    for x, y in (a, b):
        canvas.line((x - dx) * mm, (y - dy) * mm, (x + dx) * mm, (y + dy) * mm)


def _dimension_number(canvas: Canvas, dimension: Dimension) -> None:
    """The number in a gap in the middle of its line."""
    a, b = dimension.a, dimension.b
    canvas.saveState()
    canvas.translate((a[0] + b[0]) / 2 * mm, (a[1] + b[1]) / 2 * mm)
    canvas.rotate(0 if dimension.level else 90)
    canvas.setFillColor(white)
    canvas.rect(-dimension.width / 2 * mm, -NUMBER / 2 * mm, dimension.width * mm, NUMBER * mm, stroke=0, fill=1)
    canvas.setFillColor(dimension.colour)
    canvas.setFont("Helvetica", NUMBER_FONT)
    canvas.drawCentredString(0, -0.8 * mm, dimension.words)
    canvas.restoreState()


def _clamp_box(canvas: Canvas, plan: RigPlan, projection: Projection, scale: float, shift: FloatArray) -> None:
    """Outline of the clamp's box, thick enough to be seen edge-on."""
    if plan.clamp is None:
        return
    flat = projection(np.array([plan.clamp.lower, plan.clamp.upper]))[:, :2] * scale + shift
    low, high = flat.min(axis=0), flat.max(axis=0)
    canvas.setStrokeColor(CLAMP)
    canvas.setLineWidth(1.4)
    canvas.rect(low[0] * mm, low[1] * mm, (high[0] - low[0]) * mm, (high[1] - low[1]) * mm, stroke=1, fill=0)


def _mark(canvas: Canvas, plan: RigPlan, projection: Projection, scale: float, shift: FloatArray) -> None:
    x, y = projection(plan.mark_position[None])[0, :2] * scale + shift
    canvas.setFillColor(black)
    canvas.rect((x - 1.1) * mm, (y - 1.1) * mm, 2.2 * mm, 2.2 * mm, stroke=0, fill=1)


def _arrows(
    canvas: Canvas,
    plan: RigPlan,
    figure: Figure,
    projection: Projection,
    scale: float,
    shift: FloatArray,
    lines: FloatArray,
    size: tuple[float, float],
) -> None:
    """Arrows and numbers of all points, in a window of `size` mm of paper; the numbers keep off `lines` (l, 2, 2)."""
    points = plan.points
    start = projection(points.hold)[:, :2] * scale + shift
    hidden = hidden_points(figure, projection, points.hold)
    direction = points.direction @ projection.frame.axes.T
    tips = start + arrow_lengths(points.size)[:, None] * direction[:, :2]
    segments = np.stack([start, tips], axis=1)
    away = unit_vectors(np.column_stack([direction[:, :2], np.zeros(points.count)]))[:, :2]
    centers = place_labels(tips, away, np.concatenate([segments, lines]), LABEL_RADIUS, size)
    for k in range(points.count):
        _arrow(canvas, start[k], tips[k], bool(hidden[k]))
        if np.linalg.norm(direction[k, :2]) < 0.25:
            _end_on(canvas, start[k], direction[k, 2] > 0)
        _label(canvas, centers[k], tips[k], str(k + 1))


def arrow_lengths(sizes: FloatArray) -> FloatArray:
    """Lengths (K,) of arrows on paper, mm, growing with the force between the shortest and the longest."""
    largest = float(sizes.max(initial=0.0)) or 1.0
    return SHORTEST_ARROW + (LONGEST_ARROW - SHORTEST_ARROW) * sizes / largest


def _arrow(canvas: Canvas, a: FloatArray, b: FloatArray, hidden: bool) -> None:
    canvas.setStrokeColor(RED)
    canvas.setFillColor(RED)
    canvas.setLineWidth(1.2)
    canvas.setDash([2, 1.5] if hidden else [], 0)
    canvas.line(a[0] * mm, a[1] * mm, b[0] * mm, b[1] * mm)
    canvas.setDash()
    canvas.circle(a[0] * mm, a[1] * mm, 0.7 * mm, stroke=1, fill=0 if hidden else 1)
    length = float(np.linalg.norm(b - a))
    if length < 1.5:
        return
    along = (b - a) / length
    side = np.array([-along[1], along[0]])
    head = canvas.beginPath()
    corners = (b, b - 2.2 * along + 0.9 * side, b - 2.2 * along - 0.9 * side)
    head.moveTo(*(corners[0] * mm))
    for corner in corners[1:]:
        head.lineTo(*(corner * mm))
    head.close()
    canvas.drawPath(head, stroke=0, fill=1)


def _end_on(canvas: Canvas, center: FloatArray, towards: bool) -> None:
    """An arrow seen from its tip (dot) or from behind (cross)."""
    x, y = center
    canvas.setStrokeColor(RED)
    canvas.setFillColor(white)
    canvas.setLineWidth(0.8)
    canvas.circle(x * mm, y * mm, 1.5 * mm, stroke=1, fill=1)
    if towards:
        canvas.setFillColor(RED)
        canvas.circle(x * mm, y * mm, 0.5 * mm, stroke=0, fill=1)
        return
    for s in (-1, 1):
        canvas.line((x - 1) * mm, (y - s) * mm, (x + 1) * mm, (y + s) * mm)


def _label(canvas: Canvas, center: FloatArray, tip: FloatArray, words: str) -> None:
    """A number in a circle, with a leader when it is not at its arrow's tip."""
    gap = float(np.linalg.norm(center - tip))
    if gap > 1.6 * LABEL_RADIUS:
        canvas.setStrokeColor(grey)
        canvas.setLineWidth(0.4)
        end = center + (tip - center) * (LABEL_RADIUS / gap)
        canvas.line(tip[0] * mm, tip[1] * mm, end[0] * mm, end[1] * mm)
    canvas.setFillColor(white)
    canvas.setStrokeColor(RED)
    canvas.setLineWidth(0.6)
    canvas.circle(center[0] * mm, center[1] * mm, (LABEL_RADIUS - 0.3) * mm, stroke=1, fill=1)
    canvas.setFillColor(black)
    canvas.setFont("Helvetica-Bold", 7)
    canvas.drawCentredString(center[0] * mm, (center[1] - 0.85) * mm, words)
