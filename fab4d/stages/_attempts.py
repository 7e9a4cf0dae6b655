"""The search on one mesh: attempts until one prints well enough, each of which a stopped run goes on with."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from fab4d.design.gauss_newton import Design
from fab4d.design.problem import Problem
from fab4d.design.reduced import Phase, ReducedSettings, Search, Watch, fewest_points, relaxed, solve_reduced
from fab4d.design.starts import BEGINNINGS
from fab4d.stages._bring_up import far_off
from fab4d.stages._design import Trace, problem_of
from fab4d.stages._finish import CERTAINLY_ENOUGH, NOT_LINEAR, Finish, finished, judged
from fab4d.stages._least import RELAXED
from fab4d.stages._limits import MorePoints, more_points, reached
from fab4d.stages._printed import as_printed, refitted_in
from fab4d.stages._search import search_arrays, search_from
from fab4d.stages._settings import ATTEMPTS, most_points, search_settings
from fab4d.stages._starts import Starts
from fab4d.stages.monitor import Monitor

CHECKPOINT, BEST, POINTS = "iterate", "best", "points"
# Flips of the last fit bring the error of a printed design down from this multiple of the tolerance.
FLIPS_WIN_BACK = 1.5
# Where the scene names no number of points: the fewest whose relaxed design is at this share of the tolerance, for
# printing mostly costs less than the rest, and in later attempts as many times more.
RELAXED_SHARE = 0.8
MORE_POINTS = (1.0, 1.3, 1.8)


@dataclass(frozen=True, eq=False)
class Attempts:
    """What the attempts came to.

    found : the best design, rounded in linear elements, or else still relaxed        settings : of the last attempt
    count : of the attempts made
    relaxed : the last design before rounding
    printed_rms : RMS error of `found` as printed, L0, inf where it was not judged
    finish : of the last relaxed design
    more_points : what more points would reach, where these are far from the tolerance
    """

    found: Search
    relaxed: Search
    settings: ReducedSettings
    count: int
    printed_rms: float
    finish: Finish
    more_points: MorePoints | None = None


@dataclass(frozen=True, eq=False)
class _Linear:
    """A design rounded in linear elements as printed: its state, None without an equilibrium, and its RMS error, L0.

    in_fit : that in the elements of the last fit; None where it is not known
    """

    design: Design | None
    rms: float
    in_fit: float | None = None


def attempts(
    problem: Problem,
    mesh: Mapping[str, np.ndarray],
    profile: Mapping[str, Any],
    element: str,
    trace: Trace,
    monitor: Monitor,
    more_beginnings: int,
) -> Attempts:
    """The best design of the attempts.

    Where the elements of the last fit round the first relaxed design well, nothing is rounded in linear ones.
    """
    first, start = _resumed(problem, trace, monitor)
    best, least = _restored_best(problem, monitor)
    printed: _Linear | None = None
    before_rounding = [] if start is None else _restored_relaxed(problem, monitor)
    count, finishes = _points(problem, profile, trace, monitor), dict[int, Finish]()
    enough = profile["goal"].smp == "enough"

    def settings_of(other: Problem) -> ReducedSettings:
        return search_settings(other, profile, 0, count)

    outlook: MorePoints | None = None
    starts = Starts(problem, mesh, profile["materials"], settings_of, trace, monitor, most=more_beginnings * BEGINNINGS)
    for attempt in range(first, len(ATTEMPTS)):
        settings = search_settings(problem, profile, attempt, _tried(profile, attempt, count))
        watch = _watch(attempt, start, trace, monitor, before_rounding)
        at = relaxed(problem, replace(settings, centers=starts.chosen()), watch, start)
        if attempt == 0 and _asked(profile, settings):
            at = starts.best(at, _watch(attempt, None, trace, monitor, before_rounding))
        if attempt == 0 and enough and at.phase is Phase.ROUND and at.iteration == 0:
            finish = judged(finished(mesh, profile, element, at, settings, trace), mesh, profile, settings)
            finishes[attempt] = finish
            if finish.printed_rms <= settings.weights.error_scale:
                return Attempts(at, at, settings, 1, np.inf, replace(finish, left_out=(NOT_LINEAR,)))
        if attempt == 0 and _asked(profile, settings) and far_off(at, settings):
            monitor.progress("out of reach", rms_mm=at.relaxed_rms * problem.length, forces=settings.n_points)
            outlook = more_points(problem, settings, monitor)
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
        finish = judged(finished(mesh, profile, element, last, settings, trace), mesh, profile, settings)
        finishes[attempt] = finish
    finish = finishes.get(attempt, Finish())
    if finish.found is not None and finish.printed_rms > CERTAINLY_ENOUGH * settings.weights.error_scale:
        printed = printed or _linear_printed(problem, mesh, profile, element, settings, best)
        if _prints_better(best, printed, finish.found.equilibria.problem, finish.printed_rms, settings):
            finish = Finish(left_out=finish.left_out)
    return Attempts(best, last, settings, attempt + 1, least, finish, outlook)


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


def _prints_better(best: Search, printed: _Linear, problem: Problem, rms: float, settings: ReducedSettings) -> bool:
    """Whether the design `best`, rounded in linear elements, errs by less than rms, L0, as printed in those of
    `problem`."""
    if printed.design is None:
        return False
    in_fit = printed.in_fit
    if in_fit is None:
        in_fit = refitted_in(problem, best, printed.design, settings.weights)
    return in_fit < rms


def _watch(attempt: int, start: Search | None, trace: Trace, monitor: Monitor, before_rounding: list[Search]) -> Watch:
    """Keeps every state, and adds those that are about to be rounded to `before_rounding`.

    Tets that rounding leaves are decided from where it ended: a run that is stopped meanwhile goes on from there.
    """
    phase = "start" if start is None else start.phase.value

    def watch(at: Search) -> None:
        nonlocal phase
        if phase == Phase.DONE.value:
            trace.add(Phase.ROUND.value, at)
            return
        trace.add(phase, at)
        phase = at.phase.value
        monitor.save(CHECKPOINT, _checkpoint(attempt, at, trace))
        if at.phase is Phase.ROUND and at.iteration == 0:
            monitor.save(RELAXED, search_arrays(at))
            before_rounding.append(at)

    return watch


def _hopeless(profile: Mapping[str, Any], settings: ReducedSettings, found: Search) -> bool:
    """Whether other attempts, which make rounding cost less, cannot help: the relaxed design misses the tolerance."""
    return _asked(profile, settings) and reached(found) > settings.weights.error_scale


def _asked(profile: Mapping[str, Any], settings: ReducedSettings) -> bool:
    """Whether there cannot be more points."""
    return profile["goal"].max_forces is not None or settings.n_points == profile["rig"].max_points


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
