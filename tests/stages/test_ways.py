"""Ways from a relaxed design to labels that can be printed."""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import pytest
from designed_bar import PROFILE, Artifacts, designed_bar, fit_of, relaxed_design, rms

from fab4d.design import reduced
from fab4d.design.equilibria import RIG_COMPLIANCE, Equilibria
from fab4d.design.flips import at_interface
from fab4d.design.gauss_newton import Design
from fab4d.design.paths import change_density, follow_density
from fab4d.design.problem import Problem
from fab4d.design.reduced import refit
from fab4d.errors import EquilibriumError
from fab4d.mesh.rigid import best_rigid_motion
from fab4d.mesh.tetmesh import BoolArray
from fab4d.stages import _ways
from fab4d.stages._bring_up import OUT_OF_REACH
from fab4d.stages._design import patches_of, problem_of


@pytest.fixture(scope="module")
def inputs() -> Artifacts:
    return designed_bar()


def test_labels_of_many_tets_are_solved_for_at_once(inputs: Artifacts, monkeypatch: pytest.MonkeyPatch) -> None:
    """They end in the state that the path of equilibria from the relaxed design leads to, without flips on it."""
    equilibria, weights, settings = fit_of(inputs)
    smp = inputs["rounded"]["smp"]
    given = (equilibria, inputs["relaxed"], smp, weights, settings)
    monkeypatch.setattr(_ways, "influence_near", lambda *_: None)
    by_path = next(_ways.ways_to_print(*given)).design

    def not_taken(*_: Any) -> Design:
        raise AssertionError

    monkeypatch.setattr(_ways, "MANY_TETS", 1)
    for path in ("change_density", "follow_density"):
        monkeypatch.setattr(_ways, path, not_taken)
    at_once = next(_ways.ways_to_print(*given)).design
    np.testing.assert_allclose(at_once.median.x, by_path.median.x, atol=1e-5)
    R, t = best_rigid_motion(at_once.final.y, by_path.final.y)
    np.testing.assert_allclose(at_once.final.y @ R.T + t, by_path.final.y, atol=1e-5)


@pytest.mark.parametrize("element", ["linear", "quadratic"])
@pytest.mark.parametrize("many", [1, 1_000_000])
def test_a_design_without_an_equilibrium_is_loaded_from_rest(
    inputs: Artifacts, monkeypatch: pytest.MonkeyPatch, element: str, many: int
) -> None:
    """Also one of other elements than these."""
    problem = problem_of(inputs["mesh"], PROFILE["materials"], element)
    equilibria, smp = Equilibria(problem, patches_of(problem, inputs["relaxed"])), inputs["rounded"]["smp"]
    _, weights, settings = fit_of(inputs)
    monkeypatch.setattr(_ways, "carried_over", lambda *_: None)
    monkeypatch.setattr(_ways, "MANY_TETS", many)
    (printed,) = _ways.ways_to_print(equilibria, inputs["relaxed"], smp, weights, settings)
    np.testing.assert_array_equal(printed.design.rho, smp)
    median = printed.design.median
    held = equilibria.patches.mean(median.x) + RIG_COMPLIANCE * median.forces
    linear, _, _ = fit_of(inputs)
    x, forces = inputs["relaxed"]["x"] / problem.length, inputs["relaxed"]["patch_force"] / problem.force
    x = x if len(x) == linear.problem.n_nodes else x[: linear.problem.n_nodes]
    aim = linear.patches.mean(x) + RIG_COMPLIANCE * forces
    np.testing.assert_allclose(held, aim, atol=2e-3)


@pytest.mark.parametrize(("beyond", "ways"), [(0.99, [False, False, False, True]), (1.01, [False])])
def test_of_a_design_that_is_out_of_reach_one_way_to_printable_labels_is_tried(
    inputs: Artifacts, monkeypatch: pytest.MonkeyPatch, beyond: float, ways: list[bool]
) -> None:
    """Without small steps, which take minutes; loading from rest ends with labels too."""
    equilibria, weights, settings = fit_of(inputs)
    rounded, smp = rms(equilibria.problem, relaxed_design(equilibria, inputs)), inputs["rounded"]["smp"]
    relaxed_rms = np.array(2 * rounded * equilibria.problem.length)
    settings = replace(settings, tolerance=rounded / (beyond * OUT_OF_REACH))
    asked = list[bool]()

    def followed(*_: Any, patient: bool = False) -> None:
        asked.append(patient)

    labels = [smp.copy(), smp.copy()]
    for k, each in enumerate(labels):
        each[np.flatnonzero(at_interface(equilibria.problem, smp))[k]] ^= True
    monkeypatch.setattr(_ways, "_followed", followed)
    monkeypatch.setattr(_ways, "_repairs", lambda *_: [*labels, smp])
    given = inputs["relaxed"] | {"relaxed_rms": relaxed_rms}
    (printed,) = _ways.ways_to_print(equilibria, given, smp, weights, settings)
    np.testing.assert_array_equal(printed.design.rho, smp)
    assert asked == ways


def test_labels_that_are_hard_to_come_to_are_looked_for_patiently(
    inputs: Artifacts, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Only where no candidate is found at once; where loading from rest ends if there is no path at all."""
    equilibria, weights, settings = fit_of(inputs)
    problem = equilibria.problem
    smp = inputs["rounded"]["smp"]
    asked: list[bool] = []

    def found_by(patient_or_not: set[bool]) -> Design:
        asked.clear()

        def quickly(*given: Any) -> Design:
            return asked_for(False, follow_density, *given)

        def patient(*given: Any, stay: bool) -> Design:
            assert not stay
            return asked_for(True, partial(change_density, stay=stay), *given)

        def asked_for(patience: bool, follow: Callable[..., Design], *given: Any) -> Design:
            asked.append(patience)
            if patience not in patient_or_not:
                msg = "none"
                raise EquilibriumError(msg)
            return follow(*given)

        monkeypatch.setattr(_ways, "follow_density", quickly)
        monkeypatch.setattr(_ways, "change_density", patient)
        return next(_ways.ways_to_print(equilibria, inputs["relaxed"], smp, weights, settings)).design

    at_once = found_by({False, True})
    assert not any(asked)
    patiently = found_by({True})
    assert asked[-1]
    assert not any(asked[:-1])
    by_loading = found_by(set())
    for each in (patiently, by_loading):
        np.testing.assert_array_equal(each.rho, smp)
    assert set(np.unique(at_once.rho)) == {0.0, 1.0}
    assert rms(problem, by_loading) < 2 * rms(problem, patiently)


def test_other_flips_make_up_for_the_repair(inputs: Artifacts) -> None:
    """Of labels that were spoilt: what is printed comes nearer than they do, or is they where flips mislead."""
    equilibria, weights, settings = fit_of(inputs)
    # Spoilt labels squeeze so coarse a bar: fits would keep from that more than they lower the error.
    problem, weights = equilibria.problem, weights.replace(lam_squeeze=0.0)
    spoilt = inputs["rounded"]["smp"].copy()
    spoilt[np.flatnonzero(at_interface(problem, spoilt))[::12]] ^= True
    before = relaxed_design(equilibria, inputs)
    as_they_are = change_density(equilibria, before, spoilt.astype(np.float64))
    printed = next(_ways.ways_to_print(equilibria, inputs["relaxed"], spoilt, weights, settings)).design
    fits = [refit(equilibria, each, weights, lambda at: None) for each in (as_they_are, printed)]  # noqa: ARG005
    # Fits of the same labels end as near to each other as a fit ends to the best held positions.
    unchanged = np.array_equal(printed.rho, as_they_are.rho)
    assert rms(problem, fits[1]) <= (1 + reduced.SLOW_REFIT * unchanged) * rms(problem, fits[0])


def test_labels_are_mended_otherwise_where_their_repair_costs_much(
    inputs: Artifacts, monkeypatch: pytest.MonkeyPatch
) -> None:
    """And taken where they come nearer; not looked for where the error is small enough."""
    equilibria, weights, settings = fit_of(inputs)
    problem = equilibria.problem
    settings = replace(settings, printable=lambda smp: smp)
    enough, never = replace(settings, target_rms=1.0), replace(settings, target_rms=0.0)
    monkeypatch.setattr(_ways, "compensated", lambda problem, flips, before, smp, settings: smp)  # noqa: ARG005
    monkeypatch.setattr(_ways, "error_left", lambda *_: 0.0)  # all promise enough
    labels = [inputs["rounded"]["smp"], inputs["rounded"]["smp"].copy()]
    labels[1][np.flatnonzero(at_interface(problem, labels[0]))[::2]] ^= True
    made = [next(_ways.ways_to_print(equilibria, inputs["relaxed"], smp, weights, enough)) for smp in labels]
    best, worst = np.argsort([rms(problem, each.fitted) for each in made])
    asked: list[BoolArray] = []

    def mended(problem: Problem, flips: Any, before: BoolArray, settings: Any) -> BoolArray:  # noqa: ARG001
        asked.append(before)
        return labels[best]

    monkeypatch.setattr(_ways, "mended", mended)
    for target, taken in ((enough, worst), (never, best)):
        printed = next(_ways.ways_to_print(equilibria, inputs["relaxed"], labels[worst], weights, target))
        np.testing.assert_array_equal(printed.design.rho > 0.5, labels[taken])
        assert bool(asked) == (target is never)
    monkeypatch.setattr(_ways, "mended", lambda *_: labels[worst])
    same = next(_ways.ways_to_print(equilibria, inputs["relaxed"], labels[worst], weights, never))
    np.testing.assert_array_equal(same.design.rho > 0.5, labels[worst])


def test_other_ways_to_printable_labels_are_left_out_where_flips_reach_the_goal(
    inputs: Artifacts, monkeypatch: pytest.MonkeyPatch
) -> None:
    """And so are those that lead to the same labels as one before."""
    equilibria, weights, settings = fit_of(inputs)
    problem = equilibria.problem
    smp = inputs["rounded"]["smp"]
    other = smp.copy()
    other[np.flatnonzero(at_interface(problem, smp))[0]] ^= True
    third = smp.copy()
    third[np.flatnonzero(at_interface(problem, smp))[1]] ^= True
    before = relaxed_design(equilibria, inputs)
    design = change_density(equilibria, before, other.astype(np.float64))
    tried: list[BoolArray] = []

    def followed(*given: Any) -> _ways.Way:
        _at, _before, labels, _weights, ahead = given
        assert np.abs(ahead.moves).max() > 0
        tried.append(labels)
        return _ways.Way(design, design)

    monkeypatch.setattr(_ways, "compensated", lambda *_: other)
    monkeypatch.setattr(_ways, "error_left", lambda *_: 0.0)  # all promise as much
    monkeypatch.setattr(_ways, "_followed", followed)
    for share, last, ways in (
        (1.001, third, [other]),
        (0.999, third, [other, third, smp]),
        (0.999, other, [other, smp]),
    ):
        monkeypatch.setattr(_ways, "mended", lambda *_, labels=last: labels)
        tried.clear()
        target = share * rms(problem, design) / _ways.WITHIN_REACH
        next(_ways.ways_to_print(equilibria, inputs["relaxed"], smp, weights, replace(settings, target_rms=target)))
        assert len(tried) == len(ways)
        assert all(np.array_equal(got, way) for got, way in zip(tried, ways, strict=True))


@pytest.mark.parametrize(
    ("promises", "ways"),
    [
        ((0.95, 1.01, 0.99), [0, 2]),
        ((0.95, 0.99, 0.97), [0, 1, 2]),
        ((0.5, 1.11 * 0.5, 1.09 * 0.5), [0, 2]),
        ((0.6, 0.55, 1.11 * 0.55), [0, 1]),
        ((0.95, 3.5, 1.01), [0, 1]),
        ((0.49, 1.2 * 0.49, 1.3 * 0.49), [0, 1, 2]),
    ],
)
def test_labels_that_are_predicted_to_be_no_better_than_what_was_found_are_not_followed(
    inputs: Artifacts, monkeypatch: pytest.MonkeyPatch, promises: tuple[float, ...], ways: list[int]
) -> None:
    """Nor those predicted to be clearly worse than the best that was followed, unless more than twice of what was
    predicted came of that. All come to 1, which is too much.

    Of few tets all are, and so are those of which more is predicted than can be true.
    """
    equilibria, weights, settings = fit_of(inputs)
    smp = inputs["rounded"]["smp"]
    labels = [smp.copy(), smp.copy(), smp]
    for k in (0, 1):
        labels[k][np.flatnonzero(at_interface(equilibria.problem, smp))[k]] ^= True
    before = relaxed_design(equilibria, inputs)
    printed = _ways.Way(before, before)
    tried: list[int] = []

    def number(some: BoolArray) -> int:
        return next(k for k, each in enumerate(labels) if np.array_equal(each, some))

    def followed(_: Equilibria, __: Design, some: BoolArray, *___: Any) -> _ways.Way:
        tried.append(number(some))
        return printed

    monkeypatch.setattr(_ways, "compensated", lambda *_: labels[0])
    monkeypatch.setattr(_ways, "mended", lambda *_: labels[1])
    monkeypatch.setattr(
        _ways, "error_left", lambda _, __, some: rms(equilibria.problem, before) * promises[number(some)]
    )
    monkeypatch.setattr(_ways, "_followed", followed)
    never = replace(settings, target_rms=0.0)
    for few, expected in ((0, ways), (equilibria.problem.n_tets, [0, 1, 2])):
        tried.clear()
        monkeypatch.setattr(_ways, "FEW_TETS", few)
        next(_ways.ways_to_print(equilibria, inputs["relaxed"], smp, weights, never))
        assert tried == expected


@pytest.mark.parametrize(("few", "more"), [(0, False), (10_000, True)])
def test_other_labels_to_begin_with_are_those_of_few_tets(
    inputs: Artifacts, monkeypatch: pytest.MonkeyPatch, few: int, more: bool
) -> None:
    """The nearest first; none twice."""
    equilibria, weights, settings = fit_of(inputs)
    monkeypatch.setattr(_ways, "FEW_TETS", few)
    given = (equilibria, inputs["relaxed"], inputs["rounded"]["smp"], weights)
    first, *others = list(_ways.ways_to_print(*given, replace(settings, target_rms=1.0)))
    assert bool(others) == more
    first, *others = list(_ways.ways_to_print(*given, replace(settings, target_rms=0.0)))
    assert bool(others) == more
    errors = [rms(equilibria.problem, each.fitted) for each in (first, *others)]
    assert min(errors) == errors[0]
    labels = {each.design.rho.tobytes() for each in (first, *others)}
    assert len(labels) == 1 + len(others)
