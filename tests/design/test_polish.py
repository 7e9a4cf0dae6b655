"""Rounds of flipped labels: spoilt ones made good again, and when rounds go on, cost more or less, and end."""

import itertools
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from bars import bar, held_design, two_patches
from labelling import WEIGHTS, at_all_tets, freely, recording, upper_half

from fab4d.design import flips, polish
from fab4d.design.equilibria import Equilibria
from fab4d.design.flips import HELD_BACK, at_interface, predicted
from fab4d.design.gauss_newton import Ahead, Design, equilibrate, held_positions
from fab4d.design.influence import FlipEnergy, Influence, Settled
from fab4d.design.objective import ObjectiveWeights, shape_error
from fab4d.design.polish import polish_labels
from fab4d.design.problem import Problem
from fab4d.design.reduced import refit
from fab4d.errors import EquilibriumError
from fab4d.mesh.rigid import best_rigid_motion


def relative(energy: FlipEnergy) -> float:
    """The price in squared errors."""
    return energy.price / float(energy.error @ energy.error + (np.maximum(energy.beyond, 0) ** 2).sum())


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
    end = polish_labels(
        at, start, WEIGHTS, freely(problem), lambda s: shown.append(shape_error(problem, s.design.final.y).rms)
    )
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
        replace(freely(problem), target_rms=1.0),
        replace(freely(problem), annealed=lambda labels, *rest: labels),  # noqa: ARG005
        replace(freely(problem), printable=lambda smp: design.rho > 0.5),  # noqa: ARG005
    ):
        same = polish_labels(equilibria, design, WEIGHTS, settings, lambda at: None)  # noqa: ARG005
        np.testing.assert_array_equal(same.rho, design.rho)


def test_flips_become_dearer_where_they_have_no_equilibrium(monkeypatch: pytest.MonkeyPatch) -> None:
    problem = bar(degrees=30.0)
    equilibria, energies = two_patches(problem), list[FlipEnergy]()
    design = held_design(equilibria, upper_half(problem).astype(float), problem.X_temp)

    def lost(*args: object, **named: object) -> Design:  # noqa: ARG001
        msg = "none"
        raise EquilibriumError(msg)

    monkeypatch.setattr(polish, "follow_density", lost)
    same = polish_labels(equilibria, design, WEIGHTS, recording(freely(problem), energies), lambda at: None)  # noqa: ARG005
    assert same is design
    held_back = round(np.log(polish.MOST_DAMPING) / np.log(HELD_BACK))
    assert len(energies) == held_back + polish.MOST_POOR
    for before, after in itertools.pairwise(energies[: held_back + 2]):
        assert relative(after) == pytest.approx(polish.DEARER * relative(before))
        # What held positions make up for less is left of the error.
        assert np.linalg.norm(after.error) > np.linalg.norm(before.error)


def test_flips_whose_held_positions_would_move_too_far_are_not_followed(monkeypatch: pytest.MonkeyPatch) -> None:
    problem = bar(degrees=30.0)
    equilibria = two_patches(problem)
    design = held_design(equilibria, upper_half(problem).astype(float), problem.X_temp)
    monkeypatch.setattr(flips, "LARGEST_MOVE", 0.0)
    monkeypatch.setattr(polish, "follow_density", lambda *_: pytest.fail("they are followed"))
    same = polish_labels(equilibria, design, WEIGHTS, freely(problem), lambda at: None)  # noqa: ARG005
    assert same is design


def test_held_positions_are_let_go_again_after_flips_that_come_true(monkeypatch: pytest.MonkeyPatch) -> None:
    """The first round finds no equilibrium, the next two do."""
    problem = bar(degrees=30.0)
    equilibria, factors, follow = two_patches(problem), list[float](), polish.follow_density
    design = held_design(equilibria, upper_half(problem).astype(float), problem.X_temp)
    damped, values, rounds = Influence.damped, iter(np.geomspace(1e12, 1e6, 10)), itertools.count()

    def hold_back(self: Influence, factor: float) -> Influence:
        factors.append(factor)
        return damped(self, factor)

    def followed(*given: Any) -> Design:
        if next(rounds) == 0:
            raise EquilibriumError
        return follow(*given)

    monkeypatch.setattr(Influence, "damped", hold_back)
    monkeypatch.setattr(polish, "follow_density", followed)
    monkeypatch.setattr(polish, "evaluate", lambda *_: next(values))
    monkeypatch.setattr(polish, "refit", lambda at, trial, *rest, **named: trial)  # noqa: ARG005
    settings = replace(freely(problem), rounds=4)
    polish_labels(equilibria, design, WEIGHTS, settings, lambda at: None)  # noqa: ARG005
    held_back = HELD_BACK / polish.LET_GO
    assert factors == pytest.approx([1.0, HELD_BACK, held_back, held_back / polish.LET_GO])


def test_flips_become_cheaper_where_rounds_come_true_or_promise_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    problem = bar(degrees=30.0)
    equilibria, energies = two_patches(problem), list[FlipEnergy]()
    design = held_design(equilibria, upper_half(problem).astype(float), problem.X_temp)
    settings = replace(recording(freely(problem), energies), rounds=3)
    values = iter(np.geomspace(1e12, 1e6, 10))
    monkeypatch.setattr(polish, "evaluate", lambda *_: next(values))
    monkeypatch.setattr(polish, "refit", lambda at, trial, *rest, **named: trial)  # noqa: ARG005
    polish_labels(equilibria, design, WEIGHTS, settings, lambda at: None)  # noqa: ARG005
    assert len(energies) == 3
    for before, after in itertools.pairwise(energies):
        assert relative(before) == pytest.approx(polish.CHEAPER * relative(after))
    energies.clear()
    stuck = replace(settings, printable=lambda smp: design.rho > 0.5, rounds=15)  # noqa: ARG005
    polish_labels(equilibria, design, WEIGHTS, stuck, lambda at: None)  # noqa: ARG005
    assert len(energies) == polish.MOST_POOR
    for before, after in itertools.pairwise(energies):
        assert relative(before) == pytest.approx(polish.DEARER * relative(after))


@pytest.mark.parametrize(
    ("won", "change"), [(0.9, 1 / polish.CHEAPER), (0.61, 1 / polish.CHEAPER), (0.59, 1.0), (0.31, 1.0), (0.29, 3.0)]
)
def test_the_price_follows_what_rounds_win_of_what_they_promise(
    monkeypatch: pytest.MonkeyPatch, won: float, change: float
) -> None:
    problem = bar(degrees=30.0)
    equilibria, energies, promised = two_patches(problem), list[FlipEnergy](), list[float]()
    design = held_design(equilibria, upper_half(problem).astype(float), problem.X_temp)
    settle = Influence.after

    def after(self: Influence, flipped: np.ndarray) -> Settled:
        settled = settle(self, flipped)
        if len(energies) == 1:
            promised.append(settled.squared)
        return settled

    def evaluate(*_: object) -> float:
        if not promised:
            return 1.0
        unchanged, changed = max(promised), min(promised)
        return 1.0 - won * (unchanged - changed) / WEIGHTS.error_scale**2

    monkeypatch.setattr(Influence, "after", after)
    monkeypatch.setattr(polish, "evaluate", evaluate)
    monkeypatch.setattr(polish, "refit", lambda at, trial, *rest, **named: trial)  # noqa: ARG005
    settings = replace(recording(freely(problem), energies), rounds=2)
    polish_labels(equilibria, design, WEIGHTS, settings, lambda at: None)  # noqa: ARG005
    first, second = energies
    assert relative(second) == pytest.approx(change * relative(first))


def test_where_the_error_is_low_the_first_poor_round_ends_it() -> None:
    problem = bar(degrees=30.0)
    equilibria, energies = two_patches(problem), list[FlipEnergy]()
    design = held_design(equilibria, upper_half(problem).astype(float), problem.X_temp)
    stuck = replace(recording(freely(problem), energies), printable=lambda smp: design.rho > 0.5)  # noqa: ARG005
    rms = shape_error(problem, design.final.y).rms
    for low, rounds in ((1.01 * rms, 1), (0.99 * rms, polish.MOST_POOR)):
        energies.clear()
        polish_labels(equilibria, design, WEIGHTS, replace(stuck, low_rms=low), lambda at: None)  # noqa: ARG005
        assert len(energies) == rounds


def test_once_the_tolerance_is_met_flips_end_where_the_target_is_far(monkeypatch: pytest.MonkeyPatch) -> None:
    """Every round comes true, by a thirtieth of the error at first and by far more later."""
    problem = bar(degrees=30.0)
    equilibria, energies = two_patches(problem), list[FlipEnergy]()
    design = held_design(equilibria, upper_half(problem).astype(float), problem.X_temp)
    errors = np.r_[1.0, 0.97, 0.94, 0.91, 0.4, 0.03]
    settings = replace(recording(freely(problem), energies), target_rms=0.04)

    def rounds(tolerance: float) -> int:
        energies.clear()
        values, shown = iter(errors**2), iter(np.repeat(errors, 2)[1:])
        monkeypatch.setattr(polish, "evaluate", lambda *_: next(values))
        monkeypatch.setattr(polish, "shape_error", lambda *_: SimpleNamespace(rms=next(shown)))
        monkeypatch.setattr(polish, "refit", lambda at, trial, *rest, **named: trial)  # noqa: ARG005
        polish_labels(equilibria, design, WEIGHTS, replace(settings, tolerance=tolerance), lambda at: None)  # noqa: ARG005
        return len(energies)

    assert rounds(1.1) == polish.MOST_POOR
    assert rounds(0.5) == len(errors) - 1


def test_a_part_without_smp_is_left_as_it_is() -> None:
    """It comes back to its permanent shape wherever it is held, and has no interface."""
    problem = bar(degrees=30.0)
    equilibria = two_patches(problem)
    design = held_design(equilibria, np.zeros(problem.n_tets), problem.X_temp)
    same = polish_labels(equilibria, design, WEIGHTS, freely(problem), lambda at: None)  # noqa: ARG005
    assert not same.rho.any()


def test_what_comes_to_nothing_teaches(monkeypatch: pytest.MonkeyPatch) -> None:
    """The same flips are not tried twice where they raised the error."""
    problem = bar(degrees=30.0)
    equilibria, tried = two_patches(problem), []
    design = held_design(equilibria, upper_half(problem).astype(float), problem.X_temp)
    smp = design.rho > 0.5

    def worse(at: Equilibria, before: Design, rho: np.ndarray, *rest: object, **named: object) -> Design:  # noqa: ARG001
        tried.append(frozenset(np.flatnonzero((rho > 0.5) != smp)))
        return held_design(equilibria, rho, problem.body.X)

    monkeypatch.setattr(polish, "follow_density", worse)
    monkeypatch.setattr(polish, "refit", lambda at, trial, *rest, **named: trial)  # noqa: ARG005
    same = polish_labels(equilibria, design, WEIGHTS, freely(problem), lambda at: None)  # noqa: ARG005
    assert same is design
    assert 1 < len(tried) <= polish.MOST_POOR
    assert len(set(tried)) == len(tried)


def test_what_is_taught_is_what_flips_do_at_the_same_held_positions(monkeypatch: pytest.MonkeyPatch) -> None:
    """Though the held positions moved along with them."""
    problem = bar(cells=(6, 3, 2), degrees=40.0)
    equilibria, smp, seen = two_patches(problem), upper_half(problem), []
    design = held_design(equilibria, smp.astype(float), problem.X_temp)
    values, change, teach = iter([0.0, 1.0]), polish._changed, Influence.taught

    def changed(at: Equilibria, before: Design, labels: np.ndarray, weights: ObjectiveWeights, ahead: Ahead) -> Design:
        still = change(at, before, labels, weights, replace(ahead, moves=0 * ahead.moves))
        moved = change(at, before, labels, weights, ahead)
        assert moved is not None
        # Held positions that have moved on from where they were predicted are taken as they are.
        further = refit(at, moved, weights, lambda at: None)  # noqa: ARG005
        moves = held_positions(at, further.median) - held_positions(at, before.median)
        assert np.abs(moves - ahead.moves).max() > 0.1 * np.abs(moves).max()
        seen.append((still, moves.ravel()))
        return further

    def taught(self: Influence, flipped: np.ndarray, shape: np.ndarray, beyond: np.ndarray) -> Influence:
        still, moves = seen[-1]
        moved = np.linalg.norm(moves @ self.view.shape_by_held)
        assert moved > 0
        assert np.linalg.norm(shape - self.view.shape(problem, still.final.y)) < 0.7 * moved
        return teach(self, flipped, shape, beyond)

    monkeypatch.setattr(polish, "_changed", changed)
    monkeypatch.setattr(Influence, "taught", taught)
    monkeypatch.setattr(polish, "evaluate", lambda *_: next(values))
    monkeypatch.setattr(polish, "refit", lambda at, trial, *rest, **named: trial)  # noqa: ARG005
    polish_labels(equilibria, design, WEIGHTS, replace(freely(problem), rounds=1), lambda at: None)  # noqa: ARG005
    assert len(seen) == 1


def test_of_smaller_tets_more_are_candidates_for_less_each(monkeypatch: pytest.MonkeyPatch) -> None:
    """As if the bar's tets were four times as many as usual."""
    problem = bar(cells=(6, 3, 2), degrees=30.0)
    equilibria, energies = two_patches(problem), list[FlipEnergy]()
    design = held_design(equilibria, upper_half(problem).astype(float), problem.X_temp)
    monkeypatch.setattr(polish, "MOST_CANDIDATES", 10)
    for usual in (problem.n_tets, problem.n_tets / 4):
        monkeypatch.setattr(flips, "USUAL_TETS", usual)
        settings = replace(recording(freely(problem), energies), rounds=1)
        polish_labels(equilibria, design, WEIGHTS, settings, lambda at: None)  # noqa: ARG005
    usual, finer = energies
    assert (len(usual.tets), len(finer.tets)) == (10, 40)
    assert finer.price == pytest.approx(usual.price / 4)


def test_held_positions_move_along_with_flips() -> None:
    """The error after some flips is nearer to what a fit leaves of it than with the positions as they were."""
    problem = bar(cells=(6, 3, 2), degrees=40.0)
    equilibria, smp = two_patches(problem), upper_half(problem)
    before = held_design(equilibria, smp.astype(float), problem.X_temp)
    design = refit(equilibria, before, WEIGHTS, lambda at: None)  # noqa: ARG005
    found, labels = at_all_tets(equilibria, design), smp.copy()
    labels[np.flatnonzero(at_interface(problem, smp))[::4]] ^= True
    ahead = predicted(found, smp, labels)
    assert ahead.moves.shape == (2, 3)
    assert np.abs(ahead.moves).max() > 0
    none = replace(ahead, moves=np.zeros((2, 3)))
    still, moved = (polish._changed(equilibria, design, labels, WEIGHTS, each) for each in (none, ahead))
    assert still is not None
    assert moved is not None
    held = held_positions(equilibria, moved.median)
    np.testing.assert_allclose(held, held_positions(equilibria, design.median) + ahead.moves, atol=1e-9)
    fitted = refit(equilibria, still, WEIGHTS, lambda at: None)  # noqa: ARG005
    errors = [shape_error(problem, each.final.y).rms for each in (fitted, moved, still)]
    assert errors[1] - errors[0] < 0.3 * (errors[2] - errors[0])
