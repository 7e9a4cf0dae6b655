"""Flipping labels after rounding: sensitivities against differences, and known labels found again."""

import itertools
from dataclasses import replace

import numpy as np
import pytest
from bars import TIGHT, bar, held_design, two_patches

from fab4d.design import flips
from fab4d.design.equilibria import Equilibria
from fab4d.design.flips import (
    ErrorModes,
    FlipSettings,
    at_interface,
    choose_flips,
    error_modes,
    polish_labels,
    whole_flips,
)
from fab4d.design.gauss_newton import Design, equilibrate, held_positions
from fab4d.design.objective import ObjectiveWeights, shape_error
from fab4d.design.problem import Problem
from fab4d.errors import EquilibriumError
from fab4d.mesh.rigid import best_rigid_motion

WEIGHTS = ObjectiveWeights(error_scale=1e-3)
FREELY = FlipSettings(printable=lambda smp: smp, flippable=lambda smp, tet: True, target_rms=0.0)  # noqa: ARG005


def modes_at(equilibria: Equilibria, design: Design) -> ErrorModes:
    return error_modes(equilibria, design)


def amplitudes(problem: Problem, modes: ErrorModes, design: Design, reference: Design) -> np.ndarray:
    """Of the modes at the reference, in its frame."""
    error = shape_error(problem, design.final.y)
    return modes.directions.T @ (error.e @ shape_error(problem, reference.final.y).R).ravel()


def upper_half(problem: Problem) -> np.ndarray:
    X = problem.body.X
    return X[problem.body.elements].mean(axis=1)[:, 2] > 0.5 * X[:, 2].max()


@pytest.mark.parametrize("element", ["linear", "quadratic"])
def test_sensitivities_of_the_amplitudes_are_their_derivatives(element: str) -> None:
    problem = bar(cells=(3, 1, 1), degrees=25.0, element=element)
    equilibria = two_patches(problem)
    random = np.random.default_rng(1)
    rho = random.uniform(0.3, 0.7, problem.n_tets)
    design = held_design(equilibria, rho, problem.X_temp)
    modes = modes_at(equilibria, design)
    drho, dc = random.normal(size=problem.n_tets), random.normal(size=(2, 3))
    expected = drho @ modes.by_density + 0.1 * dc.ravel() @ modes.by_held
    h = 1e-5

    def moved(sign: float) -> np.ndarray:
        held = held_positions(equilibria, design.median) + sign * h * 0.1 * dc
        x, f, y = design.median.x, design.median.forces, design.final.y
        trial = equilibrate(equilibria, rho + sign * h * drho, held, x, f, y, TIGHT, 40)
        assert trial is not None
        return amplitudes(problem, modes, trial, design)

    found = (moved(1.0) - moved(-1.0)) / (2 * h)
    np.testing.assert_allclose(found, expected, atol=2e-5 * np.abs(expected).max())


def test_the_amplitudes_hold_the_whole_error() -> None:
    problem = bar(degrees=30.0)
    equilibria = two_patches(problem)
    design = held_design(equilibria, upper_half(problem).astype(float), problem.X_temp)
    modes = modes_at(equilibria, design)
    assert np.linalg.norm(modes.amplitudes) == pytest.approx(shape_error(problem, design.final.y).rms, rel=1e-9)


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
    design = held_design(equilibria, smp.astype(float), problem.X_temp)
    modes, factors = modes_at(equilibria, design), np.array([0.3, 1.0])
    chosen = choose_flips(problem, modes, design.rho, factors, FREELY, 30)
    assert len(chosen)
    assert at_interface(problem, smp)[chosen].all()
    assert not smp[chosen].all()
    full = FlipSettings(FREELY.printable, FREELY.flippable, target_rms=0.0, max_smp_fraction=0.0)
    assert smp[choose_flips(problem, modes, design.rho, factors, full, 30)].all()


def test_whole_flips_are_what_the_held_positions_leave_of_each() -> None:
    """Of a part of its derivative: the best move of the held positions takes the rest."""
    problem = bar(cells=(3, 1, 1), degrees=25.0)
    equilibria, smp = two_patches(problem), upper_half(problem)
    rho = smp.astype(np.float64)
    modes = modes_at(equilibria, held_design(equilibria, rho, problem.X_temp))
    found, error = whole_flips(modes, rho)
    step = modes.by_density * np.where(smp, -flips.FIRST_FACTORS[1], flips.FIRST_FACTORS[0])[:, None]
    followed, *_ = np.linalg.lstsq(modes.by_held.T, step.T, rcond=None)
    left = step - followed.T @ modes.by_held
    np.testing.assert_allclose(found, left, atol=0.1 * np.abs(left).max())
    assert np.linalg.norm(error) <= np.linalg.norm(modes.amplitudes) * (1 + 1e-9)


def test_flips_that_are_chosen_lower_the_predicted_error() -> None:
    problem = bar(cells=(6, 3, 2), degrees=30.0)
    equilibria, smp = two_patches(problem), upper_half(problem)
    rho = smp.astype(np.float64)
    modes = modes_at(equilibria, held_design(equilibria, rho, problem.X_temp))
    change, error = whole_flips(modes, rho)
    chosen = choose_flips(problem, modes, rho, np.array(flips.FIRST_FACTORS), FREELY, 5)
    assert np.linalg.norm(error + change[chosen].sum(axis=0)) < np.linalg.norm(error)


def test_of_smaller_tets_more_are_flipped_for_less_each(monkeypatch: pytest.MonkeyPatch) -> None:
    """As if the bar's tets were four times as many as usual."""
    problem = bar(cells=(6, 3, 2), degrees=30.0)
    equilibria, smp = two_patches(problem), upper_half(problem)
    rho, factors = smp.astype(np.float64), np.array(flips.FIRST_FACTORS)
    design = held_design(equilibria, rho, problem.X_temp)
    modes = modes_at(equilibria, design)
    monkeypatch.setattr(flips, "LEAST_GAIN", 0.05)
    few = choose_flips(problem, modes, rho, factors, FREELY, 1000)
    asked: list[int] = []

    def none_chosen(*args: object) -> np.ndarray:
        asked.append(int(str(args[-1])))
        return np.zeros(0, np.int64)

    monkeypatch.setattr(flips, "USUAL_TETS", problem.n_tets / 4)
    assert len(choose_flips(problem, modes, rho, factors, FREELY, 1000)) > 2 * len(few)
    monkeypatch.setattr(flips, "choose_flips", none_chosen)
    polish_labels(equilibria, design, WEIGHTS, FREELY, lambda at: None)  # noqa: ARG005
    assert asked == [4 * flips.FIRST_BATCH]
