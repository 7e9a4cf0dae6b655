"""The drawing under the rig sheet: depth, labels, words; and the sheet as a file."""

import csv
import io
import re
import zlib
from base64 import a85decode
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from reportlab.pdfgen.canvas import Canvas

from fab4d.io.cards import load_printer
from fab4d.mesh.topology import face_table
from fab4d.report import drawing, sheet
from fab4d.report.labels import place_labels
from fab4d.report.views import FRAMES, Figure, fitted, hidden_points, picture
from fab4d.report.wording import number, printable, scale_words, significant
from fab4d.report.zbuffer import render
from fab4d.stages.monitor import SilentMonitor
from fab4d.stages.rig import run


@pytest.fixture
def rig_run(bar, profile):
    def go(state, name="bent-bar", sensitivity=None, rejected=(), up=(0.0, 0.0, 1.0), uncertainty=None):
        inputs = {"mesh": bar.mesh_artifact(), "labels": bar.labels_artifact(), "state": state}
        inputs["verify_report"] = {"force_uncertainty": uncertainty}
        inputs["sensitivity_report"] = sensitivity or {"left_out": [], "reasons": []}
        inputs["verdict_report"] = {"reasons": list(rejected)}
        printer = replace(load_printer("generic-dual-0.4", Path()), up=up)
        return run(inputs, profile | {"name": name, "printer": printer}, SilentMonitor())

    return go


def pdf_text(pdf: bytes) -> str:
    """All strings of the page streams, as reportlab writes them: ASCII85 over zlib."""
    objects = [o for o in re.findall(rb"\d+ 0 obj(.*?)endobj", pdf, re.DOTALL) if b"/Image" not in o]
    streams = [found[1] for o in objects if (found := re.search(rb"stream\r?\n(.*?)~>\s*endstream", o, re.DOTALL))]
    drawn = [zlib.decompress(a85decode(stream)) for stream in streams]
    return "\n".join(s.decode("cp1252") for page in drawn for s in re.findall(rb"\((.*?)\) Tj", page))


def test_the_nearest_face_is_seen():
    points = np.array([[0, 0, 1], [10, 0, 1], [0, 10, 1], [0, 0, 2], [4, 0, 2], [0, 4, 2.0]])
    seen = render(points, np.array([[0, 1, 2], [3, 4, 5]]), 10, 10)
    assert seen.face[0, 0] == 1
    assert seen.face[4, 4] == 0
    assert seen.face[9, 9] == -1
    assert seen.depth[0, 0] == pytest.approx(2)


def test_pixels_of_a_triangle_add_up_to_its_area():
    points = np.array([[3.0, 5, 0], [180, 20, 0], [60, 190, 0]])
    area = 0.5 * abs(np.cross(points[1] - points[0], points[2] - points[0])[2])
    assert (render(points, np.array([[0, 1, 2]]), 200, 200).face >= 0).sum() == pytest.approx(area, rel=0.01)


def test_frames_are_right_handed():
    for frame in FRAMES:
        np.testing.assert_allclose(np.cross(frame.axes[0], frame.axes[1]), frame.axes[2])


def test_points_behind_the_part_are_hidden(bar):
    X, tets = bar.box()
    faces = face_table(tets).boundary
    figure = Figure(X, X, faces, faces[:0], faces[:0])
    front = fitted(FRAMES[1], X)
    sides = np.array([[3.75, 0.0, 15.0], [3.75, 7.5, 15.0]])
    assert hidden_points(figure, front, sides).tolist() == [False, True]


def test_picture_shows_smp_clamp_and_ghost(bar):
    X, tets = bar.box()
    faces = face_table(tets).boundary
    smp = face_table(tets[bar.labels_artifact()["smp"]]).boundary
    foot = faces[(X[faces][:, :, 2] == 0).all(axis=1)]
    x = bar.bent(X, bar.MEDIAN)
    with_smp = picture(Figure(X, x, faces, smp, foot), fitted(FRAMES[0], X, x), 8.0)
    without = picture(Figure(X, x, faces, smp[:0], foot[:0]), fitted(FRAMES[0], X, x), 8.0)
    red = with_smp.astype(int)[..., 0] - with_smp[..., 2]
    assert (with_smp != without).any(axis=2).mean() > 0.2
    assert (red > 60).any()


@settings(max_examples=40, deadline=None)
@given(st.integers(1, 16), st.integers(0, 2**31))
def test_labels_do_not_overlap(count, seed):
    rng = np.random.default_rng(seed)
    anchors = rng.uniform(15, 55, (count, 2))
    away = rng.normal(size=(count, 2))
    centers = place_labels(anchors, away, np.zeros((0, 2, 2)), 2.3, (70.0, 70.0))
    gaps = np.linalg.norm(centers[:, None] - centers, axis=2) + 1e9 * np.eye(count)
    assert gaps.min() >= 4.6 - 1e-9
    assert centers.min() >= 2.3
    assert centers.max() <= 70 - 2.3


def test_labels_keep_off_lines():
    lines = np.array([[[0.0, 20.0], [40.0, 20.0]]])
    center = place_labels(np.array([[20.0, 20.0]]), np.array([[1.0, 0]]), lines, 2.0, (40.0, 40.0))[0]
    assert abs(center[1] - 20) >= 2.0 - 1e-9


@given(st.floats(-1e6, 1e6), st.integers(0, 3))
def test_numbers_are_never_negative_zero(value, decimals):
    words = number(value, decimals)
    assert not re.fullmatch(r"-0\.?0*", words)
    assert float(words) == pytest.approx(value, abs=0.5 * 10**-decimals + 1e-9)


def test_words():
    assert [significant(v) for v in (0, 0.01234, 1.234, 98.07, 12345.6)] == ["0.00", "0.0123", "1.23", "98.1", "12346"]
    assert scale_words(2.5) == "2.50 : 1"
    assert scale_words(0.25) == "1 : 4.00"
    assert printable("äö 中") == "äö ?"


def test_sheet_says_what_the_bench_needs(bar, rig_run):
    sheet = rig_run(bar.state_artifact())["rig_sheet"]
    assert sheet.startswith(b"%PDF")
    text = pdf_text(sheet)
    for words in (
        "Rig sheet: bent-bar",
        "348 K",
        "308 K",
        "10.0",
        "98.1",
        "Clamp and mark",
        "Caliper",
        "Positions locked",
    ):
        assert words in text
    assert not re.search(r"(?<![\d.])-0\.?0*(?![\d.])", text)


def test_sheet_tells_the_uncertainty_of_each_force(rig_run, bar):
    state = bar.state_artifact()
    count = len(state["patch_center"])
    newton = [12.3 + k for k in range(count)]
    result = rig_run(state, uncertainty={"N": newton, "method": "a finer mesh"})
    text = pdf_text(result["rig_sheet"])
    assert all(f"\\261 {round(value)}" in text for value in newton)
    assert "by comparison with a finer mesh" in " ".join(text.split())
    assert result["rig_report"]["force_trust"]["uncertainty_N"] == newton
    rows = list(csv.DictReader(io.StringIO(result["forces_csv"].decode())))
    assert [float(row["force_uncertainty_N"]) for row in rows] == pytest.approx(newton)


def test_equal_states_give_equal_bytes(bar, rig_run):
    first, second = rig_run(bar.state_artifact()), rig_run(bar.state_artifact())
    assert first["rig_sheet"] == second["rig_sheet"]
    assert first["forces_csv"] == second["forces_csv"]
    other = bar.state_artifact(forces=np.ones((3, 3)))
    assert rig_run(other)["rig_sheet"] != first["rig_sheet"]


def test_sheet_says_what_must_be_done_carefully(bar, rig_run, sensitivity):
    text = pdf_text(rig_run(bar.state_artifact(), sensitivity=sensitivity)["rig_sheet"])
    assert "HOLD POSITIONS, DO NOT HANG WEIGHTS" in text
    lines = text.splitlines()
    start = lines.index("What must be done carefully")
    off = ["all forces 5 % smaller", "every pad 1 mm off", "pad 2 alone 1 mm off", "TPE 10 % stiffer"]
    assert [line for line in lines[start + 3 : start + 13 : 2] if line][1:] == [
        next(line for line in lines if words in line) for words in off
    ]
    assert lines[start + 4 : start + 13 : 2] == ["0.150", "jumps away", "1.25", "0.800", "0.300"]
    for error in ("0.500", "0.800", "0.750"):
        assert error in lines[:start]


def test_changed_forces_that_were_not_simulated_are_told_by_the_model(bar, rig_run, sensitivity):
    for way, told in (("smaller", 4.75), ("larger", 4.25)):
        sensitivity["force"][way] |= {"simulated": False, "rms_mm": None, "model_rms_mm": told}
    lines = pdf_text(rig_run(bar.state_artifact(), sensitivity=sensitivity)["rig_sheet"]).splitlines()
    start = lines.index("What must be done carefully")
    assert lines[next(k for k in range(start, len(lines)) if "all forces 5 % smaller" in lines[k]) + 1] == "4.75"
    assert "jumps away" not in lines


def test_sheet_without_sensitivity_has_no_care_and_no_warning(bar, rig_run, sensitivity):
    plain = pdf_text(rig_run(bar.state_artifact())["rig_sheet"])
    assert "What must be done carefully" not in plain
    assert "DO NOT HANG WEIGHTS" not in plain
    sensitivity["instability"]["dead_loads"] = 0
    assert "DO NOT HANG WEIGHTS" not in pdf_text(rig_run(bar.state_artifact(), sensitivity=sensitivity)["rig_sheet"])
    sensitivity["hold"]["random_rms_mm"] = None
    assert "HARDLY STABLE" in pdf_text(rig_run(bar.state_artifact(), sensitivity=sensitivity)["rig_sheet"])
    unstable = {"stable": False, "left_out": [], "reasons": ["it snaps"]}
    assert "UNSTABLE" in pdf_text(rig_run(bar.state_artifact(), sensitivity=unstable)["rig_sheet"])


def test_checks_go_to_the_second_page_where_the_first_is_full(bar, rig_run, sensitivity, monkeypatch):
    def order(words):
        text = pdf_text(rig_run(bar.state_artifact(), sensitivity=sensitivity)["rig_sheet"])
        return [text.count(words), text.index(words) < text.index("views and notes")]

    assert order("Caliper checks") == [1, True]
    monkeypatch.setattr(sheet, "LOWEST_VIEWS", 98.0)
    assert order("Caliper checks") == [1, False]
    assert rig_run(bar.state_artifact(), sensitivity=sensitivity)["rig_sheet"].count(b"/Type /Page\n") == 2


def test_nothing_to_program_gives_no_sheet(bar, rig_run):
    state = bar.state_artifact()
    state |= {"patch_center": state["patch_center"][:0], "patch_force": np.zeros((0, 3))}
    for nothing in (None, state):
        result = rig_run(nothing)
        assert result["rig_sheet"] is None
        assert result["forces_csv"] is None
        assert "nothing to program" in result["rig_report"]["left_out"][0]["why"]


def test_forces_beyond_the_rig_are_said_on_the_sheet(bar, rig_run):
    result = rig_run(bar.state_artifact(forces=np.diag([1.0, 1.0, 3e5])))
    assert "point 3 needs 3e+05 N" in result["rig_report"]["reasons"][0]
    assert "NOT POSSIBLE ON THIS RIG" in pdf_text(result["rig_sheet"])


@pytest.mark.parametrize("sizes", [[55.0, 55, 155], [1, 1, 1], [152, 152, 132], [4000, 3, 3]])
def test_views_in_a_row_fit_the_page_at_the_largest_scale_that_does(sizes: list[float]) -> None:
    scale = sheet._row_scale(sizes, 2.0)
    assert 0 < scale <= 2.0
    assert sum(sheet._column_widths(sizes, scale)) <= sheet.FULL
    assert scale == 2.0 or sum(sheet._column_widths(sizes, 1.03 * scale)) > sheet.FULL


@pytest.mark.parametrize("extents", [(150.0, 20, 6), (10, 10, 150), (20, 150, 10), (80, 80, 80), (4000, 3, 3)])
def test_views_in_two_rows_and_their_titles_stay_on_the_page(
    extents: tuple[float, float, float], monkeypatch: pytest.MonkeyPatch
) -> None:
    shape, rooms = np.vstack([np.zeros(3), extents]), list[tuple[float, float, float, float]]()
    none = np.zeros((0, 3), np.int64)
    monkeypatch.setattr(sheet, "draw_view", lambda *seen: rooms.append(seen[4]))
    page = sheet.Page(Canvas(io.BytesIO()), sheet.HEIGHT - sheet.MARGIN)
    sheet._views_large(page, None, Figure(shape, shape, none, none, none), 168.0)
    assert len(rooms) == 3
    for left, bottom, width, _ in rooms:
        assert width >= sheet.TITLE_WIDTH
        assert left + width <= sheet.MARGIN + sheet.FULL + 1e-9
        assert bottom >= sheet.HEIGHT - sheet.MARGIN - 168.0 - 1e-9


@pytest.mark.parametrize("end", [(40.0, 0.0), (0.0, 40.0)])
def test_circles_keep_off_a_dimension_and_its_number(end: tuple[float, float]) -> None:
    dimension = drawing.Dimension((0.0, 0.0), end, "155.0", drawing.BLUE)
    line, *sides = drawing._occupied(dimension)
    np.testing.assert_array_equal(line, [(0.0, 0.0), end])
    across = 1 if dimension.level else 0
    for side, level in zip(sides, (-drawing.NUMBER / 2, drawing.NUMBER / 2), strict=True):
        np.testing.assert_allclose(side[:, across], level)
        assert np.ptp(side[:, 1 - across]) == pytest.approx(dimension.width)
        assert side[:, 1 - across].mean() == pytest.approx(20.0)


def test_sheet_of_a_rejected_design_says_so(bar, rig_run):
    assert "REJECTED" not in pdf_text(rig_run(bar.state_artifact())["rig_sheet"])
    text = pdf_text(rig_run(bar.state_artifact(), rejected=["RMS error is 9 mm", "b", "c", "d", "e"])["rig_sheet"])
    assert "Rig sheet: bent-bar \\(REJECTED\\)" in text
    assert "bent-bar \\(REJECTED\\): views and notes" in text
    assert "REJECTED: RMS error is 9 mm" in text
    assert "and 2 more reasons: see report.html" in text
    assert "REJECTED: d" not in text


def test_sheet_says_how_the_part_stood_on_the_printer(bar, rig_run):
    assert "frame of the printed part" in pdf_text(rig_run(bar.state_artifact())["rig_sheet"])
    text = pdf_text(rig_run(bar.state_artifact(), up=(1.0, 0.0, 0.0))["rig_sheet"])
    assert "(1.000  0.000  0.000)" in text.replace("\\", "")
    assert "pointed up on the printer" in text
