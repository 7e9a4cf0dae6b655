"""A design that was searched on a coarser mesh, brought to all tets."""

from collections.abc import Callable, Sequence
from dataclasses import replace

from fab4d.design.finish import FINER_MESH, rounded_from
from fab4d.design.levels import Level, carried_up
from fab4d.design.objective import shape_error
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
    first, *others = levels
    relaxed = before if before.phase is Phase.ROUND else None
    at = _one_up(first, relaxed, found, settings_of(first.fine), goal, traces[0])
    for level, add in zip(others, traces[1:], strict=True):
        at = None if at is None else _farther_up(level, at, settings_of(level.fine), goal, add)
    return at


def affordable(finished: Search | None, goal: Goal) -> bool:
    """Whether there is a design, and it keeps to the goal's share of SMP."""
    if finished is None or goal.max_smp_fraction is None:
        return finished is not None
    return bool(finished.equilibria.problem.volume_fractions @ finished.design.rho <= goal.max_smp_fraction)


def far_off(relaxed: Search, settings: ReducedSettings) -> bool:
    """Whether the relaxed design misses the tolerance by far."""
    return relaxed.relaxed_rms > OUT_OF_REACH * settings.weights.error_scale


def _one_up(
    level: Level, relaxed: Search | None, found: Search, settings: ReducedSettings, goal: Goal, add: Add
) -> Search | None:
    """The design on the finer mesh, rounded there where it is not far off; else as it is carried over."""
    tolerance = settings.weights.error_scale
    rounded = None
    if relaxed is not None and not far_off(relaxed, settings):
        rounded = _rounded(level, relaxed, settings, goal, add)
    if rounded is not None and _rms(rounded) <= tolerance:
        return rounded
    reached = [each for each in (rounded, _carried(level, found, add)) if each is not None]
    return min(reached, key=_rms, default=None)


def _farther_up(level: Level, at: Search, settings: ReducedSettings, goal: Goal, add: Add) -> Search | None:
    """The near 0/1 design on a mesh that is finer still."""
    carried, tolerance = carried_up(level, at), settings.weights.error_scale
    if carried is None or _rms(carried) <= WON_BY_FIT * tolerance or _rms(at) > OUT_OF_REACH * tolerance:
        return _shown(carried, add)
    rounded = rounded_from(carried, replace(settings, nearly=1.0), add, FINER_MESH)
    if rounded is not None and affordable(rounded, goal) and _rms(rounded) < _rms(carried):
        return rounded
    return _shown(carried, add)


def _carried(level: Level, at: Search, add: Add) -> Search | None:
    return _shown(carried_up(level, at), add)


def _shown(carried: Search | None, add: Add) -> Search | None:
    if carried is not None:
        add("carried over", carried)
    return carried


def _rounded(level: Level, relaxed: Search, settings: ReducedSettings, goal: Goal, add: Add) -> Search | None:
    """None where it finds no equilibrium on the way, or needs more SMP than the goal allows."""
    start = carried_up(level, relaxed)
    rounded = None if start is None else rounded_from(start, replace(settings, nearly=1.0), add, FINER_MESH)
    return rounded if affordable(rounded, goal) else None


def _rms(at: Search) -> float:
    return shape_error(at.equilibria.problem, at.design.final.y).rms
