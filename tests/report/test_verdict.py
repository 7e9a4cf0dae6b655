"""Each reason to reject, one at a time."""

import copy

import pytest

from fab4d.report.verdict import Limits, checks_of, default_tolerance, left_out_of, reasons_of

LIMITS = Limits(1.5, 8, 0.5, 1e-3, 0.3)
GOOD = {
    "error": {"rms_mm": 1.0},
    "forces": 8,
    "smp_fraction": 0.5,
    "ambiguous_fraction": 0.0,
    "isolated_fraction": 0.29,
    "equilibrium_residual": {"median": 1e-8, "final": 1e-9},
    "min_det_F": 0.1,
}
NOTHING_SAID = {"verify_report": {"reached": True}, "bodies_report": None}


def test_a_good_design_has_no_reason():
    assert reasons_of(checks_of(GOOD, LIMITS), NOTHING_SAID) == []


@pytest.mark.parametrize(
    ("path", "value", "word"),
    [
        (("error", "rms_mm"), 1.500001, "RMS error"),
        (("forces",), 9, "number of forces"),
        (("smp_fraction",), 0.51, "SMP share"),
        (("ambiguous_fraction",), 1e-3, "ambiguous"),
        (("isolated_fraction",), 0.3, "isolated"),
        (("equilibrium_residual", "median"), 1.1e-8, "median"),
        (("equilibrium_residual", "final"), 1.1e-8, "final"),
        (("min_det_F",), 0.0, "det F"),
        (("error", "rms_mm"), float("nan"), "RMS error"),
    ],
)
def test_each_figure_can_reject(path, value, word):
    figures = copy.deepcopy(GOOD)
    inner = figures
    for key in path[:-1]:
        inner = inner[key]
    inner[path[-1]] = value
    reasons = reasons_of(checks_of(figures, LIMITS), NOTHING_SAID)
    assert len(reasons) == 1
    assert word in reasons[0]


def test_an_unlimited_share_of_smp_is_not_checked():
    limits = Limits(1.5, 8, None, 1e-3, 0.3)
    assert reasons_of(checks_of(GOOD | {"smp_fraction": 1.0}, limits), NOTHING_SAID) == []


def test_stages_can_reject():
    reports = {"verify_report": {"reached": False, "reasons": ["b"]}, "rig_report": {"reasons": ["a", "b"]}}
    reasons = reasons_of(checks_of(GOOD, LIMITS), reports)
    assert "did not reach" in reasons[0]
    assert reasons[1:] == ["b", "a"]


def test_left_out_is_collected_once_in_order():
    gravity, workers = {"what": "gravity", "why": "none given"}, {"what": "workers", "why": "small"}
    reports = {"a": {"left_out": [gravity]}, "b": None, "c": {"left_out": [workers, gravity]}, "d": {}}
    assert left_out_of(reports) == [gravity, workers]


def test_the_usual_tolerance_follows_part_and_motion_in_any_unit():
    assert default_tolerance(200.0, 50.0) == pytest.approx(1.0)
    assert default_tolerance(200.0, 4.0) == pytest.approx(0.4)
    assert default_tolerance(200.0, 0.0) == pytest.approx(0.02)
    assert default_tolerance(0.2, 0.004) == pytest.approx(1e-3 * default_tolerance(200.0, 4.0))
