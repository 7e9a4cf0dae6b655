"""The stage that rounds the density: what it writes, and when it rejects a design."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from fab4d.io.cards import load_printer
from fab4d.io.scene import Acceptance
from fab4d.stages import threshold
from fab4d.stages.monitor import SilentMonitor

PRINTER = load_printer("generic-dual-0.4", Path())


def run(mesh, rho, printer=PRINTER, acceptance=None):
    profile = {"printer": printer, "acceptance": acceptance or Acceptance()}
    relaxed = {"rho": rho, "repair_cost": np.ones(len(rho))}
    out = threshold.run({"mesh": mesh, "relaxed": relaxed}, profile, SilentMonitor())
    assert set(out) == {"rounded", "threshold_report"}
    return out["rounded"], out["threshold_report"]


def half(mesh):
    return (mesh["X"][mesh["tets"]].mean(axis=1)[:, 0] < 15).astype(float)


def test_a_clear_design_is_taken_as_it_is(mesh):
    labels, report = run(mesh, half(mesh))
    assert np.array_equal(labels["smp"], half(mesh) == 1)
    assert report["acceptable"]
    assert report["reasons"] == []
    assert report["smp_fraction"] == pytest.approx(0.5)
    assert (report["clusters"], report["ambiguous_fraction"], report["isolated_fraction"]) == (1, 0.0, 0.0)
    assert set(report["changed_fraction"]) == {"clusters", "features", "well_composed", "larger_features", "total"}


def test_an_undecided_design_is_rejected(mesh):
    _, report = run(mesh, np.where(half(mesh) == 1, 0.6, 0.0))
    assert report["ambiguous_fraction"] == 0.5
    assert not report["acceptable"]
    assert "50.000% of the tets are neither SMP nor TPE" in report["reasons"][0]
    _, report = run(mesh, np.where(half(mesh) == 1, 0.6, 0.0), acceptance=Acceptance(max_ambiguous_fraction=0.6))
    assert report["acceptable"]


def test_a_scattered_design_is_rejected_although_the_labels_can_be_printed(mesh):
    rho = (np.random.default_rng(0).random(len(mesh["tets"])) < 0.1).astype(float)
    _, report = run(mesh, rho)
    assert report["isolated_fraction"] > 0.3
    assert report["defects_left"] == []
    assert ["touch no other SMP tet" in reason for reason in report["reasons"]] == [True]


def test_pure_materials(mesh):
    for rho in (np.zeros(len(mesh["tets"])), np.ones(len(mesh["tets"]))):
        labels, report = run(mesh, rho)
        assert np.array_equal(labels["smp"], rho == 1)
        assert report["acceptable"]


def test_smp_too_small_to_print_is_a_reason(mesh):
    rho = np.zeros(len(mesh["tets"]))
    rho[:6] = 1.0
    coarse = replace(PRINTER, line_width=4.0, layer_height=4.0)
    labels, report = run(mesh, rho, coarse)
    assert not labels["smp"].any()
    assert "all SMP of the design is too small" in report["reasons"][0]


def test_tets_the_design_is_unsure_about_change_first(mesh):
    rng = np.random.default_rng(3)
    smp = rng.random(len(mesh["tets"])) < 0.5
    sure = rng.random(len(smp)) < 0.5
    rho = np.where(smp, np.where(sure, 1.0, 0.55), np.where(sure, 0.0, 0.45))
    labels, _ = run(mesh, rho)
    changed = labels["smp"] != smp
    assert changed[sure].mean() < 0.6 * changed[~sure].mean()
