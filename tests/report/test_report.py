"""The report stage: its contract, read back from its own files."""

import io
import json
import re
from base64 import b64decode

import meshio
import numpy as np
import pytest
from PIL import Image

from fab4d.errors import ArtifactError
from fab4d.io.csvtable import TRACE_COLUMNS, csv_bytes, read_csv
from fab4d.io.scene import Goal
from fab4d.report.careful import warnings
from fab4d.report.page import _careful
from fab4d.runner.summary import report_lines
from fab4d.stages.monitor import SilentMonitor
from fab4d.stages.report import run

FIELDS = [
    *("verdict", "reasons", "error", "target_displacement_mm", "target_projection", "smp_fraction", "forces"),
    *("ambiguous_fraction", "isolated_fraction", "fixity", "undesired_deformation", "equilibrium_residual"),
    *("min_det_F", "element_order", "force_change", "force_uncertainty", "mass_g", "cost_usd", "sensitivity"),
    *("printing", "picked", "tau_s", "wall_s"),
    *("peak_rss_mb", "findings", "left_out", "stages", "growth", "versions", "inputs"),
]


@pytest.fixture
def result(inputs, profile):
    return run(inputs, profile, SilentMonitor())


def page_data(page: bytes) -> dict:
    return json.loads(re.search(rb'<script type="application/json" id="data">(.*?)</script>', page, re.DOTALL)[1])


def test_the_cost_of_a_projected_target_is_told_and_part_of_the_error(inputs, profile):
    mesh, before = inputs["mesh"], run(inputs, profile, SilentMonitor())["report_json"]
    inputs["mesh"] = mesh | {"X_wanted": mesh["X_temp"] * [1.0, 1.0, 1.2]}
    inputs["check_report"]["target_projection"] = {"rms_mm": 0.123, "max_mm": 0.5}
    result = run(inputs, profile, SilentMonitor())
    assert result["report_json"]["target_projection"] == {"rms_mm": 0.123, "max_mm": 0.5}
    assert result["report_json"]["error"]["rms_mm"] > before["error"]["rms_mm"]
    assert b"0.123 mm" in result["report_html"]


def test_the_trust_in_the_forces_is_told(inputs, profile):
    change = {"linear_N": [800.0, 90.0], "quadratic_N": [517.0, 80.0], "largest": 0.5}
    uncertainty = {"method": "a finer mesh", "order": 2, "N": [31.4, 2.0], "relative": [0.06, 0.03], "largest": 0.06}
    inputs["verify_report"] |= {"force_change": change, "force_uncertainty": uncertainty}
    result = run(inputs, profile, SilentMonitor())
    assert result["report_json"]["force_change"] == change
    assert result["report_json"]["force_uncertainty"] == uncertainty
    assert b"800 / 517 N" in result["report_html"]
    printed = "\n".join(report_lines(result["report_json"]))
    assert "800 N in linear elements, 517 N in quadratic ones" in printed
    assert "+- 31 N (6 %) by a finer mesh" in printed


def test_what_the_doctor_found_is_told(inputs, profile):
    found = {
        "code": "travel",
        "severity": "warning",
        "file": "temp.vtu",
        "message": "too far <for> the rig",
        "count": 2,
    }
    inputs["check_report"]["findings"] = [found]
    result = run(inputs, profile, SilentMonitor())
    expected = {"severity": "warning", "code": "travel", "message": "too far <for> the rig"}
    assert result["report_json"]["findings"] == [expected]
    assert b"warning: too far &lt;for&gt; the rig" in result["report_html"]
    assert "  warning  travel: too far <for> the rig" in report_lines(result["report_json"])


def test_report_has_the_fields_of_the_contract_verdict_first(result):
    report = json.loads(json.dumps(result["report_json"], allow_nan=False))
    assert list(report) == FIELDS
    assert report["verdict"] == "ACCEPTED"
    assert report["stages"][1] == {"name": "solve", "wall_s": 4.0, "peak_rss_mb": 210.0, "tau": 400.0}
    assert [item["what"] for item in report["left_out"]] == ["gravity", "iterative solver"]


def test_a_rejected_design_says_why_first_everywhere(inputs, profile):
    inputs["verify_report"]["reached"] = False
    inputs["bodies_report"] = {"reasons": ["<SMP> leaks"]}
    result = run(inputs, profile, SilentMonitor())
    report, page = result["report_json"], result["report_html"].decode()
    assert report["verdict"] == "REJECTED"
    assert len(report["reasons"]) == 2
    assert page.index("did not reach") < page.index("RMS error")
    assert "&lt;SMP&gt; leaks" in page
    assert "<SMP>" not in page


def test_printing_warns_without_rejecting(inputs, profile):
    thin = {"check": "walls", "ok": False, "value": 0.25, "sense": "at most", "limit": 0.001, "unit": "of it"}
    inputs["bodies_report"] = {"checks": [thin | {"where": [1, 2, 3]}], "bodies": {"smp": {"filament_m": 2.5}}}
    inputs["slice_report"] = {"checks": [], "print_time_s": 60, "left_out": []}
    result = run(inputs, profile, SilentMonitor())
    printing = result["report_json"]["printing"]
    assert result["report_json"]["verdict"] == "ACCEPTED"
    assert (printing["filament_m"], printing["print_time_s"]) == ({"smp": 2.5}, 60)
    assert printing["checks"][0]["check"] == "walls"
    row = "<td>walls</td><td>0.25 of it at (1, 2, 3) mm</td><td>at most 0.001 of it</td>"
    assert row + '<td class="outcome">warns</td>' in result["report_html"].decode()


def test_how_near_the_part_is_to_buckling_is_told_where_it_is_known(result, sensitivity):
    page = result["report_html"].decode()
    assert "near (12, 3, 0) mm of the printed part: of its stiffness at rest 22 % is left there" in page
    assert _careful(sensitivity | {"softest": None}).count("<p>") == _careful(sensitivity).count("<p>") - 1


@pytest.mark.parametrize(("left", "told"), [(0.054, True), (0.1, False)])
def test_a_part_that_has_nearly_buckled_is_warned_of(sensitivity, left, told):
    said = [
        words for words in warnings(sensitivity | {"softest": {"stiffness_left": left, "at_mm": [12.0, 3.0, -0.2]}})
    ]
    assert any("keeps 5.4 % of its stiffness at rest near (12, 3, 0) mm" in words for words in said) == told
    assert len(said) == len(warnings(sensitivity | {"softest": None})) + told


def test_sensitivity_is_told_on_the_page(result, sensitivity):
    told = result["report_json"]["sensitivity"]
    assert told == {key: value for key, value in sensitivity.items() if key not in ("reasons", "left_out")}
    page = result["report_html"].decode()
    assert '<p class="warning">HOLD POSITIONS, DO NOT HANG WEIGHTS' in page
    for what, rms, model in (
        ("pads set by force gauge, all forces 5 % smaller", "jumps away", "0.6"),
        ("pad 1 alone 1 mm off, towards (0.00 -0.60 0.80)", "0.500", "0.5"),
        ("pad 2 alone 1 mm off, towards (0.00 -0.60 0.80)", "0.800", "0.9"),
        ("hot SMP 10 % stiffer than its card says (forces 10 % larger)", "0.300", ""),
    ):
        row = f'<td>{what}</td><td class="number">{rms}</td><td class="number">{model}</td>'
        assert row in page


def test_an_unstable_design_is_rejected(inputs, profile):
    why = "the held median shape is unstable in 2 ways"
    inputs["sensitivity_report"] = {"stable": False, "reasons": [why], "left_out": [{"what": "s", "why": "unstable"}]}
    result = run(inputs, profile, SilentMonitor())
    assert result["report_json"]["verdict"] == "REJECTED"
    assert result["report_json"]["reasons"] == [why]
    assert result["report_json"]["sensitivity"] == {"stable": False}
    assert b"UNSTABLE" in result["report_html"]


def test_default_tolerance_is_a_part_of_the_diagonal(inputs, profile, bar):
    X = inputs["mesh"]["X"]
    inputs["mesh"]["X_temp"] = bar.bent(X, bar.FINAL + np.radians(6))
    report = run(inputs, profile | {"goal": Goal()}, SilentMonitor())["report_json"]
    assert report["error"]["rms_rel"] > 5e-3
    assert report["verdict"] == "REJECTED"
    assert run(inputs, profile, SilentMonitor())["report_json"]["verdict"] == "ACCEPTED"


def test_times_are_counted_from_the_start_of_the_run(result):
    rows = read_csv(result["error_vs_time"], TRACE_COLUMNS, "error-vs-time.csv")
    wall = np.array([float(r["wall_s"]) for r in rows])
    tau = np.array([float(r["tau"]) for r in rows])
    assert len(rows) == 35
    assert np.all(np.diff(wall) > 0)
    assert wall[0] == pytest.approx(0.5 + 0.1)
    assert wall[30] == pytest.approx(0.5 + 4.0 + 0.25 + 0.1)
    np.testing.assert_allclose(tau, wall / 0.01)


def test_a_trace_without_a_column_is_refused(inputs, profile):
    inputs["refit_trace"] = csv_bytes(TRACE_COLUMNS[:-1], [])
    with pytest.raises(ArtifactError, match="refit trace: no column ambiguous_fraction"):
        run(inputs, profile, SilentMonitor())


def test_plot_is_a_picture_of_the_trace(inputs, profile, result):
    picture = np.asarray(Image.open(io.BytesIO(result["error_plot"])).convert("RGB"))
    assert picture.shape[0] > 400
    assert picture.std() > 10
    assert run(inputs, profile, SilentMonitor())["error_plot"] == result["error_plot"]
    inputs["refit_trace"] = None
    assert run(inputs, profile, SilentMonitor())["error_plot"] != result["error_plot"]


@pytest.mark.parametrize("quadratic", [False, True])
def test_design_holds_the_verified_state(inputs, profile, bar, tmp_path, quadratic):
    state = inputs["state"] = bar.state_artifact(quadratic=quadratic)
    path = tmp_path / "design.vtu"
    path.write_bytes(run(inputs, profile, SilentMonitor())["design_vtu"])
    mesh = meshio.read(path)
    assert mesh.cells[0].type == ("tetra10" if quadratic else "tetra")
    np.testing.assert_array_equal(mesh.points, state["nodes"])
    np.testing.assert_array_equal(mesh.cells[0].data, state["elements"])
    for name, key in (("median", "x"), ("temporary", "y"), ("force", "force"), ("held", "held"), ("clamp", "clamp")):
        np.testing.assert_array_equal(mesh.point_data[name], state[key])
    assert set(mesh.point_data) == {"median", "temporary", "force", "held", "clamp"}
    assert set(mesh.cell_data) == {"smp", "rho", "cluster"}
    np.testing.assert_array_equal(mesh.cell_data["smp"][0], inputs["labels"]["smp"])
    np.testing.assert_array_equal(mesh.cell_data["rho"][0], inputs["relaxed"]["rho"])
    np.testing.assert_allclose(mesh.point_data["force"].sum(axis=0), state["patch_force"].sum(axis=0))


def test_page_is_self_contained_and_holds_the_shapes(result, inputs):
    page = result["report_html"]
    assert len(page) < 1_000_000
    assert not re.search(rb'(src|href)="(?!data:)', page)
    data = page_data(page)
    n = len(b64decode(data["permanent"])) // 12
    faces = np.frombuffer(b64decode(data["outer"]), "<u4").reshape(-1, 3)
    x = np.frombuffer(b64decode(data["permanent"]), "<f4").reshape(-1, 3)
    assert faces.max() < n
    areas = np.linalg.norm(np.cross(x[faces[:, 1]] - x[faces[:, 0]], x[faces[:, 2]] - x[faces[:, 0]]), axis=1) / 2
    assert areas.sum() == pytest.approx(2 * 7.5**2 + 4 * 7.5 * 30)
    point = data["points"][0]
    np.testing.assert_allclose(x[point["vertex"]], inputs["state"]["nodes"][inputs["state"]["patch_center"][0]])


def test_names_cannot_break_the_page(inputs, profile):
    page = run(inputs, profile | {"name": "</script><b>"}, SilentMonitor())["report_html"].decode()
    assert "&lt;/script&gt;&lt;b&gt;: ACCEPTED" in page
    assert page.count("</script>") == 3


def test_nothing_to_program_is_reported(inputs, profile):
    inputs["mesh"]["X_temp"] = inputs["mesh"]["X"]
    nothing = ("relaxed", "solve_report", "solve_trace", "labels", "threshold_report", "refit_report", "refit_trace")
    inputs["sensitivity_report"] = {"reasons": [], "left_out": [{"what": "sensitivity", "why": "no point"}]}
    inputs |= dict.fromkeys((*nothing, "state", "verify_report", "bodies_report"))
    inputs["rig_report"] = {
        "points": 0,
        "reasons": [],
        "left_out": [{"what": "rig sheet", "why": "nothing to program"}],
    }
    result = run(inputs, profile, SilentMonitor())
    report = result["report_json"]
    assert list(report) == FIELDS
    assert (report["verdict"], report["forces"], report["smp_fraction"]) == ("ACCEPTED", 0, 0.0)
    assert report["error"]["rms_mm"] < 1e-12
    assert report["fixity"] is None
    assert report["sensitivity"] is None
    assert result["error_vs_time"] is None
    assert result["design_vtu"].startswith(b"<?xml")
    assert b"Nothing was solved" in result["report_html"]


def test_equal_runs_give_equal_files(inputs, profile, result):
    again = run(inputs, profile, SilentMonitor())
    for name in ("error_vs_time", "design_vtu", "report_html"):
        assert again[name] == result[name]
