"""A design that was searched on a coarser mesh, brought to all tets."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

from fab4d.design.finish import rounded_from
from fab4d.design.levels import Level, carried_up
from fab4d.design.objective import shape_error
from fab4d.design.problem import Problem
from fab4d.design.reduced import Phase, ReducedSettings, Search
from fab4d.io.scene import Goal

# A coarse mesh is searched for this share of the tolerance: on the fine one, which is less stiff, the error is larger.
COARSE_SHARE = 0.8
# Relaxed designs beyond this multiple of the tolerance are not rounded where that takes long.
OUT_OF_REACH = 1.25

Add = Callable[[str, Search], None]


@dataclass(frozen=True, eq=False)
class _Brought:
    """A design on one of the meshes: `relaxed`, where it is known so, and near 0/1 as `found`."""

    relaxed: Search | None
    found: Search


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
    those after it where it would miss the tolerance.
    """
    at: _Brought | None = _Brought(before if before.phase is Phase.ROUND else None, found)
    for number, (level, add) in enumerate(zip(levels, traces, strict=True)):
        at = None if at is None else _one_up(level, at, settings_of(level.fine), goal, add, again=number == 0)
    return None if at is None else at.found


def affordable(finished: Search | None, goal: Goal) -> bool:
    """Whether there is a design, and it keeps to the goal's share of SMP."""
    if finished is None or goal.max_smp_fraction is None:
        return finished is not None
    return bool(finished.equilibria.problem.volume_fractions @ finished.design.rho <= goal.max_smp_fraction)


def far_off(relaxed: Search, settings: ReducedSettings) -> bool:
    """Whether the relaxed design misses the tolerance by far."""
    return relaxed.relaxed_rms > OUT_OF_REACH * settings.weights.error_scale


def _one_up(
    level: Level, at: _Brought, settings: ReducedSettings, goal: Goal, add: Add, *, again: bool
) -> _Brought | None:
    """The design on the finer mesh; rounded `again` there, or only where it misses the tolerance or hardly meets it on
    the coarser one."""
    tolerance = settings.weights.error_scale
    relaxed = at.relaxed if again or at.relaxed is None or not far_off(at.relaxed, settings) else None
    hardly = again or _rms(at.found) > COARSE_SHARE * tolerance
    carried = None if relaxed is not None and hardly else _carried(level, at.found, add)
    if carried is not None and _rms(carried) <= tolerance:
        return _Brought(None, carried)
    rounded = None if relaxed is None else _rounded(level, relaxed, settings, goal, add)
    if rounded is not None and (carried is None or _rms(rounded.found) < _rms(carried)):
        return rounded
    carried = carried or _carried(level, at.found, add)
    return None if carried is None else _Brought(None, carried)


def _carried(level: Level, at: Search, add: Add) -> Search | None:
    carried = carried_up(level, at)
    if carried is not None:
        add("carried over", carried)
    return carried


def _rounded(level: Level, before: Search, settings: ReducedSettings, goal: Goal, add: Add) -> _Brought | None:
    """None where it finds no equilibrium on the way, or needs more SMP than the goal allows."""
    start = carried_up(level, before)
    if start is None:
        return None
    relaxed = None

    def watch(phase: str, at: Search) -> None:
        nonlocal relaxed
        add(phase, at)
        if at.phase is Phase.ROUND and at.iteration == 0:
            relaxed = at

    found = rounded_from(start, replace(settings, nearly=1.0), watch)
    return _Brought(relaxed, found) if found is not None and affordable(found, goal) else None


def _rms(at: Search) -> float:
    return shape_error(at.equilibria.problem, at.design.final.y).rms
