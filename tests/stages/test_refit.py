"""The stage refit: printed labels in equilibrium with the elements of the fit, in a state that loading reaches."""

import csv
import io
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from designed_bar import PROFILE, Artifacts, designed_bar, fit_of, relaxed_design, rms

from fab4d.design import finish
from fab4d.design.equilibria import Equilibria
from fab4d.design.flips import FlipSettings
from fab4d.design.forward import Programming, balance, program, same_shape
from fab4d.design.gauss_newton import Design
from fab4d.design.objective import ObjectiveWeights, shape_error
from fab4d.design.paths import change_density
from fab4d.design.problem import at_nodes
from fab4d.design.reduced import Search
from fab4d.io.scene import Goal, SolverSettings
from fab4d.mesh.rigid import best_rigid_motion
from fab4d.mesh.tetmesh import FloatArray
from fab4d.stages import _design, _element, _fit, _flips, _ways, refit
from fab4d.stages._design import Trace, patches_of, problem_of
from fab4d.stages._element import problem_like
from fab4d.stages.monitor import SilentMonitor
from fab4d.stages.threshold import labels_for


@pytest.fixture(scope="module")
def inputs() -> Artifacts:
    return designed_bar()


@pytest.fixture(scope="module", params=["linear", "auto", "too many to round"])
def fitted(request: pytest.FixtureRequest, inputs: Artifacts) -> tuple[str, Artifacts]:
    element = "linear" if request.param == "linear" else "auto"
    with pytest.MonkeyPatch.context() as patch:
        if request.param == "too many to round":
            patch.setattr(_element, "MOST_ROUNDED_DOFS", 0)
        found = refit.run(inputs, PROFILE | {"solver": SolverSettings(element=element)}, SilentMonitor())
    return request.param, found


def everywhere(monkeypatch: pytest.MonkeyPatch, name: str, value: float) -> None:
    """A constant that several modules of the stage go by."""
    modules = [module for module in (refit, _ways, _fit, _flips) if hasattr(module, name)]
    assert modules
    for module in modules:
        monkeypatch.setattr(module, name, value)


def errors(found: Artifacts) -> FloatArray:
    rows = csv.DictReader(io.StringIO(found["refit_trace"].decode()))
    return np.array([float(row["rms_mm"]) for row in rows])


def equilibria_of(inputs: Artifacts, found: Artifacts) -> Equilibria:
    problem = problem_like(inputs["mesh"], PROFILE["materials"], found["printed"]["x"])
    return Equilibria(problem, patches_of(problem, found["printed"]))


def test_the_elements_are_those_asked_for(inputs: Artifacts, fitted: tuple[str, Artifacts]) -> None:
    """A bar two tets thick is coarse, so that quadratic tets are taken by default."""
    element, found = fitted
    order = equilibria_of(inputs, found).problem.body.order
    assert order == (1 if element == "linear" else 2)
    told = [item["what"] for item in found["refit_report"]["left_out"]]
    left_out = {"linear": ["quadratic elements"], "auto": [], "too many to round": ["rounding in quadratic elements"]}
    assert told == left_out[element]


def test_what_is_too_large_to_round_in_quadratic_elements_is_fitted_in_them(
    inputs: Artifacts, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Labels are flipped in linear elements, and in quadratic ones only while the tolerance is missed."""
    targets = []

    def spy(equilibria: Equilibria, design: Design, weights: Any, settings: FlipSettings, watch: Any) -> Design:  # noqa: ARG001
        targets.append((equilibria.problem.body.order, settings.target_rms / weights.error_scale, settings.rounds))
        return design

    monkeypatch.setattr(refit, "polish_labels", spy)
    monkeypatch.setattr(_ways, "FEW_TETS", 0)
    monkeypatch.setattr(refit, "renewed", lambda _, design, *__: design)
    monkeypatch.setattr(_element, "MOST_ROUNDED_DOFS", 0)
    found = refit.run(inputs, PROFILE | {"solver": SolverSettings(element="auto")}, SilentMonitor())
    (first, target, many), *others = targets
    assert first == 1
    assert target == pytest.approx(1.15 * float(inputs["relaxed"]["relaxed_rms"]) / PROFILE["goal"].tolerance)
    assert others
    assert all(other == (2, 1.0, _flips.FEW_ROUNDS) for other in others)
    assert many > _flips.FEW_ROUNDS
    rows = list(csv.DictReader(io.StringIO(found["refit_trace"].decode())))
    carried = next(k for k, row in enumerate(rows) if row["phase"] == "carried over")
    assert float(rows[-1]["rms_mm"]) < 0.9 * float(rows[carried]["rms_mm"])


@pytest.mark.parametrize(
    ("tolerance", "out_of_reach", "wanted", "order"),
    [
        (0.8, 1.25, "auto", 2),
        (1e-3, 1.25, "auto", 1),
        (1e-3, 1.25, "quadratic", 2),
        (0.8, 0.0, "auto", 2),
    ],
)
def test_a_design_far_from_the_tolerance_is_fitted_in_linear_elements(
    inputs: Artifacts,
    monkeypatch: pytest.MonkeyPatch,
    tolerance: float,
    out_of_reach: float,
    wanted: str,
    order: int,
) -> None:
    """Unless it meets the tolerance there after all, or quadratic ones are asked for or have found it."""
    monkeypatch.setattr(refit, "OUT_OF_REACH", out_of_reach)
    profile = PROFILE | {"goal": Goal(tolerance=tolerance, max_forces=4), "solver": SolverSettings(element=wanted)}
    found = refit.run(inputs, profile, SilentMonitor())
    assert equilibria_of(inputs, found).problem.body.order == order
    assert found["refit_report"]["left_out"] == ([refit.NOT_QUADRATIC] if order == 1 else [])
    quadratic = problem_of(inputs["mesh"], PROFILE["materials"], "quadratic")
    x = at_nodes(quadratic, inputs["relaxed"]["x"])
    assert not refit._missed_by_far(inputs | {"relaxed": inputs["relaxed"] | {"x": x}}, profile)


def test_a_design_that_quadratic_elements_do_not_hold_is_loaded_in_them(
    inputs: Artifacts, monkeypatch: pytest.MonkeyPatch
) -> None:
    """From rest: a bar comes so to where it would have been carried over to, and the fit goes on from there."""
    equilibria, _, _ = fit_of(inputs)
    quadratic = problem_of(inputs["mesh"], PROFILE["materials"], "quadratic")
    design = change_density(equilibria, relaxed_design(equilibria, inputs), inputs["rounded"]["smp"].astype(np.float64))
    carried = refit._in_elements_of(quadratic, Search(equilibria, design))
    monkeypatch.setattr(refit, "carried_in", lambda *_: None)
    loaded = refit._in_elements_of(quadratic, Search(equilibria, design))
    np.testing.assert_allclose(loaded.design.median.x, carried.design.median.x, atol=1e-6)
    assert loaded.rms == pytest.approx(carried.rms, rel=1e-6)
    monkeypatch.setattr(_element, "MOST_ROUNDED_DOFS", 0)
    found = refit.run(inputs, PROFILE | {"solver": SolverSettings(element="auto")}, SilentMonitor())
    assert equilibria_of(inputs, found).problem.body.order == 2
    assert errors(found)[-1] < 0.8


def test_the_fit_comes_nearer_than_the_relaxed_positions(fitted: tuple[str, Artifacts]) -> None:
    rms = errors(fitted[1])
    assert rms[-1] < 0.9 * rms[0]
    assert rms[-1] < 0.8


def test_loading_ends_in_the_fitted_state(inputs: Artifacts, fitted: tuple[str, Artifacts]) -> None:
    found = fitted[1]
    equilibria, printed = equilibria_of(inputs, found), found["printed"]
    smp, L0 = found["labels"]["smp"].astype(np.float64), equilibria.problem.length
    x, forces = printed["x"] / L0, printed["patch_force"] / equilibria.problem.force
    done = program(equilibria, smp, x, forces)
    assert same_shape(done, x)
    left = balance(equilibria, smp, done.median, done.final)
    assert max(left.median, left.final) < 1e-8
    y = done.final.y * L0
    R, t = best_rigid_motion(y, printed["y"])
    np.testing.assert_allclose(y @ R.T + t, printed["y"], atol=1e-6)


@pytest.mark.parametrize("most", [1, 1_000_000])
@pytest.mark.parametrize("tolerance", [1e-6, 1e6])
@pytest.mark.parametrize("met", [True, False])
def test_labels_of_many_tets_are_flipped_last(
    inputs: Artifacts, monkeypatch: pytest.MonkeyPatch, most: int, tolerance: float, met: bool
) -> None:
    """Where held positions alone, fitted to where loading ends, miss the goal.

    They are fitted clear of unstable states, and if these miss the tolerance (mm), near them too.
    """
    done, prices = list[str](), set[float]()
    flip_settings, load = _flips.fit_flips, program

    def flips(_: Equilibria, design: Design, weights: ObjectiveWeights, settings: FlipSettings, __: Any) -> Design:
        prices.add(weights.lam_stable)
        done.extend(["flips"] * (settings.rounds > 0))
        return design

    def loaded(*given: Any) -> Programming:
        done.append("loading")
        return load(*given)

    everywhere(monkeypatch, "MANY_TETS", most)
    monkeypatch.setattr(refit, "polish_labels", flips)
    monkeypatch.setattr(_fit, "program", loaded)
    target = np.inf if met else 0.0
    monkeypatch.setattr(refit, "fit_flips", lambda *given: replace(flip_settings(*given), target_rms=target))
    goal = replace(PROFILE["goal"], tolerance=tolerance)
    refit.run(inputs, PROFILE | {"solver": SolverSettings(element="linear"), "goal": goal}, SilentMonitor())
    if most == 1:
        assert done[0] == "loading"
        assert ("flips" in done) != met
        assert prices == ({finish.LAM_STABLE} if tolerance > 1 else {finish.LAM_STABLE, 0.0})
    else:
        assert done[0] == "flips"
        assert prices == {0.0}


@pytest.mark.parametrize(("rms", "whole", "kept"), [(0.5, True, True), (2.0, True, False), (0.5, False, False)])
def test_flips_after_loading_are_kept_where_loading_ends_nearer(
    inputs: Artifacts, monkeypatch: pytest.MonkeyPatch, rms: float, whole: bool, kept: bool
) -> None:
    """And goes all the way."""
    equilibria, weights, _ = fit_of(inputs)
    problem = equilibria.problem
    design = _ways.carried(equilibria, inputs["relaxed"], inputs["rounded"]["smp"].astype(np.float64))
    assert design is not None
    loading = Programming(design.median, design.final, 1, 1.0, 1.0)
    y = problem.X_temp + rms * (design.final.y - problem.X_temp)
    flipped = replace(design, final=replace(design.final, y=y))
    before = _fit.Fit(equilibria, design, fits=2, loading=loading, missed=0.3)
    after = _fit.Fit(equilibria, flipped, fits=1, loading=loading if whole else None)
    monkeypatch.setattr(_fit, "reachable_fit", lambda *_: after)
    trace = Trace(problem, inputs["mesh"], SilentMonitor(), 1.0)
    found = _fit.other_fit(before, weights, 0.1, lambda *_: flipped, trace)
    assert found.design is (flipped if kept else design)
    assert (found.fits, found.missed) == (3, 0.3)
    assert _fit.other_fit(before, weights, 0.1, lambda *_: design, trace) is before


@pytest.mark.parametrize(("goal", "begun"), [(0.5, [0, 1, 2]), (1.5, [0, 1]), (2.5, [0])])
def test_flips_begin_again_until_they_come_to_the_goal(
    inputs: Artifacts, monkeypatch: pytest.MonkeyPatch, goal: float, begun: list[int]
) -> None:
    """goal : the error at which they end; they come to 2, 1 and 3, and the least is taken."""
    equilibria, _, settings = fit_of(inputs)
    first = relaxed_design(equilibria, inputs)
    designs = [first, replace(first), replace(first)]
    errors = {id(design): error for design, error in zip(designs, (2.0, 1.0, 3.0), strict=True)}
    monkeypatch.setattr(_ways, "shape_error", lambda _, y: SimpleNamespace(rms=errors[y]))
    ends = iter([replace(each, final=replace(each.final, y=id(each))) for each in designs])
    polished_from = list[Design]()

    def polish(_: Equilibria, design: Design) -> Design:
        polished_from.append(design)
        return next(ends)

    trace = SimpleNamespace(add=lambda *_: None)
    begin = (_ways.Way(each, each) for each in designs)
    best = refit._best_flipped(equilibria, begin, polish, replace(settings, target_rms=goal), trace)
    assert [designs.index(each) for each in polished_from] == begun
    assert errors[best.final.y] == min(errors[id(designs[k])] for k in begun)


def test_the_end_of_the_loading_is_handed_on(inputs: Artifacts, fitted: tuple[str, Artifacts]) -> None:
    found = fitted[1]
    loaded, printed = found["loaded"], found["printed"]
    np.testing.assert_allclose(loaded["x"], printed["x"], atol=1e-5 * np.ptp(inputs["mesh"]["X"]))
    np.testing.assert_allclose(loaded["patch_force"], printed["patch_force"], rtol=1e-3)
    assert loaded["load_steps"] > 2


@pytest.mark.parametrize("hopeless", [True, False])
def test_no_loading_is_handed_on_that_does_not_go_all_the_way(
    inputs: Artifacts, monkeypatch: pytest.MonkeyPatch, hopeless: bool
) -> None:
    """Fits are made again, unless they miss the tolerance by far."""
    everywhere(monkeypatch, "OUT_OF_REACH", 0.0 if hopeless else np.inf)
    monkeypatch.setattr(_fit, "program", lambda *given: replace(program(*given), loaded=0.9))
    found = refit.run(inputs, PROFILE, SilentMonitor())
    assert found["loaded"] is None
    assert found["refit_report"]["fits"] == (1 if hopeless else _fit.MOST_FITS)


@pytest.mark.parametrize(("tolerance", "far", "fits"), [(1e9, np.inf, 1), (1e-9, np.inf, 3), (1e-9, 1.25, 1)])
def test_the_best_state_that_loading_ends_in_is_delivered(
    inputs: Artifacts, monkeypatch: pytest.MonkeyPatch, tolerance: float, far: float, fits: int
) -> None:
    """Loading that ends in other equilibria than the fits': the first within the tolerance, or else the nearest one.

    far : beyond this multiple of the tolerance fits are not made again
    """
    everywhere(monkeypatch, "OUT_OF_REACH", far)
    ends = list[Programming]()

    def elsewhere(equilibria: Equilibria, rho: np.ndarray, x: np.ndarray, forces: np.ndarray) -> Programming:
        done = program(equilibria, rho, x, forces)
        away = (0.002 if len(ends) == 1 else 0.01) * np.sin(3 * done.final.y[:, [1, 2, 0]])
        ends.append(replace(done, final=replace(done.final, y=done.final.y + away)))
        return ends[-1]

    monkeypatch.setattr(_fit, "program", elsewhere)
    monkeypatch.setattr(_fit, "same_shape", lambda done, x: False)  # noqa: ARG005
    monkeypatch.setattr(refit, "polished", lambda equilibria, design: design)  # noqa: ARG005
    found = refit.run(inputs, PROFILE | {"goal": Goal(tolerance=tolerance, max_forces=4)}, SilentMonitor())
    assert found["refit_report"]["fits"] == len(ends) == fits
    problem = equilibria_of(inputs, found).problem
    L0, reached = problem.length, [shape_error(problem, end.final.y).rms for end in ends]
    wanted = ends[int(np.argmin(reached))]
    np.testing.assert_array_equal(found["printed"]["y"], wanted.final.y * L0)
    np.testing.assert_array_equal(found["loaded"]["y"], wanted.final.y * L0)


@pytest.mark.parametrize(("share", "told"), [(-0.1, False), (0.5, True), (1.1, False)])
def test_a_fit_that_loading_does_not_lead_to_is_told_where_it_alone_meets_the_tolerance(
    inputs: Artifacts, monkeypatch: pytest.MonkeyPatch, share: float, told: bool
) -> None:
    """share : where the tolerance lies between the errors of the fit and of what loading ends in"""
    equilibria, weights, _ = fit_of(inputs)
    problem, design = equilibria.problem, relaxed_design(equilibria, inputs)
    away = 0.02 * np.sin(3 * design.final.y[:, [1, 2, 0]])
    bent = replace(design, final=replace(design.final, y=design.final.y + away))
    fit, end = rms(problem, design), rms(problem, bent)
    assert fit < end
    monkeypatch.setattr(_fit, "program", lambda *_: Programming(bent.median, bent.final, 1, 1.0, 1.0))
    monkeypatch.setattr(_fit, "held_apart", lambda *_: None)
    monkeypatch.setattr(_fit, "same_shape", lambda *_: False)
    weights = weights.replace(error_scale=fit + share * (end - fit))
    trace = Trace(problem, inputs["mesh"], SilentMonitor(), 1.0)
    found = _fit.reachable_fit(equilibria, design, weights, 0.1, lambda _, design: design, trace)
    assert rms(problem, found.design) == pytest.approx(end)
    reasons = _fit.not_reached(found, weights)
    assert any("two shapes" in each for each in reasons) == told
    if told:
        off = float(reasons[0].split(" mm RMS")[0].split()[-1])
        assert off == pytest.approx(fit * problem.length, rel=5e-3)


def test_a_point_moves_to_where_loading_ends_elsewhere(inputs: Artifacts, monkeypatch: pytest.MonkeyPatch) -> None:
    """Where the fit meets the tolerance and the first loading bends off; the next one is what it is."""
    told = list[tuple[Equilibria, FloatArray]]()

    def elsewhere(equilibria: Equilibria, rho: np.ndarray, x: np.ndarray, forces: np.ndarray) -> Programming:
        done = program(equilibria, rho, x, forces)
        told.append((equilibria, x))
        if len(told) > 1:
            return done
        X = equilibria.problem.body.X
        sideways = np.exp(-(((X[:, 0] - 0.6 * X[:, 0].max()) / 0.2) ** 2))[:, None] * [0.0, 0.1, 0.0]
        bent = replace(done.median, x=done.median.x + sideways), replace(done.final, y=done.final.y + sideways)
        return replace(done, median=bent[0], final=bent[1])

    monkeypatch.setattr(_fit, "program", elsewhere)
    found = refit.run(inputs, PROFILE, SilentMonitor())
    before, after = (set(equilibria.patches.centers.tolist()) for equilibria, _ in told)
    assert len(before) == len(after) == 4
    (new,) = after - before
    X = inputs["mesh"]["X"]
    assert X[new, 0] == pytest.approx(0.6 * X[:, 0].max(), abs=0.15 * X[:, 0].max())
    assert set(found["printed"]["patch_center"].tolist()) == after
    assert found["refit_report"]["fits"] == 2
    assert found["loaded"] is not None


def test_labels_stay_printable(inputs: Artifacts, fitted: tuple[str, Artifacts]) -> None:
    mesh, smp = inputs["mesh"], fitted[1]["labels"]["smp"]
    again = labels_for(mesh["X"], mesh["tets"], smp.astype(np.float64), np.ones(len(smp)), PROFILE["printer"])
    np.testing.assert_array_equal(again.smp, smp)


@pytest.mark.parametrize(("most", "low"), [(10_000, 0.15), (10, 1.0)])
def test_labels_are_flipped_down_to_a_share_above_the_relaxed_error(
    inputs: Artifacts, monkeypatch: pytest.MonkeyPatch, most: int, low: float
) -> None:
    """With little patience below 0.15 of the tolerance, and below the tolerance where there are many unknowns."""
    monkeypatch.setattr(_flips, "MANY_DOFS", most)
    monkeypatch.setattr(_ways, "FEW_TETS", 0)
    monkeypatch.setattr(refit, "renewed", lambda _, design, *__: design)
    targets = []

    def spy(equilibria: Equilibria, design: Design, weights: Any, settings: FlipSettings, watch: Any) -> Design:  # noqa: ARG001
        targets.append(settings.target_rms * equilibria.problem.length)
        assert settings.low_rms == pytest.approx(low * weights.error_scale)
        assert settings.tolerance == weights.error_scale
        # Printed labels may squeeze tets more than the search lets them.
        assert 0 < weights.least_stretch < _design.LEAST_STRETCH
        assert 0 < weights.lam_squeeze < _design.LAM_SQUEEZE
        return design

    monkeypatch.setattr(refit, "polish_labels", spy)
    refit.run(inputs, PROFILE, SilentMonitor())
    assert targets == [pytest.approx(1.15 * float(inputs["relaxed"]["relaxed_rms"]))]


@pytest.mark.parametrize(
    ("relaxed_rms", "n_tets", "down_to"),
    [
        (0.3, 40_000, 0.345),  # far below the tolerance: the share above the relaxed error
        (0.3, 40_001, 0.5),  # the same on a large mesh: what is good enough
        (0.5, 40_001, 0.575),
        (0.95, 1_000, 1.0),  # the tolerance comes first
        (1.1, 40_001, 1.0),  # flips may win what the relaxed design lacks
        (1.2, 1_000, 1.38),  # out of reach: no more work than that of rounding
    ],
)
def test_labels_are_flipped_until_the_tolerance_is_met_where_it_is_near(
    relaxed_rms: float, n_tets: int, down_to: float
) -> None:
    assert _flips.flipped_down_to(relaxed_rms, 1.0, n_tets) == pytest.approx(down_to)
