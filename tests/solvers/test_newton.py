"""Newton away from saddle points: a chain of double wells, whose minima are known."""

import sys

import numpy as np
import pytest

from fab4d.solvers.linear import Factor, analyse
from fab4d.solvers.negative_modes import descending
from fab4d.solvers.newton import Residual, Status, newton

N = 40
STIFFNESS = 300.0
INDPTR = np.r_[np.arange(0, 2 * N, 2), 2 * N - 1]
INDICES = np.column_stack([np.arange(N), np.arange(1, N + 1)]).ravel()[: 2 * N - 1]


def wells(z: np.ndarray) -> Residual:
    """Springs between neighbours and a double well with minima -1 and 1 at each: E = 0 there, N/4 on the saddle 0."""
    stretch = STIFFNESS * np.diff(z)
    r = z**3 - z
    r[1:] += stretch
    r[:-1] -= stretch
    return Residual(r, 1.0, float((stretch**2).sum() / (2 * STIFFNESS) + ((z**2 - 1) ** 2).sum() / 4))


def tangent(z: np.ndarray) -> Factor:
    data = np.zeros(2 * N - 1)
    data[::2] = 3 * z**2 - 1 + STIFFNESS * np.r_[1.0, np.full(N - 2, 2.0), 1.0]
    data[1::2] = -STIFFNESS
    return analyse(INDPTR, INDICES).factor(data)


def no_fallback(z: np.ndarray) -> Factor:
    raise AssertionError(z)


@pytest.fixture
def near_saddle() -> np.ndarray:
    """Close to the saddle: an undulation that the springs flatten, and a little of the one unstable mode."""
    return 0.02 * np.cos(np.arange(N)) + 1e-3


def test_leaves_a_saddle_for_the_minimum(near_saddle):
    assert tangent(near_saddle).n_negative == 1
    found = newton(wells, tangent, near_saddle, 1e-10, 20, no_fallback)
    assert found.converged
    assert np.allclose(found.z, 1.0)
    assert found.iterations <= 15


def test_ends_on_the_saddle_without_a_fallback(near_saddle):
    found = newton(wells, tangent, near_saddle, 1e-10, 20)
    assert found.converged
    assert np.allclose(found.z, 0.0, atol=1e-8)


def test_stays_where_it_is_when_told_to():
    found = newton(wells, tangent, np.full(N, 1e-6), 1e-10, 20, no_fallback, stay=True)
    assert found.status is Status.UNSTABLE
    assert found.iterations == 1
    assert np.abs(found.z).max() < 1e-4


def test_an_unstable_guess_may_lead_to_a_stable_state_when_staying():
    """If it is stable one step on."""
    start = np.full(N, 0.5)
    assert tangent(start).n_negative == 1
    found = newton(wells, tangent, start, 1e-10, 20, no_fallback, stay=True)
    assert found.converged
    assert np.allclose(found.z, 1.0)


@pytest.mark.parametrize(("slow", "status", "iterations"), [(5, Status.CONVERGED, None), (7, Status.UNSTABLE, 1)])
def test_staying_goes_on_while_steps_halve_what_is_unstable(
    monkeypatch: pytest.MonkeyPatch, slow: int, status: Status, iterations: int | None
) -> None:
    """Wells of their own: 12 unstable ones, of which some are stable after two steps, the others after one."""
    monkeypatch.setattr(sys.modules[__name__], "STIFFNESS", 1e-9)
    start = np.full(N, 0.9)
    start[:12] = 0.45
    start[:slow] = 0.2
    assert tangent(start).n_negative == 12

    def spd(z: np.ndarray) -> Factor:
        data = np.zeros(2 * N - 1)
        data[::2] = np.abs(3 * z**2 - 1)
        return analyse(INDPTR, INDICES).factor(data)

    found = newton(wells, tangent, start, 1e-8, 20, spd, stay=True)
    assert found.status is status
    if iterations is None:
        assert np.allclose(found.z, 1.0, atol=1e-6)
    else:
        assert found.iterations == iterations


def test_a_stable_state_is_found_when_staying():
    found = newton(wells, tangent, np.full(N, 0.9), 1e-10, 20, no_fallback, stay=True)
    assert found.converged
    assert np.allclose(found.z, 1.0)


def test_the_step_is_reversed_along_the_unstable_mode_alone(near_saddle):
    factor, load = tangent(np.zeros(N)), wells(near_saddle).r
    step = -factor.solve(load)
    mode = np.full(N, 1 / np.sqrt(N))
    expected = step - 2 * (mode @ step) * mode
    assert np.allclose(descending(factor, step, N, 1), expected, rtol=1e-3, atol=1e-8)


def test_many_negative_modes_are_left_to_the_fallback():
    assert descending(tangent(np.zeros(N)), np.ones(N), N, N) is None


class Counted:
    """The tangent, and how often it was factored."""

    def __init__(self) -> None:
        self.count = 0

    def __call__(self, z: np.ndarray) -> Factor:
        self.count += 1
        return tangent(z)


def test_the_factor_of_a_state_nearby_is_enough():
    start, factor = np.full(N, 0.99), Counted()
    found = newton(wells, factor, start, 1e-10, 20, no_fallback, near=tangent(start))
    assert found.converged
    assert np.allclose(found.z, 1.0)
    assert factor.count == found.iterations == 0


def test_a_factor_that_brings_little_is_replaced():
    """The wells are 25 times as stiff at 1 as at 0.6: steps with the factor of there would go far too far."""
    factor = Counted()
    start, far = np.full(N, 0.82), np.full(N, 0.6)
    found = newton(wells, factor, start, 1e-10, 20, no_fallback, near=tangent(far))
    assert found.converged
    assert np.allclose(found.z, 1.0)
    assert factor.count == found.iterations >= 1


def test_no_step_leads_on_from_outside_the_domain():
    """Inverted elements, say: neither with the factor of a state nearby, which must not be tried for ever, nor else."""
    seen, factor, start = [], Counted(), np.full(N, 3.0)

    def within(z: np.ndarray) -> Residual:
        seen.append(z)
        assert len(seen) < 100
        return wells(z) if np.abs(z).max() < 2 else Residual(np.full(N, np.inf), 1.0, np.inf)

    for near in (None, tangent(start)):
        assert newton(within, factor, start, 1e-10, 20, near=near).status is Status.NO_STEP
    assert factor.count == 0


def test_an_unstable_factor_is_not_used(near_saddle):
    """With it alone the steps would end on the saddle."""
    unstable = tangent(np.zeros(N))
    assert unstable.n_negative == 1
    found = newton(wells, tangent, near_saddle, 1e-10, 20, no_fallback, near=unstable)
    assert np.allclose(found.z, 1.0)
    assert np.allclose(newton(wells, tangent, near_saddle, 1e-10, 20, near=unstable).z, 0.0, atol=1e-8)


def test_factors_are_used_again_between_iterations():
    factor = Counted()
    found = newton(wells, factor, np.full(N, 0.9), 1e-12, 20, no_fallback)
    assert found.converged
    assert factor.count < 4  # Newton's method alone needs 5


def test_ends_where_rounding_leaves_nothing_to_gain():
    """The residual is known to ten decimals: one more factor shows that the next will not lower it."""
    made = []

    def counted(z: np.ndarray) -> Factor:
        made.append(z)
        return tangent(z)

    def rounded(z: np.ndarray) -> Residual:
        exact = wells(z)
        return Residual(np.round(exact.r + 0.3e-10, 10) - 0.3e-10, exact.scale, exact.potential)

    enough = newton(rounded, counted, np.full(N, 1.1), 1e-9, 20)
    needed = len(made)
    found = newton(rounded, counted, np.full(N, 1.1), 1e-13, 20)
    assert enough.converged
    assert found.status is Status.ROUNDING
    assert found.residual < 1e-9
    assert np.allclose(found.z, 1.0, atol=1e-9)
    assert len(made) - needed <= needed + 2
