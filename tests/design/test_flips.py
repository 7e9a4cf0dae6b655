"""Flipping labels after rounding: sensitivities against differences, and known labels found again."""

import itertools
from dataclasses import replace

import numpy as np
import pytest
from bars import bar, held_design, two_patches

from fab4d.design import flips
from fab4d.design.equilibria import Equilibria
from fab4d.design.flips import (
    FlipSettings,
    at_interface,
    compensated,
    error_left,
    flip,
    polish_labels,
)
from fab4d.design.gauss_newton import Design, equilibrate, held_positions
from fab4d.design.influence import Influence, influence
from fab4d.design.objective import ObjectiveWeights, shape_error
from fab4d.design.problem import Problem
from fab4d.errors import EquilibriumError
from fab4d.mesh.rigid import best_rigid_motion

WEIGHTS = ObjectiveWeights(error_scale=1e-3)
FREELY = FlipSettings(printable=lambda smp: smp, flippable=lambda smp, tet: True, target_rms=0.0)  # noqa: ARG005


def at_all_tets(equilibria: Equilibria, design: Design) -> Influence:
    return influence(equilibria, design, np.arange(equilibria.problem.n_tets), WEIGHTS)


def upper_half(problem: Problem) -> np.ndarray:
    X = problem.body.X
    return X[problem.body.elements].mean(axis=1)[:, 2] > 0.5 * X[:, 2].max()


def test_labels_that_were_spoilt_are_made_good_again() -> None:
    """The wanted shape is that of known labels; some are flipped, and the error they cause is flipped away."""
    made = bar(cells=(6, 3, 2), degrees=40.0)
    equilibria, smp = two_patches(made), upper_half(made)
    truth = held_design(equilibria, smp.astype(float), made.X_temp)
    problem = _wanting(made, truth)
    at = Equilibria(problem, equilibria.patches)
    spoilt = smp.copy()
    spoilt[np.flatnonzero(at_interface(problem, smp))[::4]] ^= True
    held = held_positions(equilibria, truth.median)
    start = equilibrate(at, spoilt.astype(float), held, truth.median.x, truth.median.forces, truth.final.y)
    assert start is not None
    shown: list[float] = []
    end = polish_labels(at, start, WEIGHTS, FREELY, lambda s: shown.append(shape_error(problem, s.design.final.y).rms))
    before, after = (shape_error(problem, d.final.y).rms for d in (start, end))
    assert after < 0.5 * before
    assert set(np.unique(end.rho)) == {0.0, 1.0}
    assert shown == sorted(shown, reverse=True)
    assert shown[-1] == after


def _wanting(made: Problem, design: Design) -> Problem:
    """The problem whose temporary shape is what the design becomes."""
    X, clamp = made.body.X, made.clamp
    R, t = best_rigid_motion(design.final.y[clamp], X[clamp])
    return replace(made, X_temp=design.final.y @ R.T + t)


def test_nothing_is_flipped_at_the_target_or_where_nothing_may_be() -> None:
    problem = bar(degrees=30.0)
    equilibria = two_patches(problem)
    design = held_design(equilibria, upper_half(problem).astype(float), problem.X_temp)
    for settings in (
        FlipSettings(FREELY.printable, FREELY.flippable, target_rms=1.0),
        FlipSettings(FREELY.printable, lambda smp, tet: False, target_rms=0.0),  # noqa: ARG005
    ):
        same = polish_labels(equilibria, design, WEIGHTS, settings, lambda at: None)  # noqa: ARG005
        np.testing.assert_array_equal(same.rho, design.rho)


def test_fewer_flips_are_tried_where_many_have_no_equilibrium(monkeypatch: pytest.MonkeyPatch) -> None:
    problem = bar(degrees=30.0)
    equilibria, tried = two_patches(problem), []
    design = held_design(equilibria, upper_half(problem).astype(float), problem.X_temp)

    def lost(at: Equilibria, before: Design, rho: np.ndarray, smallest: float, stay: bool) -> Design:  # noqa: ARG001
        tried.append(int(np.abs(rho - before.rho).sum()))
        msg = "none"
        raise EquilibriumError(msg)

    monkeypatch.setattr(flips, "change_density", lost)
    same = polish_labels(equilibria, design, WEIGHTS, FREELY, lambda at: None)  # noqa: ARG005
    assert same is design
    assert 1 < len(tried) < 5
    assert all(after < before for before, after in itertools.pairwise(tried))


def test_a_part_without_smp_is_left_as_it_is() -> None:
    """It comes back to its permanent shape wherever it is held, and has no interface."""
    problem = bar(degrees=30.0)
    equilibria = two_patches(problem)
    design = held_design(equilibria, np.zeros(problem.n_tets), problem.X_temp)
    same = polish_labels(equilibria, design, WEIGHTS, FREELY, lambda at: None)  # noqa: ARG005
    assert not same.rho.any()


def test_flips_stay_at_the_interface_and_within_the_share_of_smp() -> None:
    problem = bar(degrees=30.0)
    equilibria, smp = two_patches(problem), upper_half(problem)
    found = at_all_tets(equilibria, held_design(equilibria, smp.astype(float), problem.X_temp))
    first = flip(problem, found, smp, smp, FREELY, 1) != smp
    assert first.sum() == 1
    assert at_interface(problem, smp)[first].all()
    assert (flip(problem, found, smp, smp, FREELY, 30) & ~smp).any()
    full = replace(FREELY, max_smp_fraction=0.0)
    fewer = flip(problem, found, smp, smp, full, 30)
    assert (fewer != smp).any()
    assert smp[fewer].all()


def test_flips_that_are_chosen_lower_the_predicted_error() -> None:
    problem = bar(cells=(6, 3, 2), degrees=30.0)
    equilibria, smp = two_patches(problem), upper_half(problem)
    found = at_all_tets(equilibria, held_design(equilibria, smp.astype(float), problem.X_temp))
    left = [error_left(found, smp, flip(problem, found, smp, smp, FREELY, most)) for most in range(6)]
    assert left == sorted(left, reverse=True)
    assert left[0] == pytest.approx(np.linalg.norm(found.residual), rel=0.05)
    assert left[5] < left[0]


def test_a_repair_is_made_up_for() -> None:
    """Tets that were changed by force may be given back, or others changed: the predicted error falls."""
    problem = bar(cells=(6, 3, 2), degrees=30.0)
    equilibria, smp = two_patches(problem), upper_half(problem)
    found = at_all_tets(equilibria, held_design(equilibria, smp.astype(float), problem.X_temp))
    repair = smp.copy()
    repair[np.flatnonzero(at_interface(problem, smp))[::5]] ^= True
    better = compensated(problem, found, smp, repair, FREELY)
    assert error_left(found, smp, better) < 0.9 * error_left(found, smp, repair)

    def bad(smp: np.ndarray) -> np.ndarray:
        return ~smp

    np.testing.assert_array_equal(compensated(problem, found, smp, repair, replace(FREELY, printable=bad)), repair)


def test_what_comes_to_nothing_teaches(monkeypatch: pytest.MonkeyPatch) -> None:
    """The same flips are not tried twice where they raised the error."""
    problem = bar(degrees=30.0)
    equilibria, tried = two_patches(problem), []
    design = held_design(equilibria, upper_half(problem).astype(float), problem.X_temp)
    smp = design.rho > 0.5

    def worse(at: Equilibria, before: Design, rho: np.ndarray, smallest: float, stay: bool) -> Design:  # noqa: ARG001
        tried.append(frozenset(np.flatnonzero((rho > 0.5) != smp)))
        return held_design(equilibria, rho, problem.body.X)

    monkeypatch.setattr(flips, "change_density", worse)
    monkeypatch.setattr(flips, "refit", lambda at, trial, *rest, **named: trial)  # noqa: ARG005
    same = polish_labels(equilibria, design, WEIGHTS, FREELY, lambda at: None)  # noqa: ARG005
    assert same is design
    assert 1 < len(tried) <= flips.MOST_POOR
    assert len(set(tried)) == len(tried)


def test_of_smaller_tets_more_are_flipped_for_less_each(monkeypatch: pytest.MonkeyPatch) -> None:
    """As if the bar's tets were four times as many as usual."""
    problem = bar(cells=(6, 3, 2), degrees=30.0)
    equilibria, smp = two_patches(problem), upper_half(problem)
    design = held_design(equilibria, smp.astype(float), problem.X_temp)
    found = at_all_tets(equilibria, design)
    monkeypatch.setattr(flips, "LEAST_GAIN", 0.03)
    few = flip(problem, found, smp, smp, FREELY, 1000) != smp
    asked: list[int] = []

    def none_chosen(*args: object) -> np.ndarray:
        asked.append(int(str(args[-1])))
        return smp

    monkeypatch.setattr(flips, "USUAL_TETS", problem.n_tets / 4)
    assert (flip(problem, found, smp, smp, FREELY, 1000) != smp).sum() > 1.5 * few.sum()
    monkeypatch.setattr(flips, "flip", none_chosen)
    polish_labels(equilibria, design, WEIGHTS, FREELY, lambda at: None)  # noqa: ARG005
    assert asked == [4 * flips.FIRST_BATCH]
