import importlib.util
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest

from fab4d.io.cards import load_material, load_printer, load_rig
from fab4d.io.csvtable import TRACE_COLUMNS, csv_bytes
from fab4d.io.scene import Acceptance, Goal


@pytest.fixture(scope="session")
def bar() -> ModuleType:
    """The programmed bar of the rig tests."""
    path = Path(__file__).parents[1] / "rig" / "bent_bar.py"
    spec = importlib.util.spec_from_file_location("report_bent_bar", path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def sensitivity_report() -> dict[str, Any]:
    """Three pads; set by force, no shape is found with smaller ones."""
    both = {"softer": {"rms_mm": 0.2, "forces": 0.97}, "stiffer": {"rms_mm": 0.3, "forces": 1.1}}
    pads = [(0.5, None), (0.9, 0.8), (0.7, 0.75)]
    return {
        "stable": True,
        "instability": {"held": 0, "final": 0, "dead_loads": 2, "points": []},
        "softest": {"stiffness_left": 0.217, "at_mm": [12.0, 3.0, -0.2]},
        "rms_mm": 0.15,
        "hold": {
            "change_mm": 1.0,
            "model_holds": True,
            "random_rms_mm": 1.25,
            "random_model_rms_mm": 1.25,
            "points": [
                {"point": k, "direction": [0.0, -0.6, 0.8], "model_rms_mm": model}
                | {"simulated": rms is not None, "rms_mm": rms}
                for k, (model, rms) in enumerate(pads, 1)
            ],
        },
        "force": {
            "change": 0.05,
            "smaller": {"simulated": True, "model_rms_mm": 0.6, "model_travel_mm": 7.0, "rms_mm": None},
            "larger": {"simulated": True, "model_rms_mm": 0.65, "model_travel_mm": 7.0, "rms_mm": 2.5},
            "points": [{"point": k, "model_rms_mm": 0.4, "model_travel_mm": 1.0} for k in (1, 2, 3)],
        },
        "modulus": {"change": 0.1, "tpe": both, "rubbery": both, "glassy": both},
        "reasons": [],
        "left_out": [],
    }


@pytest.fixture
def sensitivity() -> dict[str, Any]:
    return sensitivity_report()


def trace(solver: str, phases: list[str], n: int) -> bytes:
    rows = [
        {
            "solver": solver,
            "phase": phases[k * len(phases) // n],
            "wall_s": 0.1 * (k + 1),
            "tau": 10.0 * (k + 1),
            "rms_mm": 3.0 * 0.9**k,
            "max_mm": 9.0 * 0.9**k,
            "hausdorff_mm": 2.5 * 0.9**k,
            "smp_fraction": 0.6 - 0.3 * k / n,
            "forces": 8,
            "ambiguous_fraction": 1 - (k + 1) / n,
        }
        for k in range(n)
    ]
    return csv_bytes(TRACE_COLUMNS, rows)


@pytest.fixture
def profile() -> dict[str, Any]:
    return {
        "name": "bent-bar",
        "materials": load_material("paper-corrected", Path()),
        "printer": load_printer("generic-dual-0.4", Path()),
        "rig": load_rig("bench", Path()),
        "goal": Goal(tolerance=1.0, max_forces=4),
        "acceptance": Acceptance(),
    }


@pytest.fixture
def inputs(bar: ModuleType) -> dict[str, Any]:
    """The artifacts of a whole run on the bar."""
    state, smp = bar.state_artifact(), bar.labels_artifact()["smp"]
    return {
        "mesh": bar.mesh_artifact(),
        "check_report": {"findings": [], "nothing_to_program": False, "left_out": [{"what": "gravity", "why": "none"}]},
        "relaxed": {"rho": np.where(smp, 0.97, 0.02), "x": state["x"], "y": state["y"]},
        "solve_report": {"tau_s": 0.01, "left_out": [{"what": "iterative solver", "why": "small scene"}]},
        "solve_trace": trace("reduced", ["start", "release", "finish"], 30),
        "labels": bar.labels_artifact(),
        "threshold_report": {"ambiguous_fraction": 0.0, "isolated_fraction": 0.1, "reasons": []},
        "refit_report": {"left_out": [{"what": "gravity", "why": "none"}]},
        "refit_trace": trace("reduced", ["refit"], 5),
        "state": state,
        "verify_report": {
            "element_order": 1,
            "equilibrium_residual": {"median": 1e-11, "final": 2e-11},
            "min_det_F": 0.8,
            "reached": True,
            "reasons": [],
        },
        "sensitivity_report": sensitivity_report(),
        "bodies_report": None,
        "slice_report": None,
        "print_places": None,
        "rig_report": {"points": 3, "reasons": [], "left_out": []},
        "run": {
            "stages": [
                {"name": "check", "wall_s": 0.5, "peak_rss_mb": 150.0},
                {"name": "solve", "wall_s": 4.0, "peak_rss_mb": 210.0},
                {"name": "threshold", "wall_s": 0.25, "peak_rss_mb": 210.0},
                {"name": "refit", "wall_s": 1.0, "peak_rss_mb": 210.0},
            ],
            "wall_s": 5.75,
            "peak_rss_mb": 210.0,
            "versions": {"fab4d": "0.1.0"},
            "inputs": {"perm.msh": "ab" * 32},
        },
    }
