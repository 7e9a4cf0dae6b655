"""Printed labels that are relaxed and rounded anew."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from designed_bar import PROFILE, Artifacts, designed_bar, fit_of, rms

from fab4d.design.equilibria import Equilibria
from fab4d.design.gauss_newton import Design
from fab4d.design.reduced import polished, refit
from fab4d.stages import _renewed, _ways
from fab4d.stages.threshold import labels_for


@pytest.fixture(scope="module")
def inputs() -> Artifacts:
    return designed_bar()


def printed_design(inputs: Artifacts) -> Design:
    """Labels that leave much of the error on any processor: TPE alone, which springs back."""
    equilibria, weights, _ = fit_of(inputs)
    design = _ways.carried(equilibria, inputs["relaxed"], np.zeros(equilibria.problem.n_tets))
    assert design is not None
    return refit(equilibria, design, weights, lambda _: None)


def renewed(inputs: Artifacts, design: Design, polish: Any = None, **changes: Any) -> tuple[Design, list[str]]:
    """The design that is found, and the phases that were shown.

    changes : of the settings of flips
    """
    equilibria, weights, settings = fit_of(inputs)
    phases = list[str]()
    trace: Any = SimpleNamespace(add=lambda phase, _: phases.append(phase))
    radius = float(inputs["relaxed"]["patch_radius"]) / equilibria.problem.length
    wanted = replace(settings, **({"low_rms": 0.0, "tolerance": np.inf} | changes))
    keep = polish or (lambda _, each: each)
    return _renewed.renewed(equilibria, design, radius, weights, wanted, keep, trace), phases


def test_labels_rounded_anew_leave_less_of_the_error_and_can_be_printed(inputs: Artifacts) -> None:
    before = printed_design(inputs)
    problem = fit_of(inputs)[0].problem
    after, phases = renewed(inputs, before, target_rms=0.0)
    assert {"relax", "round", "printed"} <= set(phases)
    assert rms(problem, after) < 0.5 * rms(problem, before)
    X, tets = inputs["mesh"]["X"], inputs["mesh"]["tets"]
    smp = after.rho > 0.5
    assert set(np.unique(after.rho)) <= {0.0, 1.0}
    again = labels_for(X, tets, after.rho, np.ones(len(tets)), PROFILE["printer"])
    np.testing.assert_array_equal(again.smp, smp)
    exact = polished(fit_of(inputs)[0], after)
    np.testing.assert_allclose(exact.median.x, after.median.x, atol=1e-5)
    np.testing.assert_allclose(exact.final.y, after.final.y, atol=1e-5)


@pytest.mark.parametrize(
    ("name", "share"), [("target_rms", 1.01), ("low_rms", 1.01), ("tolerance", 0.99 / _renewed.OUT_OF_REACH)]
)
def test_what_needs_no_better_labels_or_is_out_of_reach_keeps_its_own(
    inputs: Artifacts, name: str, share: float
) -> None:
    """share : of the error of the design"""
    before = printed_design(inputs)
    error = rms(fit_of(inputs)[0].problem, before)
    assert renewed(inputs, before, **({"target_rms": 0.0} | {name: share * error})) == (before, [])


def test_many_unknowns_keep_their_labels(inputs: Artifacts, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(_renewed, "MANY_DOFS", 3 * fit_of(inputs)[0].problem.n_nodes - 1)
    before = printed_design(inputs)
    assert renewed(inputs, before, target_rms=0.0) == (before, [])


@pytest.mark.parametrize(
    ("worse", "ratio", "taken"),
    [("error", 0.3, False), ("share of SMP", 0.3, False), ("", 0.3, True), ("", 0.21, True), ("", 0.19, False)],
)
def test_other_labels_that_are_no_better_are_not_taken(
    inputs: Artifacts, monkeypatch: pytest.MonkeyPatch, worse: str, ratio: float, taken: bool
) -> None:
    """ratio : of the stiffness of the softest mode, of which the design to begin with keeps 0.4"""
    before, polished = printed_design(inputs), list[Design]()
    problem = fit_of(inputs)[0].problem

    def polish(_: Equilibria, design: Design) -> Design:
        polished.append(design)
        if worse == "error":
            y = problem.X_temp + 2.0 * (before.final.y - problem.X_temp)
        else:
            y = problem.X_temp + 0.5 * (before.final.y - problem.X_temp)
        return replace(design, rho=np.ones_like(design.rho), final=replace(design.final, y=y))

    monkeypatch.setattr(_renewed, "least_ratio", lambda _, design: 0.4 if design is before else ratio)
    monkeypatch.setattr(_renewed, "SHARES", (1.0,))
    most = 0.99 if worse == "share of SMP" else 1.0
    found = renewed(inputs, before, polish, target_rms=0.0, max_smp_fraction=most)[0]
    assert len(polished) == 1
    assert (found is not before) == taken


def test_labels_without_equilibria_on_the_way_keep_their_own(
    inputs: Artifacts, monkeypatch: pytest.MonkeyPatch
) -> None:
    before = printed_design(inputs)
    with monkeypatch.context() as patch:
        patch.setattr(_renewed, "rounded_on", lambda *_: None)
        assert renewed(inputs, before, target_rms=0.0)[0] is before
    monkeypatch.setattr(_renewed, "way_near", lambda *_: None)
    assert renewed(inputs, before, target_rms=0.0)[0] is before
