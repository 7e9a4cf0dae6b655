"""A relaxed design of linear elements, rounded in those of the last fit."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from fab4d.design.finish import ANY_SHARE, OTHER_ELEMENTS, carried_in, relaxed_clear, relaxed_from, rounded_on
from fab4d.design.problem import Problem
from fab4d.design.reduced import Phase, ReducedSettings, Search, relaxed
from fab4d.errors import EquilibriumError
from fab4d.stages._bring_up import affordable, far_off
from fab4d.stages._design import Trace, problem_of
from fab4d.stages._printed import as_printed

# A design rounded in the elements of the last fit prints well enough, if its RMS error is at most this share of the
# tolerance: repairs of its labels cost less than the rest.
CERTAINLY_ENOUGH = 0.5
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


@dataclass(frozen=True, eq=False)
class Finish:
    """The relaxed design rounded in the elements of the last fit, None where it is not, and what was left out.

    printed_rms : RMS error as printed, L0; of the design itself where that is certainly enough
    """

    found: Search | None = None
    left_out: tuple[dict[str, str], ...] = ()
    printed_rms: float = np.inf


def finished(
    mesh: Mapping[str, np.ndarray],
    profile: Mapping[str, Any],
    element: str,
    relaxed: Search,
    settings: ReducedSettings,
    trace: Trace,
) -> Finish:
    """The relaxed design rounded in the elements of the last fit.

    Not where these are linear, lose it on the way or need more SMP than the goal allows, where it misses the tolerance
    by far, and where linear elements do as well.
    """
    if element == "linear" or relaxed.phase is not Phase.ROUND:
        return Finish()
    if far_off(relaxed, settings):
        return Finish(left_out=(NOT_QUADRATIC,))
    carried = carried_in(problem_of(mesh, profile["materials"], element), relaxed)
    if carried is None:
        return Finish()
    if carried.rms <= LINEAR_HOLDS * relaxed.relaxed_rms:
        trace.add("carried over", carried)
        return Finish(left_out=(LINEAR_ROUNDS,))
    found = _rounded_in(carried, relaxed.relaxed_rms, settings, trace)
    return Finish(found if affordable(found, profile["goal"]) else None)


def judged(
    finish: Finish, mesh: Mapping[str, np.ndarray], profile: Mapping[str, Any], settings: ReducedSettings
) -> Finish:
    """The same with its error as printed, without flips, which take minutes in the elements of the last fit."""
    found, weights = finish.found, settings.weights
    if found is None:
        return finish
    rms = found.rms
    if rms > CERTAINLY_ENOUGH * weights.error_scale:
        rms = as_printed(
            found.equilibria.problem, mesh, profile["printer"], profile["goal"], weights, found, good_enough=np.inf
        ).rms
    return replace(finish, printed_rms=rms)


def _rounded_in(carried: Search, linear_rms: float, settings: ReducedSettings, trace: Trace) -> Search | None:
    """A near 0/1 design in the elements that a relaxed one was carried over to, or found there where these lose it.

    linear_rms : RMS error, L0, of the relaxed design in linear elements
    None where no equilibria lead to one, or it misses the tolerance by far when relaxed and no other is found.
    """
    tolerance = settings.weights.error_scale
    further = relaxed_from(carried, settings, trace.add, OTHER_ELEMENTS.relax_iterations)
    lost = further.at.relaxed_rms > max(LOST * linear_rms, LOST_SHARE * tolerance)
    far = far_off(further.at, settings)
    # What keeping clear of unstable states costs, rounding may win back.
    rounded = None if lost or (far and not further.clear) else rounded_on(further, trace.add, OTHER_ELEMENTS.most_left)
    if rounded is None and carried.rms > tolerance:
        rounded = _found_in(carried.equilibria.problem, replace(settings, patch_radii=(carried.patch_radius,)), trace)
    if rounded is None and lost and not far:
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
    settings = replace(settings, relax_iterations=OTHER_ELEMENTS.relax_iterations, nearly=1.0)
    return rounded_on(relaxed_clear(at, settings, trace.add), trace.add, ANY_SHARE)
