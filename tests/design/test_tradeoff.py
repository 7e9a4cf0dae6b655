"""The bisection on lam_SMP, the Pareto front, and designs at other prices of SMP."""

import numpy as np
import pytest
from bars import bar
from hypothesis import given
from hypothesis import strategies as st

from fab4d.design.objective import ObjectiveWeights
from fab4d.design.reduced import Phase, ReducedSettings, Search, relaxed
from fab4d.design.tradeoff import (
    FAILURES_TO_CLOSE,
    LEAST_CHANGE,
    MOST_TRIALS,
    Trial,
    least,
    nearest,
    next_price,
    pareto_front,
    search_at,
    way_to,
)


def share(price: float) -> float:
    """A share of SMP that falls with its price."""
    return 1 / (1 + price)


def trials_of(accept: set[int] | None = None, limit: float = np.inf) -> list[Trial]:
    """The trials from price 1 on, acceptable up to `limit` or by their number."""
    trials, price = [], 1.0
    while price is not None:
        fine = len(trials) in accept if accept is not None else price <= limit
        trials.append(Trial(price, share(price), fine))
        price = next_price(trials)
    return trials


@given(st.floats(1, 30))
def test_the_bisection_ends_near_the_dearest_acceptable_price(limit: float) -> None:
    trials = trials_of(limit=limit)
    found, steps = trials[least(trials)].lam_SMP, len(trials)
    assert found <= limit
    doubled = 2 ** np.floor(np.log2(limit))
    halvings = steps - 1 - int(np.log2(doubled)) - FAILURES_TO_CLOSE
    assert limit / found <= max(2**0.5 ** max(halvings, 0), 1 + 3 * LEAST_CHANGE) * (1 + 1e-9)
    assert steps <= MOST_TRIALS


def test_one_price_that_fails_by_bad_luck_does_not_end_the_search() -> None:
    trials = trials_of(accept={0, 2})
    assert [trial.lam_SMP for trial in trials[:5]] == [1, 2, 4, 8, 16]
    assert least(trials) == 2


def test_without_an_acceptable_design_nothing_is_tried() -> None:
    assert len(trials_of(accept=set())) == 1
    with pytest.raises(ValueError, match="empty"):
        least(trials_of(accept=set()))


def test_a_design_without_smp_ends_the_search() -> None:
    assert next_price([Trial(1.0, 0.3, True), Trial(2.0, 0.0, True)]) is None


def test_a_bracket_that_saves_nothing_ends_the_search() -> None:
    tried = [Trial(1.0, 0.3, True), Trial(2.0, 0.295, False), Trial(4.0, 0.1, False)]
    assert next_price(tried) is None
    assert next_price([tried[0], Trial(2.0, 0.2, False), tried[2]]) == pytest.approx(2**0.5)


@given(st.floats(1e-2, 1e2))
def test_the_way_to_a_price_is_made_of_doublings_or_halvings(price: float) -> None:
    way = way_to(price)
    assert (way[0], way[-1]) == (1, price)
    ratios = np.array(way[1:]) / np.array(way[:-1])
    assert set(ratios[:-1]) <= {2.0 if price > 1 else 0.5}
    assert all(0.5 <= ratio <= 2 for ratio in ratios)
    assert len(way) == 1 + np.ceil(abs(np.log2(price)))


@given(st.floats(1e-3, 1e3))
def test_nearest_goes_by_the_ratio(price: float) -> None:
    prices = [0.5, 2.0, 8.0]
    ratios = [max(price / p, p / price) for p in prices]
    assert ratios[nearest(prices, price)] == pytest.approx(min(ratios))


@given(st.lists(st.tuples(st.integers(0, 5), st.integers(0, 5)), min_size=1, max_size=12))
def test_the_pareto_front_is_what_nothing_beats(designs: list[tuple[int, int]]) -> None:
    cost, error = np.array(designs, float).T
    beaten = [any(c <= a and e <= b and (c, e) != (a, b) for c, e in designs) for a, b in designs]
    np.testing.assert_array_equal(pareto_front(cost, error), ~np.array(beaten))


def test_dearer_smp_is_used_less_and_the_way_there_is_short() -> None:
    problem = bar(degrees=30.0)
    weights = ObjectiveWeights(error_scale=3e-3, lam_SMP=0.05, lam_smooth=0.3)
    settings = ReducedSettings(4, (6.0 / problem.length,), weights)
    first: list[Search] = []
    start = relaxed(problem, settings, first.append)
    states: list[Search] = []
    at_price, found = search_at(problem, settings, start, 2 * weights.lam_SMP, states.append)
    assert (at_price.phase, at_price.lam_SMP, found.phase) == (Phase.ROUND, 2 * weights.lam_SMP, Phase.DONE)
    assert problem.volume_fractions @ at_price.design.rho < problem.volume_fractions @ start.design.rho
    assert 0 < sum(at.phase is Phase.RELAX for at in states) + 1 <= len(first)
