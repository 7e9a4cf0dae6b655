"""What keeps a scene from its goal where even relaxed designs miss it, and a design from what the rig can do."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from fab4d.design.gauss_newton import Design
from fab4d.design.objective import force_excess, pushes, shape_error, stretch_excess
from fab4d.design.patches import Patches, outward_normals
from fab4d.design.problem import Problem
from fab4d.design.reduced import ReducedSettings, Search, relaxed
from fab4d.errors import EquilibriumError
from fab4d.stages._settings import search_settings
from fab4d.stages.monitor import Monitor

# Where the tolerance is far out of reach, what so many times the points would leave of the error tells whether points
# are what is missing.
MANY_MORE = 4


@dataclass(frozen=True)
class MorePoints:
    """A number of points, and the RMS error, L0, of the relaxed design with them."""

    count: int
    rms: float


def more_points(problem: Problem, settings: ReducedSettings, monitor: Monitor) -> MorePoints | None:
    """What MANY_MORE times the points would reach; None where no equilibrium is found with them."""
    many = replace(settings, n_points=MANY_MORE * settings.n_points)

    def watch(at: Search) -> None:
        monitor.progress("more points", rms_mm=at.rms * problem.length, forces=at.equilibria.patches.count)

    try:
        at = relaxed(problem, many, watch)
    except EquilibriumError:
        return None
    return MorePoints(at.equilibria.patches.count, at.relaxed_rms)


def limited_by(
    problem: Problem, profile: Mapping[str, Any], found: Search, more: MorePoints | None = None
) -> str | None:
    """What keeps the relaxed design, each tet any mixture, from the goal; None where it comes near enough."""
    weights = search_settings(problem, profile).weights
    if reached(found) <= weights.error_scale:
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
    left = reached(found) * problem.length
    return (
        f"{what}: with any mixture of materials in each tet the error stays at {left:.3g} mm, "
        f"most of all near ({place}) mm of the printed part"
    ) + ("" if more is None else _outlook(problem, weights.error_scale, more))


def _outlook(problem: Problem, tolerance: float, more: MorePoints) -> str:
    left = f"{more.count} points would leave {more.rms * problem.length:.3g} mm"
    if more.rms <= tolerance:
        return f"; {left}"
    return (
        f"; even {left}: the temporary shape asks for more than pulling at points does, so change it or the tolerance"
    )


def reached(found: Search) -> float:
    """The RMS error, L0, of the relaxed design, or of the rounded one where rounding has gone on to lower it."""
    return min(found.relaxed_rms, found.rms)


def limit_reasons(problem: Problem, patches: Patches, design: Design, profile: Mapping[str, Any]) -> list[str]:
    """What of the rig's limits the design does not keep."""
    rig, forces = profile["rig"], design.median.forces * problem.force
    sizes = np.linalg.norm(forces, axis=1)
    reasons = []
    if len(sizes) and sizes.max() > rig.max_force * (1 + 1e-3):
        point = int(sizes.argmax())
        reasons.append(f"point {point + 1} needs {sizes[point]:.4g} N, the rig gives {rig.max_force:g} N")
    if rig.pull_only and patches.count:
        outward = (forces * outward_normals(patches, design.median.x)).sum(axis=1)
        if (outward < 0).any():
            pushed = ", ".join(str(k + 1) for k in np.flatnonzero(outward < 0))
            reasons.append(f"the rig only pulls, but points {pushed} are pushed")
    return reasons
