"""The rig sheet as a PDF: page 1 is enough at the bench, page 2 has the large views and what to know."""

import io
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from reportlab.lib.colors import Color, black, grey
from reportlab.lib.pagesizes import A4
from reportlab.lib.units import mm
from reportlab.lib.utils import simpleSplit
from reportlab.pdfgen.canvas import Canvas

from fab4d.report.careful import is_measured, point_errors, warnings, worst_deviations
from fab4d.report.drawing import RED, VIEW_MARGIN, draw_view
from fab4d.report.views import FRAMES, Figure, fitted
from fab4d.report.wording import kelvin, number, printable, significant, triple
from fab4d.rig.clamp import Clamp
from fab4d.rig.plan import ForceTrust, RigPlan
from fab4d.rig.schedule import BATH_MARGIN, CONDUCTIVITY, FILM_COEFFICIENTS, ROOM_TEMPERATURE, SPECIFIC_HEAT, Step
from fab4d.units import N_PER_KGF

MARGIN = 12.0
WIDTH, HEIGHT = A4[0] / mm, A4[1] / mm
FULL = WIDTH - 2 * MARGIN
TITLE_WIDTH = 56.0
"""Of a view, mm of paper."""
MOST_REASONS = 3
"""Of a rejection, told on the first page."""
UPRIGHT = (0.0, 0.0, 1.0)
FOOT = 12.0
"""Height kept free at the foot of a page for the boxes to sign, mm."""
LINE = 5.0
"""Of text with what is above it, mm: `Page.need` asks for room before it writes."""
LOWEST_VIEWS, HIGHEST_VIEWS = 58.0, 100.0
"""Of the row on the first page, mm."""
MOST_DEVIATIONS = 4
"""Of those that need care, on the sheet."""


@dataclass
class Page:
    """A page being written from top to bottom; `y` is the next free height above the lower edge, mm."""

    canvas: Canvas
    y: float

    def text(self, x: float, words: str, size: float = 8.0, bold: bool = False, colour: Color = black) -> None:
        """One line at `x` mm, standing on `y`."""
        self.canvas.setFillColor(colour)
        self.canvas.setFont("Helvetica-Bold" if bold else "Helvetica", size)
        self.canvas.drawString(x * mm, self.y * mm, printable(words))

    def need(self, height: float) -> None:
        """Go to a new page when less than `height` mm are left above the boxes at the foot."""
        if self.y - height < MARGIN + FOOT:
            self.canvas.showPage()
            self.y = HEIGHT - MARGIN

    def heading(self, words: str) -> None:
        self.need(18.0)
        self.y -= 6.5
        self.text(MARGIN, words, 10, bold=True)
        self.y -= 1.3
        self.canvas.setStrokeColor(grey)
        self.canvas.setLineWidth(0.5)
        self.canvas.line(MARGIN * mm, self.y * mm, (MARGIN + FULL) * mm, self.y * mm)

    def paragraph(self, words: str, x: float = MARGIN, width: float = FULL, size: float = 8.0) -> None:
        """Wrapped lines below `y`."""
        for line in simpleSplit(printable(words), "Helvetica", size, width * mm):
            self.need(0.46 * size)
            self.y -= 0.46 * size
            self.text(x, line, size)

    def alert(self, words: str, size: float = 9.0) -> None:
        """Wrapped bold red lines below `y`."""
        for line in simpleSplit(printable(words), "Helvetica-Bold", size, FULL * mm):
            self.y -= 0.51 * size
            self.text(MARGIN, line, size, bold=True, colour=RED)


def rig_sheet(
    name: str,
    plan: RigPlan,
    figure: Figure,
    reasons: list[str],
    sensitivity: Mapping[str, Any] | None = None,
    rejected: Sequence[str] = (),
    up: tuple[float, float, float] = UPRIGHT,
) -> bytes:
    """The sheet of part `name`. Equal plans give equal bytes.

    figure : the part to draw       reasons : why the rig cannot do it, empty when it can
    sensitivity : sensitivity_report       rejected : why the design is, empty when it is accepted
    up : direction of the part's frame that pointed up on the printer
    """
    if rejected:
        name = f"{name} (REJECTED)"
    buffer = io.BytesIO()
    canvas = Canvas(buffer, pagesize=A4, invariant=1, pageCompression=1)
    canvas.setTitle(printable(f"Rig sheet: {name}"))
    alerts = [*_rejection(rejected), *(f"NOT POSSIBLE ON THIS RIG: {reason}" for reason in reasons)]
    has_checks = _bench_page(canvas, name, plan, figure, alerts + warnings(sensitivity), sensitivity, up)
    _drawing_page(canvas, name, plan, figure, not has_checks)
    canvas.save()
    return buffer.getvalue()


def _bench_page(
    canvas: Canvas,
    name: str,
    plan: RigPlan,
    figure: Figure,
    alerts: list[str],
    sensitivity: Mapping[str, Any] | None,
    up: tuple[float, float, float],
) -> bool:
    """Returns whether it has room for the caliper checks."""
    page = Page(canvas, HEIGHT - MARGIN - 4)
    _title(page, f"Rig sheet: {name}", _frame_words(up))
    for words in alerts:
        page.alert(words)
    page.y -= 2
    room = page.y - MARGIN - FOOT - LINE - _height(lambda page: _bench_words(page, plan, sensitivity))
    checks = _height(lambda page: _check_table(page, plan))
    has_checks = room - checks >= LOWEST_VIEWS
    _views_in_a_row(page, plan, figure, float(np.clip(room - checks * has_checks, LOWEST_VIEWS, HIGHEST_VIEWS)))
    _bench_words(page, plan, sensitivity)
    if has_checks:
        _check_table(page, plan)
    _sign_boxes(page)
    canvas.showPage()
    return has_checks


def _rejection(reasons: Sequence[str]) -> list[str]:
    if not reasons:
        return []
    more = len(reasons) - MOST_REASONS
    told = [f"REJECTED: {reason}" for reason in reasons[:MOST_REASONS]]
    return [*told, f"and {more} more reasons: see report.html"] if more > 0 else told


def _frame_words(up: tuple[float, float, float]) -> str:
    if up == UPRIGHT:
        return "mm, N; frame of the printed part (that of the STL and 3MF files)"
    return f"mm, N; frame of the permanent shape: ({triple(np.array(up), 3)}) pointed up on the printer"


def _bench_words(page: Page, plan: RigPlan, sensitivity: Mapping[str, Any] | None) -> None:
    """What stands below the views of the first page, but for the caliper checks."""
    _legend(page)
    _point_table(page, plan, sensitivity)
    _careful_table(page, sensitivity)
    _clamp_lines(page, plan)
    _schedule_lines(page, plan)


def _height(write: Callable[[Page], None]) -> float:
    """Height of what `write` writes on a page, mm: it is written on one without end."""
    endless = Page(Canvas(io.BytesIO()), 1e5)
    write(endless)
    return 1e5 - endless.y


def _drawing_page(canvas: Canvas, name: str, plan: RigPlan, figure: Figure, with_checks: bool) -> None:
    page = Page(canvas, HEIGHT - MARGIN - 4)
    _title(page, f"{name}: views and notes", "")
    if with_checks:
        _check_table(page, plan)
    page.y -= 2
    _views_large(page, plan, figure, 140.0 if with_checks else 168.0)
    _legend(page)
    page.heading("How far to trust the numbers")
    for words in _trust(plan):
        page.paragraph(words)
        page.y -= 1
    page.heading("Left out")
    for item in plan.left_out:
        page.paragraph(f"{item['what']}: {item['why']}")
    canvas.showPage()


def _title(page: Page, words: str, remark: str) -> None:
    page.text(MARGIN, words, 15, bold=True)
    page.canvas.setFont("Helvetica", 8)
    page.canvas.drawRightString((MARGIN + FULL) * mm, page.y * mm, remark)
    page.y -= 2


def _views_in_a_row(page: Page, plan: RigPlan, figure: Figure, height: float) -> None:
    projections = [fitted(frame, figure.X, figure.x) for frame in FRAMES]
    tallest = max(p.size[1] for p in projections)
    scale = _row_scale([p.size[0] for p in projections], (height - 2 * VIEW_MARGIN - 4) / tallest)
    widths = _column_widths([p.size[0] for p in projections], scale)
    page.y -= scale * tallest + 2 * VIEW_MARGIN + 4
    left = MARGIN
    for projection, width in zip(projections, widths, strict=True):
        room = (left, page.y, width, scale * tallest + 2 * VIEW_MARGIN + 4)
        draw_view(page.canvas, plan, figure, projection, room, scale)
        left += width


def _column_widths(sizes: list[float], scale: float) -> list[float]:
    """Widths on paper of columns that hold views of `sizes`, both mm, and their titles."""
    return [max(TITLE_WIDTH, size * scale + 2 * VIEW_MARGIN) for size in sizes]


def _row_scale(sizes: list[float], largest: float) -> float:
    """The largest scale up to `largest` at which views of `sizes` mm fit side by side."""
    scales = largest * np.geomspace(1.0, 1e-3, 300)
    fits = [scale for scale in scales if sum(_column_widths(sizes, scale)) <= FULL]
    return float(fits[0] if fits else scales[-1])


def _views_large(page: Page, plan: RigPlan, figure: Figure, height: float) -> None:
    """Two rows: the top view over the front view, the side view beside the front view, at one scale."""
    top, front, side = (fitted(frame, figure.X, figure.x) for frame in FRAMES)
    margins = 2 * VIEW_MARGIN
    columns = [max(top.size[0], front.size[0]), side.size[0]]
    scale = _row_scale(columns, (height - 2 * margins - 8) / (top.size[1] + front.size[1]))
    left, _ = _column_widths(columns, scale)
    low = max(front.size[1], side.size[1]) * scale + margins + 4
    high = top.size[1] * scale + margins + 4
    page.y -= high
    draw_view(page.canvas, plan, figure, top, (MARGIN, page.y, left, high), scale)
    page.y -= low
    draw_view(page.canvas, plan, figure, front, (MARGIN, page.y, left, low), scale)
    draw_view(page.canvas, plan, figure, side, (MARGIN + left, page.y, FULL - left, low), scale)


def _legend(page: Page) -> None:
    page.y -= 4
    words = (
        "Median shape in colour: SMP blue-green, TPE translucent grey, clamp hatched. Permanent shape: pale, dashed "
        "outline. Red arrow: force on the part at the held pad (dashed: behind the part; dot: towards you, cross: "
        "away). Black square: mark. Extents: blue median, grey permanent."
    )
    page.paragraph(words, size=6.5)


def _table(page: Page, columns: list[tuple[str, float, str]], rows: list[list[str]], size: float = 7.5) -> None:
    """Rows below `y`; each column has a title, a width in mm and an alignment "l" or "r"."""
    step = 0.52 * size
    for r, row in enumerate([[title for title, _, _ in columns], *rows]):
        page.need(step)
        page.y -= step
        if r % 2 == 0 and r > 0:
            page.canvas.setFillColor(Color(0.94, 0.94, 0.94))
            page.canvas.rect(MARGIN * mm, (page.y - 1.0) * mm, FULL * mm, step * mm, stroke=0, fill=1)
        page.canvas.setFillColor(black)
        page.canvas.setFont("Helvetica-Bold" if r == 0 else "Helvetica", size - (0.5 if r == 0 else 0))
        x = MARGIN + 1
        for words, (_, width, align) in zip(row, columns, strict=True):
            if align == "r":
                page.canvas.drawRightString((x + width - 2.5) * mm, page.y * mm, printable(words))
            else:
                page.canvas.drawString(x * mm, page.y * mm, printable(words))
            x += width
    page.y -= 1.2


def _point_table(page: Page, plan: RigPlan, sensitivity: Mapping[str, Any] | None) -> None:
    page.heading(
        "Points: move each pad to its hold position and lock it there; the forces are what a gauge should show"
    )
    p = plan.points
    columns = [
        ("No", 8.0, "l"),
        ("On the printed part x y z", 31.5, "l"),
        ("Pad r / area", 22.0, "l"),
        ("HOLD AT x y z", 33.0, "l"),
        ("Direction (unit)", 28.5, "l"),
        ("Azim / elev", 17.0, "l"),
        ("N", 20.0, "r"),
        ("kgf", 12.0, "r"),
        ("1 mm off*", 14.0, "r"),
    ]
    errors = point_errors(sensitivity) if is_measured(sensitivity) else []
    off = ["jumps" if error is None else significant(error) for error in errors] or [""] * p.count
    rows = [
        [
            str(k + 1),
            triple(p.position[k]),
            f"{number(p.pad_radius[k])} / {number(p.pad_area[k], 0)} mm²",
            triple(p.hold[k]),
            triple(p.direction[k], 3),
            f"{number(p.azimuth[k], 0)}° / {number(p.elevation[k], 0)}°",
            _force_words(p.size[k], None if plan.trust.uncertainty is None else plan.trust.uncertainty[k]),
            significant(p.kgf[k]),
            off[k],
        ]
        for k in range(p.count)
    ]
    _table(page, columns, rows)
    page.paragraph(
        "Azimuth from +x to +y, elevation above xy. * RMS error of the finished shape, mm, when this pad alone is 1 mm "
        "off in its worst direction. "
        f"{_true_forces(plan)}, so go by position.",
        size=6.5,
    )


def _force_words(size: float, uncertainty: float | None) -> str:
    return (
        significant(size)
        if uncertainty is None
        else f"{significant(size)} ± {number(uncertainty, _places(uncertainty))}"
    )


def _places(uncertainty: float) -> int:
    return 0 if uncertainty >= 9.5 else 1


def _true_forces(plan: RigPlan) -> str:
    if plan.trust.uncertainty is None:
        return f"True forces: probably {number(100 * plan.trust.least_fraction, 0)} % to 100 % of these"
    return "±: what the mesh leaves uncertain"


def _careful_table(page: Page, sensitivity: Mapping[str, Any] | None) -> None:
    if not is_measured(sensitivity):
        return
    page.heading("What must be done carefully")
    worst = worst_deviations(sensitivity)[:MOST_DEVIATIONS]
    rows = [["nothing: all as designed", significant(sensitivity["rms_mm"])], *([d.what, d.words] for d in worst)]
    _table(page, [("What is off", 100.0, "l"), ("RMS error of the finished shape, mm", 50.0, "r")], rows)


def _clamp_lines(page: Page, plan: RigPlan) -> None:
    page.heading("Clamp and mark")
    clamp = plan.clamp
    words = (
        "No clamp: the pads hold the part and their forces balance each other."
        if clamp is None
        else _clamp_words(clamp)
    )
    page.paragraph(words)
    place = triple(plan.mark_position)
    page.paragraph(
        f"Mark the corner at ({place}) on the printed part before it goes in: the black square in the views."
    )


def _clamp_words(clamp: Clamp) -> str:
    force, moment = float(np.linalg.norm(clamp.force)), float(np.linalg.norm(clamp.moment))
    box = f"({triple(clamp.lower)}) to ({triple(clamp.upper)})"
    size = f"{significant(force)} N = {significant(force / N_PER_KGF)} kgf and {significant(moment / 1e3)} N m"
    return (
        f"Hold all of the part in the box {box}, {number(clamp.area, 0)} mm² of surface. It must bear {size}: "
        f"force on the part ({triple(clamp.force)}) N, "
        f"moment ({triple(clamp.moment / 1e3, 2)}) N m about ({triple(clamp.center)})."
    )


def _schedule_lines(page: Page, plan: RigPlan) -> None:
    page.heading(
        f"Schedule for the thickest wall, {number(plan.wall)} mm, from room temperature, {kelvin(ROOM_TEMPERATURE)}"
    )
    for k, step in enumerate(plan.steps):
        page.y -= 4.1
        page.text(MARGIN + 1, f"{k + 1}  {step.name}", 8, bold=True)
        page.y += 0.46 * 8
        page.paragraph(_step_words(step), MARGIN + 20, FULL - 20)


def _step_words(step: Step) -> str:
    if step.bath_temperature is None or step.core_temperature is None:
        return step.text
    times = ", ".join(f"{number(t.minutes)} min in {t.bath}" for t in step.times)
    return f"Bath at {kelvin(step.bath_temperature)}. {step.text} Core at {kelvin(step.core_temperature)}: {times}."


def _check_table(page: Page, plan: RigPlan) -> None:
    page.heading("Caliper checks: distance between two surface points")
    c = plan.checks
    columns = [("", 7.0, "l"), ("From x y z (printed part)", 41.0, "l"), ("To x y z (printed part)", 41.0, "l")]
    columns += [
        ("Printed", 18.0, "r"),
        ("Loaded", 18.0, "r"),
        ("Unloaded", 18.0, "r"),
        ("Measured: loaded / unloaded", 43.0, "r"),
    ]
    rows = [
        [
            chr(ord("A") + k),
            triple(a),
            triple(b),
            *(number(d[k]) for d in (c.permanent, c.median, c.final)),
            "______ / ______",
        ]
        for k, (a, b) in enumerate(c.positions)
    ]
    _table(page, columns, rows)


def _sign_boxes(page: Page) -> None:
    """Boxes along the lower edge."""
    page.y = MARGIN
    boxes = ("Part and verdict checked", "Mounted, mark right", "Positions locked", "Cooled and unloaded", "Date, name")
    width = FULL / len(boxes)
    for k, words in enumerate(boxes):
        x = MARGIN + k * width
        page.canvas.setStrokeColor(black)
        page.canvas.setLineWidth(0.5)
        page.canvas.rect(x * mm, page.y * mm, (width - 2) * mm, 10 * mm, stroke=1, fill=0)
        page.canvas.setFillColor(black)
        page.canvas.setFont("Helvetica", 6.5)
        page.canvas.drawString((x + 1) * mm, (page.y + 7.4) * mm, words)


def _trust(plan: RigPlan) -> list[str]:
    trust = plan.trust
    kind = "linear (4-node)" if trust.element_order == 1 else "quadratic (10-node)"
    films = ", ".join(f"{film:g} W/(m² K) in {bath}" for bath, film in FILM_COEFFICIENTS)
    return [
        "Positions first: go to the hold positions and let the forces be what they are. "
        f"The forces come from {kind} tets with about {number(trust.elements_across)} across the thinnest walls. "
        + _uncertainty_words(trust),
        "Bath times: one-term solution of heat conduction through a plane wall of the thickest section (Incropera & "
        f"DeWitt, section 5.5.1), conductivity {CONDUCTIVITY:g} W/(m K), specific heat {SPECIFIC_HEAT:g} J/(kg K), "
        f"film {films}. The bath is {BATH_MARGIN:g} K beyond what the core must reach. Check that it is below the "
        "service limit of the TPE.",
        "Moduli are those of the material card; a batch twice as stiff needs twice the force at the same positions.",
    ]


def _uncertainty_words(trust: ForceTrust) -> str:
    thin = ""
    if trust.element_order == 1 and trust.thin_share > 0:
        thin = (
            f" Fewer than two tets span {number(100 * trust.thin_share, 0)} % of the walls, the fewest near "
            f"{triple(trust.thin_place)}: refine the mesh there."
        )
    if trust.uncertainty is None:
        return (
            "A bar in bending so meshed comes out too stiff: the true forces are probably between "
            f"{number(100 * trust.least_fraction, 0)} % and 100 % of those printed.{thin}"
        )
    return f"Their uncertainty is that of the mesh alone, by comparison with {trust.method}.{thin}"
