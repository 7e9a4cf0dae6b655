"""A design that was searched on a coarser mesh, brought to all tets."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from fab4d.design.finish import FINER_MESH, rounded_from
from fab4d.design.levels import Level, carried_up
from fab4d.design.problem import Problem
from fab4d.design.reduced import Phase, ReducedSettings, Search
from fab4d.io.scene import Goal

# A coarse mesh is searched for this share of the tolerance: on the fine one, which is less stiff, the error is larger.
COARSE_SHARE = 0.8
# Relaxed designs beyond this multiple of the tolerance are not rounded where that takes long.
OUT_OF_REACH = 1.25
# A design that was carried over may miss the tolerance by this much: the fit of its held positions wins back as much.
WON_BY_FIT = 1.05

Add = Callable[[str, Search], None]


def brought_up(
    levels: Sequence[Level],
    before: Search,
    found: Search,
    settings_of: Callable[[Problem], ReducedSettings],
    goal: Goal,
    traces: Sequence[Add],
) -> Search | None:
    """The coarse design `found`, `before` rounding, on all tets; None where one of the meshes has no equilibrium near.

    levels : from coarse to fine        settings_of : of a mesh        traces : shown each state of a level

    The equilibria of a finer mesh are others: the design is relaxed further and rounded again on the first one, and on
    those after it, where a step takes minutes, if it misses the tolerance there by more than the later fit wins back.
    """
    at = _Design(before if before.phase is Phase.ROUND else None, found)
    for level, add in zip(levels, traces, strict=True):
        up = _one_up if level is levels[0] else _farther_up
        reached = up(level, at, settings_of(level.fine), goal, add)
        if reached is None:
            return None
        at = reached
    return at.found


@dataclass(frozen=True, eq=False)
class _Design:
    """The near 0/1 design of a mesh, and the relaxed one that it was rounded from; None where it is not."""

    relaxed: Search | None
    found: Search


def affordable(finished: Search | None, goal: Goal) -> bool:
    """Whether there is a design, and it keeps to the goal's share of SMP."""
    if finished is None or goal.max_smp_fraction is None:
        return finished is not None
    return bool(finished.equilibria.problem.volume_fractions @ finished.design.rho <= goal.max_smp_fraction)


def far_off(relaxed: Search, settings: ReducedSettings) -> bool:
    """Whether the relaxed design misses the tolerance by far."""
    return relaxed.relaxed_rms > OUT_OF_REACH * settings.weights.error_scale


def _one_up(level: Level, at: _Design, settings: ReducedSettings, goal: Goal, add: Add) -> _Design | None:
    """The design on the finer mesh, rounded there where it is not far off; else as it is carried over."""
    rounded = None
    if at.relaxed is not None and not far_off(at.relaxed, settings):
        rounded = _rounded(carried_up(level, at.relaxed), settings, goal, add)
    if rounded is not None and rounded.found.rms <= settings.weights.error_scale:
        return rounded
    return _better(rounded, _carried(level, at.found, add))


def _farther_up(level: Level, at: _Design, settings: ReducedSettings, goal: Goal, add: Add) -> _Design | None:
    """The design on a mesh that is finer still, as it is carried over, or rounded there where that is worth it."""
    carried, tolerance = _carried(level, at.found, add), settings.weights.error_scale
    if carried is None or carried.found.rms <= WON_BY_FIT * tolerance or at.found.rms > OUT_OF_REACH * tolerance:
        return carried
    start = carried.found if at.relaxed is None else carried_up(level, at.relaxed)
    return _better(_rounded(start, settings, goal, add), carried)


def _carried(level: Level, at: Search, add: Add) -> _Design | None:
    carried = carried_up(level, at)
    if carried is None:
        return None
    add("carried over", carried)
    return _Design(None, carried)


def _rounded(start: Search | None, settings: ReducedSettings, goal: Goal, add: Add) -> _Design | None:
    """None without a start, where it finds no equilibrium on the way, or needs more SMP than the goal allows."""
    if start is None:
        return None
    further = start

    def watch(phase: str, at: Search) -> None:
        nonlocal further
        if at.phase is Phase.ROUND and not at.iteration:
            further = at
        add(phase, at)

    rounded = rounded_from(start, settings, watch, FINER_MESH)
    return None if rounded is None or not affordable(rounded, goal) else _Design(further, rounded)


def _better(one: _Design | None, other: _Design | None) -> _Design | None:
    return min((each for each in (one, other) if each is not None), key=lambda each: each.found.rms, default=None)
