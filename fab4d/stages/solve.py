"""Stage `solve`: a near 0/1 density and the points to hold, so that the part takes the temporary shape."""

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from fab4d.design.finish import OTHER_ELEMENTS, SEARCHED_LEFT, Relaxed, carried_in, relaxed_from, rounded_on
from fab4d.design.gauss_newton import Design
from fab4d.design.objective import force_excess, pushes, shape_error, stretch_excess
from fab4d.design.problem import Problem
from fab4d.design.reduced import Phase, ReducedSettings, Search, Watch, at_rest, fewest_points, relaxed, solve_reduced
from fab4d.design.starts import BEGINNINGS
from fab4d.errors import EquilibriumError, SceneError
from fab4d.io.scene import Goal, RigCard, Weights
from fab4d.stages._bring_up import COARSE_SHARE, affordable, brought_up, far_off
from fab4d.stages._coarse import MANY_TETS, coarse_for
from fab4d.stages._design import Trace, objective_weights, patch_arrays, problem_of, tau_seconds, tolerance_of
from fab4d.stages._element import elements_for
from fab4d.stages._least import RELAXED, least_smp
from fab4d.stages._printed import as_printed, refitted_in
from fab4d.stages._repair import MORE_REPAIRS, repaired
from fab4d.stages._search import search_arrays, search_from
from fab4d.stages._starts import Starts
from fab4d.stages.monitor import Monitor, Prefixed
from fab4d.stages.refit import flip_settings

CHECKPOINT, BEST, POINTS = "iterate", "best", "points"
# Above this share of SMP the search makes it dearer, even if the goal names no limit.
USUAL_SMP_FRACTION = 0.5
# The share of SMP settles about the search's limit, which is this much of the goal's.
WITHIN_LIMIT = 0.97
LEFT_OUT = [{"what": "iterative linear solver", "why": "the direct one factors this mesh in memory"}]
# Factors of lam_smooth and lam_SMP, tried in turn until the printed labels meet the tolerance: smoother interfaces lose
# less when labels are repaired, and more SMP holds the shape better.
ATTEMPTS = ((1.0, 1.0), (2.5, 0.4), (6.0, 0.2))
# A design rounded in the elements of the last fit prints well enough, if its RMS error is at most this share of the
# tolerance: repairs of its labels cost less than the rest.
CERTAINLY_ENOUGH = 0.5
# Flips of the last fit bring the error of a printed design down from this multiple of the tolerance.
FLIPS_WIN_BACK = 1.5
NOT_LINEAR = {"what": "rounding in linear elements", "why": "quadratic ones round the relaxed design well"}
# Linear elements round a design as well as quadratic ones, and much faster, where its error in quadratic ones is at
# most this multiple of that in linear ones, held positions unchanged.
LINEAR_HOLDS = 1.15
LINEAR_ROUNDS = {
    "what": "rounding in quadratic elements",
    "why": "the relaxed design is near to that in linear ones",
}
# Quadratic elements lose a design if, relaxed in them, it errs by more than this multiple of its error in linear ones
# and by more than this share of the tolerance.
LOST, LOST_SHARE = 2.25, 0.75
NOT_QUADRATIC = {"what": "rounding in quadratic elements", "why": "the relaxed design misses the tolerance by far"}
# Where MANY_TETS are searched, for no coarser mesh does, they are rounded in about half the steps, none of which leads
# past unstable states: that takes many times longer.
FAST_GROWTH = 2.5
# A coarse mesh is searched from so many times more other points where the usual ones nearly do: what is found there
# saves steps on all tets, which take minutes.
MORE_BEGINNINGS = 6
# Where the tolerance is far out of reach, what so many times the points would leave of the error tells whether points
# are what is missing.
MANY_MORE = 4
# Where the scene names no number of points: those whose relaxed design is at this share of the tolerance, and in later
# attempts as many times more.
RELAXED_SHARE = 0.6
MORE_POINTS = (1.0, 1.3, 1.8)


def run(inputs: Mapping[str, Any], profile: Mapping[str, Any], monitor: Monitor) -> dict[str, Any]:
    """Choose the points, relax the density, drive it to 0 and 1; again with other weights if printing costs a lot."""
    mesh = inputs["mesh"]
    _refuse_weights(profile["weights"], profile["goal"])
    problem = problem_of(mesh, profile["materials"], "linear")
    monitor.progress("compile, measure tau")
    tau_s = tau_seconds(problem)
    trace = Trace(problem, mesh, monitor, tau_s)
    if inputs["check_report"]["nothing_to_program"]:
        rest = at_rest(problem)
        trace.add("rest", rest)
        why = [
            {"what": "design, forces and rig sheet", "why": "the temporary shape is the permanent one, moved rigidly"}
        ]
        return _artifacts(mesh, profile, rest, trace, {"tau_s": tau_s, "left_out": why})
    if inputs["picked"] is not None:
        return _picked(problem, inputs, profile, trace, tau_s)
    element = elements_for(mesh, profile["solver"].element).rounding
    designed = _designed_coarse(problem, mesh, profile, element, trace, monitor)
    if designed is None:
        found, _, report = _designed(problem, mesh, profile, element, trace, monitor)
    else:
        found, report = designed
    return _artifacts(mesh, profile, found, trace, {"tau_s": tau_s, "iterations": len(trace.rows)} | report)


def _designed(
    problem: Problem,
    mesh: Mapping[str, np.ndarray],
    profile: Mapping[str, Any],
    element: str,
    trace: Trace,
    monitor: Monitor,
    more_beginnings: int = 1,
) -> tuple[Search, Search, dict[str, Any]]:
    """The design of all attempts, with the least SMP if the goal asks for that, it before rounding, and what the report
    says of it.

    element : in which designs are rounded and judged as printed: that of the last fit, here and below, unless its
        unknowns are too many for that
    """
    searched = _search(problem, mesh, profile, element, trace, monitor, more_beginnings)
    least = None
    if profile["goal"].smp == "least":
        sections = {name: profile[name] for name in ("printer", "rig", "goal", "acceptance")}
        least = least_smp(problem, mesh, sections, searched.settings, searched.found, trace, monitor)
        finish = _finished(mesh, profile, element, least.relaxed, searched.settings, trace)
        searched = replace(
            searched, found=least.found, relaxed=least.relaxed, printed_rms=least.printed_rms, finish=finish
        )
    rms = searched.printed_rms
    report = {
        "attempts": searched.attempts,
        "printed_rms_mm": rms * problem.length if np.isfinite(rms) else None,
        "least_smp": None if least is None else least.trials,
        "limited_by": _limited_by(problem, profile, searched.found, searched.more_points),
        "left_out": [*LEFT_OUT, *searched.finish.left_out],
    }
    return searched.finish.found or searched.found, searched.relaxed, report


def _designed_coarse(
    problem: Problem,
    mesh: Mapping[str, np.ndarray],
    profile: Mapping[str, Any],
    element: str,
    trace: Trace,
    monitor: Monitor,
) -> tuple[Search, dict[str, Any]] | None:
    """As `_designed`, on a coarser mesh and carried over.

    None where the mesh is small, or where the coarser one or the way back finds no equilibrium: the whole mesh is then
    searched, which takes longer.
    """
    chain = coarse_for(problem, mesh, profile["materials"], element, monitor)
    if not chain:
        return None
    coarse, goal = chain[-1], profile["goal"]
    own = trace.on(coarse.level.coarse, coarse.mesh)
    tolerance = COARSE_SHARE * tolerance_of(problem, goal) * problem.length
    lower = dict(profile) | {"goal": replace(goal, tolerance=tolerance)}
    try:
        found, before, report = _designed(
            coarse.level.coarse, coarse.mesh, lower, "linear", own, Prefixed(monitor, "coarse-"), MORE_BEGINNINGS
        )
    except EquilibriumError:
        return None

    def settings_of(finer: Problem) -> ReducedSettings:
        return search_settings(finer, profile, report["attempts"] - 1)

    levels = [each.level for each in reversed(chain)]
    meshes = [mesh, *(each.mesh for each in chain[:-1])][::-1]
    traces = [trace.on(level.fine, finer).add for level, finer in zip(levels, meshes, strict=True)]
    carried = brought_up(levels, before, found, settings_of, goal, traces)
    if carried is None:
        return None
    why = f"the design is found on {coarse.level.coarse.n_tets} tets of the same part and carried over"
    left_out = [*report["left_out"], {"what": f"search on all {problem.n_tets} tets", "why": why}]
    return carried, report | {"left_out": left_out}


@dataclass(frozen=True)
class _MorePoints:
    """A number of points, and the RMS error, L0, of the relaxed design with them."""

    count: int
    rms: float


@dataclass(frozen=True, eq=False)
class _Finish:
    """The relaxed design rounded in the elements of the last fit, None where it is not, and what was left out.

    printed_rms : RMS error as printed, L0; of the design itself where that is certainly enough
    """

    found: Search | None = None
    left_out: tuple[dict[str, str], ...] = ()
    printed_rms: float = np.inf


@dataclass(frozen=True, eq=False)
class _Linear:
    """A design rounded in linear elements as printed: its state, None without an equilibrium, and its RMS error, L0.

    in_fit : that in the elements of the last fit; None where it is not known
    """

    design: Design | None
    rms: float
    in_fit: float | None = None


@dataclass(frozen=True, eq=False)
class _Searched:
    """What the attempts came to.

    found : the best design, rounded in linear elements, or else still relaxed        settings : of the last attempt
    relaxed : the last design before rounding
    printed_rms : RMS error of `found` as printed, L0, inf where it was not judged
    finish : of the last relaxed design
    more_points : what more points would reach, where these are far from the tolerance
    """

    found: Search
    relaxed: Search
    settings: ReducedSettings
    attempts: int
    printed_rms: float
    finish: _Finish
    more_points: _MorePoints | None = None


def _finished(
    mesh: Mapping[str, np.ndarray],
    profile: Mapping[str, Any],
    element: str,
    relaxed: Search,
    settings: ReducedSettings,
    trace: Trace,
) -> _Finish:
    """The relaxed design rounded in the elements of the last fit.

    Not where these are linear, lose it on the way or need more SMP than the goal allows, where it misses the tolerance
    by far, and where linear elements do as well.
    """
    if element == "linear" or relaxed.phase is not Phase.ROUND:
        return _Finish()
    if far_off(relaxed, settings):
        return _Finish(left_out=(NOT_QUADRATIC,))
    carried = carried_in(problem_of(mesh, profile["materials"], element), relaxed)
    if carried is None:
        return _Finish()
    if _rms(carried) <= LINEAR_HOLDS * relaxed.relaxed_rms:
        trace.add("carried over", carried)
        return _Finish(left_out=(LINEAR_ROUNDS,))
    finished = _rounded_in(carried, relaxed.relaxed_rms, settings, trace)
    return _Finish(finished if affordable(finished, profile["goal"]) else None)


def _rounded_in(carried: Search, linear_rms: float, settings: ReducedSettings, trace: Trace) -> Search | None:
    """A near 0/1 design in the elements that a relaxed one was carried over to, or found there where these lose it.

    linear_rms : RMS error, L0, of the relaxed design in linear elements        None where no equilibria lead to one
    """
    tolerance = settings.weights.error_scale
    further = relaxed_from(carried, settings, trace.add, OTHER_ELEMENTS.relax_iterations)
    lost = further.at.relaxed_rms > max(LOST * linear_rms, LOST_SHARE * tolerance)
    rounded = None if lost else rounded_on(further, trace.add, OTHER_ELEMENTS.most_left)
    if rounded is None and _rms(carried) > tolerance:
        rounded = _found_in(carried.equilibria.problem, settings, trace)
    if rounded is None and lost:
        rounded = rounded_on(further, trace.add, OTHER_ELEMENTS.most_left)
    return rounded


def _found_in(problem: Problem, settings: ReducedSettings, trace: Trace) -> Search | None:
    """A near 0/1 design searched from the start; None where none is found, or the relaxed one misses the tolerance.

    It takes minutes, but what linear elements find is of no use where they lock: quadratic ones miss the tolerance with
    it, and steps from there lead past unstable states or to little.
    """
    phase = "start"

    def show(at: Search) -> None:
        nonlocal phase
        trace.add(phase, at)
        phase = at.phase.value

    try:
        at = relaxed(problem, replace(settings, centers=None), show)
    except EquilibriumError:
        return None
    if at.relaxed_rms > settings.weights.error_scale:
        return None
    return rounded_on(Relaxed(at, settings), trace.add, SEARCHED_LEFT)


def _picked(
    problem: Problem, inputs: Mapping[str, Any], profile: Mapping[str, Any], trace: Trace, tau_s: float
) -> dict[str, Any]:
    """The design of a row of the tradeoff, as if it had been searched."""
    picked = inputs["picked"]
    row, found = json.loads(str(picked["row"])), search_from(problem, picked)
    trace.add("picked", found)
    left_out = [{"what": "search for a design", "why": f"row {row['id']} of the tradeoff is picked"}]
    report = {"tau_s": tau_s, "picked": row, "left_out": left_out}
    return _artifacts(inputs["mesh"], profile, found, trace, report)


def _refuse_weights(weights: Weights, goal: Goal) -> None:
    if weights.lam_force is not None:
        msg = (
            "weights.lam_force: the reduced solver takes a number of points ([goal] max_forces), not a price of forces"
        )
        raise SceneError(msg)
    if weights.lam_SMP == 0 and goal.smp == "least":
        msg = 'weights.lam_SMP is 0, from where [goal] smp = "least" cannot search: leave it out or raise it'
        raise SceneError(msg)


def _search(
    problem: Problem,
    mesh: Mapping[str, np.ndarray],
    profile: Mapping[str, Any],
    element: str,
    trace: Trace,
    monitor: Monitor,
    more_beginnings: int,
) -> _Searched:
    """The best design of the attempts.

    Where the elements of the last fit round the first relaxed design well, nothing is rounded in linear ones.
    """
    first, start = _resumed(problem, trace, monitor)
    best, least = _restored_best(problem, monitor)
    printed: _Linear | None = None
    before_rounding = [] if start is None else _restored_relaxed(problem, monitor)
    count, finishes = _points(problem, profile, trace, monitor), dict[int, _Finish]()
    enough = profile["goal"].smp == "enough"

    def settings_of(other: Problem) -> ReducedSettings:
        return search_settings(other, profile, 0, count)

    more_points: _MorePoints | None = None
    starts = Starts(problem, mesh, profile["materials"], settings_of, trace, monitor, most=more_beginnings * BEGINNINGS)
    for attempt in range(first, len(ATTEMPTS)):
        settings = search_settings(problem, profile, attempt, _tried(profile, attempt, count))
        watch = _watch(attempt, start, trace, monitor, before_rounding)
        at = relaxed(problem, replace(settings, centers=starts.chosen()), watch, start)
        if attempt == 0 and _asked(profile, settings):
            at = starts.best(at, _watch(attempt, None, trace, monitor, before_rounding))
        if attempt == 0 and enough and at.phase is Phase.ROUND and at.iteration == 0:
            finish = _judged(_finished(mesh, profile, element, at, settings, trace), mesh, profile, settings)
            finishes[attempt] = finish
            if finish.printed_rms <= settings.weights.error_scale:
                return _Searched(at, at, settings, 1, np.inf, replace(finish, left_out=(NOT_LINEAR,)))
        if attempt == 0 and _asked(profile, settings) and far_off(at, settings):
            monitor.progress("out of reach", rms_mm=at.relaxed_rms * problem.length, forces=settings.n_points)
            more_points = _more_points(problem, settings, monitor)
        found = solve_reduced(problem, settings, watch, at)
        if _hopeless(profile, settings, found):
            best = best or found
            break
        start = None
        linear = _linear_printed(problem, mesh, profile, element, settings, found)
        if best is None or linear.rms < least:
            best, least, printed = found, linear.rms, linear
            monitor.save(BEST, _checkpoint(attempt, found, trace) | {"rms": np.array(least)})
        if least <= settings.weights.error_scale:
            break
    assert best is not None  # at least one attempt is made
    last = before_rounding[-1]
    if enough and attempt not in finishes:
        finish = _judged(_finished(mesh, profile, element, last, settings, trace), mesh, profile, settings)
        finishes[attempt] = finish
    finish = finishes.get(attempt, _Finish())
    if finish.found is not None and finish.printed_rms > CERTAINLY_ENOUGH * settings.weights.error_scale:
        printed = printed or _linear_printed(problem, mesh, profile, element, settings, best)
        if _prints_better(best, printed, finish.found.equilibria.problem, finish.printed_rms, settings):
            finish = _Finish(left_out=finish.left_out)
    return _Searched(best, last, settings, attempt + 1, least, finish, more_points)


def _linear_printed(
    problem: Problem,
    mesh: Mapping[str, np.ndarray],
    profile: Mapping[str, Any],
    element: str,
    settings: ReducedSettings,
    found: Search,
) -> _Linear:
    """A rounded design as printed.

    Its error is that in the elements of the last fit where these err by more than flips win back: linear ones lock in
    thin limbs, and tell nothing about labels that hold a limb by single tets.
    """
    weights = settings.weights
    tolerance = weights.error_scale
    printed = as_printed(problem, mesh, profile["printer"], profile["goal"], weights, found, tolerance)
    if element == "linear" or printed.design is None or printed.rms > tolerance:
        return _Linear(printed.design, printed.rms)
    rms = refitted_in(problem_of(mesh, profile["materials"], element), found, printed.design, weights)
    return _Linear(printed.design, rms if rms > FLIPS_WIN_BACK * tolerance else printed.rms, rms)


def _judged(
    finish: _Finish, mesh: Mapping[str, np.ndarray], profile: Mapping[str, Any], settings: ReducedSettings
) -> _Finish:
    """The same with its error as printed, without flips, which take minutes in the elements of the last fit."""
    found, weights = finish.found, settings.weights
    if found is None:
        return finish
    rms = _rms(found)
    if rms > CERTAINLY_ENOUGH * weights.error_scale:
        rms = as_printed(
            found.equilibria.problem, mesh, profile["printer"], profile["goal"], weights, found, good_enough=np.inf
        ).rms
    return replace(finish, printed_rms=rms)


def _prints_better(best: Search, printed: _Linear, problem: Problem, rms: float, settings: ReducedSettings) -> bool:
    """Whether the design `best`, rounded in linear elements, errs by less than rms, L0, as printed in those of
    `problem`."""
    if printed.design is None:
        return False
    in_fit = printed.in_fit
    if in_fit is None:
        in_fit = refitted_in(problem, best, printed.design, settings.weights)
    return in_fit < rms


def _rms(found: Search) -> float:
    return shape_error(found.equilibria.problem, found.design.final.y).rms


def _watch(attempt: int, start: Search | None, trace: Trace, monitor: Monitor, before_rounding: list[Search]) -> Watch:
    """Keeps every state, and adds those that are about to be rounded to `before_rounding`."""
    phase = "start" if start is None else start.phase.value

    def watch(at: Search) -> None:
        nonlocal phase
        trace.add(phase, at)
        phase = at.phase.value
        monitor.save(CHECKPOINT, _checkpoint(attempt, at, trace))
        if at.phase is Phase.ROUND and at.iteration == 0:
            monitor.save(RELAXED, search_arrays(at))
            before_rounding.append(at)

    return watch


def _hopeless(profile: Mapping[str, Any], settings: ReducedSettings, found: Search) -> bool:
    """Whether other attempts, which make rounding cost less, cannot help: the relaxed design misses the tolerance."""
    return _asked(profile, settings) and _reached(found) > settings.weights.error_scale


def _asked(profile: Mapping[str, Any], settings: ReducedSettings) -> bool:
    """Whether there cannot be more points."""
    return profile["goal"].max_forces is not None or settings.n_points == profile["rig"].max_points


def _reached(found: Search) -> float:
    """The RMS error, L0, of the relaxed design, or of the rounded one where rounding has gone on to lower it."""
    return min(found.relaxed_rms, _rms(found))


def _more_points(problem: Problem, settings: ReducedSettings, monitor: Monitor) -> _MorePoints | None:
    """What MANY_MORE times the points would reach; None where no equilibrium is found with them."""
    many = replace(settings, n_points=MANY_MORE * settings.n_points)

    def watch(at: Search) -> None:
        monitor.progress("more points", rms_mm=_rms(at) * problem.length, forces=at.equilibria.patches.count)

    try:
        at = relaxed(problem, many, watch)
    except EquilibriumError:
        return None
    return _MorePoints(at.equilibria.patches.count, at.relaxed_rms)


def _limited_by(
    problem: Problem, profile: Mapping[str, Any], found: Search, more_points: _MorePoints | None = None
) -> str | None:
    """What keeps the relaxed design, each tet any mixture, from the goal; None where it comes near enough."""
    weights = search_settings(problem, profile).weights
    if _reached(found) <= weights.error_scale:
        return None
    median, patches, limits = found.design.median, found.equilibria.patches, []
    if (force_excess(median.forces, weights.max_force) > 0).any():
        limits.append("the largest force of the rig")
    if len(stretch_excess(problem, weights, found.design.rho, median.x).tets):
        limits.append("the largest stretch of the materials")
    if weights.pull_only and patches.count and (pushes(patches, median).excess > 0).any():
        limits.append("that the rig only pulls")
    what = " and ".join(limits) if limits else f"the number of points, {patches.count}"
    error = shape_error(problem, found.design.final.y).e
    worst = problem.body.X[np.argmax(np.linalg.norm(error, axis=1))] * problem.length
    place = ", ".join(f"{x:.3g}" for x in worst)
    left = _reached(found) * problem.length
    return (
        f"{what}: with any mixture of materials in each tet the error stays at {left:.3g} mm, "
        f"most of all near ({place}) mm of the printed part"
    ) + ("" if more_points is None else _outlook(problem, weights.error_scale, more_points))


def _outlook(problem: Problem, tolerance: float, more: _MorePoints) -> str:
    left = f"{more.count} points would leave {more.rms * problem.length:.3g} mm"
    if more.rms <= tolerance:
        return f"; {left}"
    return (
        f"; even {left}: the temporary shape asks for more than pulling at points does, so change it or the tolerance"
    )


def _points(problem: Problem, profile: Mapping[str, Any], trace: Trace, monitor: Monitor) -> int:
    """The number of points: what the scene asks for, or else the fewest that meet the tolerance."""
    goal, rig = profile["goal"], profile["rig"]
    if goal.max_forces is not None:
        return most_points(goal, rig)
    saved = monitor.restore(POINTS)
    if saved is not None:
        return int(saved["count"])
    settings = search_settings(problem, profile)
    enough = RELAXED_SHARE * settings.weights.error_scale
    count = fewest_points(problem, settings, enough, lambda at: trace.add("points", at))
    monitor.save(POINTS, {"count": np.array(count)})
    return count


def _tried(profile: Mapping[str, Any], attempt: int, count: int) -> int:
    """Points of an attempt: `count`, or more in later attempts where the scene names no number."""
    goal, rig = profile["goal"], profile["rig"]
    return count if goal.max_forces is not None else min(math.ceil(MORE_POINTS[attempt] * count), rig.max_points)


def most_points(goal: Goal, rig: RigCard) -> int:
    """The number of points asked for, or else the most that the rig has."""
    return rig.max_points if goal.max_forces is None else min(goal.max_forces, rig.max_points)


def search_settings(
    problem: Problem, profile: Mapping[str, Any], attempt: int = 0, n_points: int | None = None
) -> ReducedSettings:
    """The solver's settings for one of the ATTEMPTS, with `most_points` if no number is given.

    profile : sections goal, rig, weights and materials
    """
    goal: Goal = profile["goal"]
    rig: RigCard = profile["rig"]
    weights = objective_weights(problem, goal, profile["weights"], rig, profile["materials"])
    (smooth, smp), limit = ATTEMPTS[attempt], goal.max_smp_fraction
    settings = ReducedSettings(
        n_points=most_points(goal, rig) if n_points is None else n_points,
        patch_radii=tuple(radius / problem.length for radius in rig.patch_radii),
        weights=weights.replace(lam_smooth=smooth * weights.lam_smooth, lam_SMP=smp * weights.lam_SMP),
        max_smp_fraction=USUAL_SMP_FRACTION if limit is None else WITHIN_LIMIT * limit,
    )
    fast = replace(settings, round_growth=FAST_GROWTH, nearly=1.0)
    return fast if problem.n_tets > MANY_TETS else settings


def _artifacts(
    mesh: Mapping[str, np.ndarray], profile: Mapping[str, Any], found: Search, trace: Trace, report: dict[str, Any]
) -> dict[str, Any]:
    problem, design = found.equilibria.problem, found.design
    weights = search_settings(problem, profile).weights
    flips = flip_settings(mesh, profile["printer"], profile["goal"], weights.error_scale)
    more = 0 if problem.n_tets > MANY_TETS else MORE_REPAIRS
    relaxed = {
        "rho": design.rho,
        "repair_cost": repaired(mesh, profile["printer"], flips, found, weights, more).cost,
        "x": design.median.x * problem.length,
        "y": design.final.y * problem.length,
        "relaxed_rms": np.array(found.relaxed_rms * problem.length),
        "patch_radius": np.array(found.patch_radius * problem.length),
    }
    return {
        "relaxed": relaxed | patch_arrays(problem, found.equilibria.patches, design),
        "solve_report": report,
        "solve_trace": trace.csv(),
    }


def _checkpoint(attempt: int, at: Search, trace: Trace) -> dict[str, np.ndarray]:
    numbers = {"attempt": np.array(attempt), "trace": np.frombuffer(trace.csv(), np.uint8)}
    return search_arrays(at) | numbers


def _resumed(problem: Problem, trace: Trace, monitor: Monitor) -> tuple[int, Search | None]:
    """The attempt and state of a run that was stopped, or the first and None; the trace goes on from there."""
    saved = monitor.restore(CHECKPOINT)
    if saved is None:
        return 0, None
    trace.go_on(saved["trace"].tobytes())
    return int(saved["attempt"]), search_from(problem, saved)


def _restored_relaxed(problem: Problem, monitor: Monitor) -> list[Search]:
    saved = monitor.restore(RELAXED)
    return [] if saved is None else [search_from(problem, saved)]


def _restored_best(problem: Problem, monitor: Monitor) -> tuple[Search | None, float]:
    saved = monitor.restore(BEST)
    return (None, np.inf) if saved is None else (search_from(problem, saved), float(saved["rms"]))
