"""A relaxed design of linear tets, carried over to quadratic ones and rounded there."""

import itertools
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from bars import bar

from fab4d.design import finish
from fab4d.design.equilibria import Equilibria
from fab4d.design.finish import (
    FINER_MESH,
    MOST_HELD_BACK,
    OTHER_ELEMENTS,
    carried_in,
    carried_over,
    rounded_from,
)
from fab4d.design.forward import balance
from fab4d.design.gauss_newton import held_positions
from fab4d.design.objective import ObjectiveWeights, shape_error
from fab4d.design.patches import patches_from_faces
from fab4d.design.problem import Problem
from fab4d.design.reduced import LARGEST_DAMPING, Phase, ReducedSettings, Search, relaxed, undecided_fraction
from fab4d.design.turning import Turning
from fab4d.mesh.rigid import best_rigid_motion

TOLERANCE = 5e-3
WEIGHTS = ObjectiveWeights(error_scale=TOLERANCE, lam_SMP=0.05, lam_smooth=0.3)


@pytest.fixture(scope="module")
def found() -> Search:
    """A bar that wants to be bent by 40 degrees, relaxed in linear tets."""
    problem = bar(degrees=40.0)
    return relaxed(problem, settings_for(problem), lambda at: None)  # noqa: ARG005


@pytest.fixture(scope="module")
def quadratic() -> Problem:
    return bar(degrees=40.0, element="quadratic")


def settings_for(problem: Problem) -> ReducedSettings:
    return ReducedSettings(4, (6.0 / problem.length,), WEIGHTS)


def test_what_is_carried_over_is_in_equilibrium_at_the_same_hold_positions(found: Search, quadratic: Problem) -> None:
    patches, design = found.equilibria.patches, found.design
    equilibria = Equilibria(quadratic, patches_from_faces(quadratic, patches.centers, patches.faces, patches.offsets))
    median, y = design.median, design.final.y
    there = carried_over(equilibria, design.rho, median.x, y, median.forces)
    assert there is not None
    left = balance(equilibria, there.rho, there.median, there.final)
    assert max(left.median, left.final) < 1e-4
    # The mean of a patch weighs the mid-edge nodes of a bent surface, so that it moves a little.
    before, after = held_positions(found.equilibria, median), held_positions(equilibria, there.median)
    np.testing.assert_allclose(after, before, atol=1e-3)
    again = carried_over(equilibria, design.rho, there.median.x, there.final.y, there.median.forces)
    assert again is not None
    np.testing.assert_allclose(again.median.x, there.median.x, atol=1e-6)


def test_a_final_shape_that_cannot_be_repeated_is_a_guess_as_it_is(
    found: Search, quadratic: Problem, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Where the median's change, repeated on the final shape, would turn tets over."""
    patches, design = found.equilibria.patches, found.design
    equilibria = Equilibria(quadratic, patches_from_faces(quadratic, patches.centers, patches.faces, patches.offsets))
    usual = carried_over(equilibria, design.rho, design.median.x, design.final.y, design.median.forces)
    monkeypatch.setattr(Turning, "repeat", lambda _self, _before, after, _x: after * [1.0, 1.0, -1.0])
    mended = carried_over(equilibria, design.rho, design.median.x, design.final.y, design.median.forces)
    assert usual is not None
    assert mended is not None
    np.testing.assert_allclose(mended.median.x, usual.median.x, atol=1e-5)
    np.testing.assert_allclose(mended.final.y, moved_rigidly(mended.final.y, usual.final.y), atol=1e-4)


def moved_rigidly(onto: np.ndarray, y: np.ndarray) -> np.ndarray:
    R, t = best_rigid_motion(y, onto)
    return y @ R.T + t


def test_a_design_is_rounded_in_the_other_elements(found: Search, quadratic: Problem) -> None:
    shown: list[tuple[str, Search]] = []
    carried = carried_in(quadratic, found)
    assert carried is not None
    at = rounded_from(carried, settings_for(quadratic), lambda phase, at: shown.append((phase, at)), OTHER_ELEMENTS)
    assert at is not None
    assert at.phase is Phase.DONE
    assert len(at.design.median.x) == quadratic.n_nodes
    assert undecided_fraction(at.design.rho) <= settings_for(quadratic).undecided_fraction
    assert shape_error(quadratic, at.design.final.y).rms < TOLERANCE
    assert [phase for phase, _ in shown][:2] == ["carried over", "relax"]
    shares = [undecided_fraction(state.design.rho) for _, state in shown]
    assert shares[0] > 0.5


def test_without_an_equilibrium_nothing_is_rounded(found: Search) -> None:
    """The wanted shape of another body: its tets are upside down there."""
    mirrored = bar(degrees=40.0, element="quadratic")
    far = found.design.median.x * [1.0, 1.0, -1.0]
    patches = found.equilibria.patches
    equilibria = Equilibria(mirrored, patches_from_faces(mirrored, patches.centers, patches.faces, patches.offsets))
    assert carried_over(equilibria, found.design.rho, far, far, found.design.median.forces) is None


@pytest.fixture
def all_steps_hard(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(finish, "_is_hard", lambda _: True)
    monkeypatch.setattr(finish, "MOST_HELD_BACK", 100)


@pytest.mark.usefixtures("all_steps_hard")
def test_the_last_few_tets_are_decided_by_and_by_where_steps_are_hard(found: Search, quadratic: Problem) -> None:
    """As soon as a step leaves few of them: all states before it leave more."""
    shown: list[Search] = []
    carried = carried_in(quadratic, found)
    assert carried is not None
    how = replace(OTHER_ELEMENTS, most_left=0.1)
    at = rounded_from(carried, settings_for(quadratic), lambda _, at: shown.append(at), how)
    assert at is shown[-1]
    shares = [undecided_fraction(state.design.rho) for state in shown]
    first = next(k for k, share in enumerate(shares) if share <= how.most_left)
    by_and_by = shares[first + 1 :]
    assert shares[first] > by_and_by[0]
    assert by_and_by == sorted(by_and_by, reverse=True)
    assert by_and_by[-1] == 0
    assert shape_error(quadratic, at.design.final.y).rms < TOLERANCE


@pytest.mark.usefixtures("all_steps_hard")
def test_rounding_goes_on_where_the_last_few_tets_cannot_be_decided(
    found: Search, quadratic: Problem, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked = []
    monkeypatch.setattr(finish, "decided_by_and_by", lambda *_: asked.append(1))
    carried = carried_in(quadratic, found)
    assert carried is not None
    at = rounded_from(carried, settings_for(quadratic), lambda *_: None, OTHER_ELEMENTS)
    assert len(asked) == 1
    assert at is not None
    assert set(np.unique(np.round(at.design.rho, 2))) == {0.0, 1.0}


@pytest.mark.parametrize("hard", [[False], [True, False]])
def test_tets_are_not_decided_by_and_by_where_steps_lead_on(
    found: Search, quadratic: Problem, monkeypatch: pytest.MonkeyPatch, hard: list[bool]
) -> None:
    """Single hard steps are none in a row."""
    steps = itertools.cycle(hard)
    monkeypatch.setattr(finish, "_is_hard", lambda _: next(steps))
    monkeypatch.setattr(finish, "MOST_HELD_BACK", 100)
    monkeypatch.setattr(finish, "decided_by_and_by", lambda *_: pytest.fail("decided"))
    carried = carried_in(quadratic, found)
    assert carried is not None
    assert rounded_from(carried, settings_for(quadratic), lambda *_: None, OTHER_ELEMENTS) is not None


def test_what_hard_steps_leave_undecided_is_decided_by_and_by_whatever_its_share(
    found: Search, quadratic: Problem, monkeypatch: pytest.MonkeyPatch
) -> None:
    """After the first step of the rounding, which leaves more than what may be decided so while steps lead on."""
    for name, value in (("_is_hard", lambda _: True), ("MOST_HELD_BACK", 1), ("LITTLE_DECIDED", 0.0)):
        monkeypatch.setattr(finish, name, value)
    carried, settings = carried_in(quadratic, found), settings_for(quadratic)
    assert carried is not None
    shown: list[Search] = []

    def show(phase: str, at: Search) -> None:
        if phase == Phase.ROUND.value:
            shown.append(at)

    at = rounded_from(carried, settings, show, replace(OTHER_ELEMENTS, most_left=0.05))
    assert undecided_fraction(shown[0].design.rho) > 0.05
    assert at is shown[-1]
    assert undecided_fraction(at.design.rho) <= settings.undecided_fraction
    assert shape_error(quadratic, at.design.final.y).rms < TOLERANCE


@pytest.mark.parametrize(("share_left", "ends"), [(0.95, True), (0.8, False)])
def test_hard_steps_that_decide_little_end_the_rounding(
    found: Search, quadratic: Problem, monkeypatch: pytest.MonkeyPatch, share_left: float, ends: bool
) -> None:
    """Those that leave a smaller share of the undecided tets go on."""
    made = []

    def round_step(at: Search, *_: object) -> Search:
        made.append(1)
        rho = at.design.rho.copy()
        left = np.flatnonzero((rho > 0) & (rho < 1))
        rho[left[: max(int((1 - share_left) * len(left)), 1)]] = 1.0
        last = Phase.DONE if len(left) < 30 else Phase.ROUND
        return replace(at, design=replace(at.design, rho=rho), accepted=True, damping=LARGEST_DAMPING, phase=last)

    carried = carried_in(quadratic, found)
    assert carried is not None
    carried = replace(carried, design=replace(carried.design, rho=np.full(quadratic.n_tets, 0.5)))
    monkeypatch.setattr(
        finish, "STEPS", {Phase.RELAX: lambda at, *_: replace(at, phase=Phase.ROUND), Phase.ROUND: round_step}
    )
    rounded_from(carried, settings_for(quadratic), lambda *_: None, OTHER_ELEMENTS)
    assert (len(made) == MOST_HELD_BACK) == ends


@pytest.mark.parametrize(("ratio", "again"), [(0.9, False), (0.3, False), (0.1, True)])
def test_relaxing_goes_on_clear_of_unstable_states_where_it_comes_near_them(
    found: Search, quadratic: Problem, monkeypatch: pytest.MonkeyPatch, ratio: float, again: bool
) -> None:
    """Once: there it may be held, and rounding follows. Not far from them, rounding keeps clear at least."""
    made = list[tuple[Phase, int, float]]()

    def step(at: Search, settings: ReducedSettings, _: object) -> Search:
        made.append((at.phase, at.iteration, settings.weights.lam_stable))
        assert len(made) < 10
        return replace(at, phase=Phase.ROUND if at.phase is Phase.RELAX else Phase.DONE, iteration=7)

    monkeypatch.setattr(finish, "STEPS", {Phase.RELAX: step, Phase.ROUND: step})
    monkeypatch.setattr(finish, "least_ratio", lambda *_: ratio)
    monkeypatch.setattr(finish, "decided_by_and_by", lambda *_: None)
    carried = carried_in(quadratic, found)
    assert carried is not None
    rounded_from(carried, settings_for(quadratic), lambda *_: None, replace(OTHER_ELEMENTS, most_left=0.0))
    relaxed = [(Phase.RELAX, 0, 0.0), *([(Phase.RELAX, 0, finish.LAM_STABLE)] if again else [])]
    assert made == [*relaxed, (Phase.ROUND, 7, 0.0 if ratio > finish.SOFT else finish.LAM_STABLE)]


@pytest.mark.parametrize("relaxing", [1, 2])
def test_clear_of_unstable_states_all_tets_are_decided_by_and_by_at_once(
    found: Search, quadratic: Problem, monkeypatch: pytest.MonkeyPatch, relaxing: int
) -> None:
    """Also where more are left than may be elsewhere."""
    carried, shares, phases = carried_in(quadratic, found), list[float](), list[str]()
    assert carried is not None
    real = finish.decided_by_and_by

    def watched(at: Search, settings: ReducedSettings, watch: Callable[[Search], None]) -> Search | None:
        shares.append(undecided_fraction(at.design.rho))
        assert settings.weights.lam_stable == finish.LAM_STABLE
        assert phases == ["carried over"] + 2 * relaxing * ["relax"]
        return real(at, settings, watch)

    monkeypatch.setattr(finish, "decided_by_and_by", watched)
    monkeypatch.setattr(finish, "least_ratio", lambda *_: 0.1)
    how = replace(FINER_MESH, relax_iterations=relaxing, most_left=0.05)
    at = rounded_from(carried, settings_for(quadratic), lambda phase, _: phases.append(phase), how)
    assert len(shares) == 1
    assert shares[0] > 0.1
    assert at is not None
    assert undecided_fraction(at.design.rho) == 0
