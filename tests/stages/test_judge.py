"""The verdict before printing is that of the report, but for what later stages add."""

from pathlib import Path

import numpy as np
import pytest

from fab4d.io.cards import load_material, load_rig
from fab4d.io.scene import Acceptance, Goal
from fab4d.mesh.topology import face_table
from fab4d.stages import judge
from fab4d.stages.monitor import SilentMonitor

PROFILE = {
    "materials": load_material("paper-corrected", Path()),
    "rig": load_rig("bench", Path()),
    "acceptance": Acceptance(),
}


def verdict(mesh, moved, tolerance=None, **reports):
    inputs = {"mesh": mesh | {"X_temp": mesh["X"] + moved, "clamp": np.zeros(len(mesh["X"]), bool)}}
    inputs |= dict.fromkeys((*judge.REPORTS, "labels", "state")) | {"check_report": {}} | reports
    return judge.run(inputs, PROFILE | {"goal": Goal(tolerance=tolerance)}, SilentMonitor())["verdict_report"]


def bent(mesh):
    return np.outer(mesh["X"][:, 0] ** 2 / 100, [0, 0, 1])


def test_a_part_at_rest_where_it_should_be_is_accepted(mesh):
    assert verdict(mesh, 0.0) == {"verdict": "ACCEPTED", "reasons": []}


def test_an_error_above_the_tolerance_is_the_first_reason(mesh):
    found = verdict(mesh, bent(mesh), 0.5, solve_report={"reasons": ["no better design was found"]})
    assert found["verdict"] == "REJECTED"
    assert found["reasons"][0].startswith("RMS error is ")
    assert found["reasons"][1] == "no better design was found"
    assert verdict(mesh, bent(mesh), 50.0)["verdict"] == "ACCEPTED"


def test_without_a_tolerance_a_small_motion_has_to_be_made(mesh):
    """Staying as it is misses all of the prescribed motion, however small that is beside the part."""
    small = 1e-2 * bent(mesh)
    assert np.linalg.norm(small, axis=1).max() < 5e-3 * np.linalg.norm(np.ptp(mesh["X"], axis=0))
    assert verdict(mesh, small)["verdict"] == "REJECTED"


@pytest.mark.parametrize("name", [name for name in judge.REPORTS if name != "verify_report"])
def test_what_an_earlier_stage_says_rejects(mesh, name):
    assert verdict(mesh, 0.0, **{name: {"reasons": ["it leaks"]}})["reasons"] == ["it leaks"]


@pytest.mark.parametrize(("count", "rejected"), [(1, True), (2, False)])
def test_isolated_tets_that_are_printed_reject(mesh, count, rejected):
    """Flips come after the labels that stage threshold judges."""
    first, second = face_table(mesh["tets"]).interior_tets[0]
    smp = np.zeros(len(mesh["tets"]), bool)
    smp[[first, second][:count]] = True
    rounded = {"ambiguous_fraction": 0.0, "isolated_fraction": 0.0, "reasons": []}
    found = verdict(mesh, 0.0, labels={"smp": smp}, threshold_report=rounded)
    assert (found["verdict"] == "REJECTED") == rejected
    assert ("isolated" in " ".join(found["reasons"])) == rejected
