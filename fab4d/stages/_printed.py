"""A near 0/1 design as it will be printed, labels repaired and held positions fitted, and what speaks against it."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from fab4d.design.finish import carried_in
from fab4d.design.forward import program, same_shape
from fab4d.design.gauss_newton import Design
from fab4d.design.objective import ObjectiveWeights, shape_error
from fab4d.design.paths import change_density
from fab4d.design.polish import polish_labels
from fab4d.design.problem import Problem
from fab4d.design.reduced import Search, refit
from fab4d.errors import EquilibriumError
from fab4d.fabrication.labels import ambiguous_fraction, isolated_fraction, rounded_labels
from fab4d.io.scene import Goal, PrinterCard
from fab4d.mesh.tetmesh import BoolArray
from fab4d.stages._flips import flip_settings
from fab4d.stages._limits import limit_reasons
from fab4d.stages._repair import repaired
from fab4d.stages._ways import FEW_STEPS
from fab4d.stages.threshold import acceptance_reasons

# Flips win back a part of what rounding costs: beyond this multiple of the tolerance they do not reach it.
HOPELESS = 3.0


@dataclass(frozen=True, eq=False)
class Printed:
    """What is printed: smp (m,); its RMS error in L0, and its state, inf and None where it has no equilibrium."""

    smp: BoolArray
    rms: float
    design: Design | None


def as_printed(
    problem: Problem,
    mesh: Mapping[str, np.ndarray],
    printer: PrinterCard,
    goal: Goal,
    weights: ObjectiveWeights,
    found: Search,
    good_enough: float = 0.0,
) -> Printed:
    """The design about as stage refit leaves it: printable labels, refitted held positions, then flipped labels.

    The best of few repairs and none by annealing, for this judges many designs. Flips take long: they end at the RMS
    error `good_enough`, L0, and are left out where they cannot reach the tolerance.
    """
    settings = flip_settings(mesh, printer, goal, max(found.relaxed_rms, good_enough))
    smp = repaired(mesh, printer, settings, found, weights, more=0).smp
    try:
        design = change_density(found.equilibria, found.design, smp.astype(np.float64))
    except EquilibriumError:
        return Printed(smp, np.inf, None)
    design = refit(found.equilibria, design, weights, lambda at: None)  # noqa: ARG005
    if good_enough < shape_error(problem, design.final.y).rms < HOPELESS * weights.error_scale:
        design = polish_labels(found.equilibria, design, weights, settings, lambda at: None)  # noqa: ARG005
    return Printed(design.rho > 0.5, shape_error(problem, design.final.y).rms, design)


def refitted_in(problem: Problem, found: Search, printed: Design, weights: ObjectiveWeights) -> float:
    """RMS error, L0, of the printed labels of `found` in the elements of `problem`, which are others of the same mesh.

    Held positions are fitted by a few steps where it is above the tolerance. inf where there is no equilibrium near.
    """
    carried = carried_in(problem, replace(found, design=printed))
    if carried is None:
        return np.inf
    if carried.rms <= weights.error_scale:
        return carried.rms
    fitted = refit(carried.equilibria, carried.design, weights, lambda at: None, FEW_STEPS)  # noqa: ARG005
    return shape_error(problem, fitted.final.y).rms


def smp_share(problem: Problem, smp: BoolArray) -> float:
    """Share of the labels smp (m,) in the volume."""
    return float(problem.volume_fractions[smp].sum())


def faults(
    problem: Problem,
    tets: np.ndarray,
    profile: Mapping[str, Any],
    found: Search,
    printed: Printed,
    largest_rms: float,
) -> list[str]:
    """Why the printed design would be rejected; empty for an acceptable one. largest_rms is in L0.

    profile : sections goal, rig and acceptance
    """
    if printed.design is None:
        return ["the printed labels have no equilibrium near the design"]
    seen = [
        *_goal_faults(problem, profile["goal"].max_smp_fraction, printed, largest_rms),
        *acceptance_reasons(
            ambiguous_fraction(found.design.rho),
            isolated_fraction(tets, rounded_labels(found.design.rho)),
            profile["acceptance"],
        ),
        *limit_reasons(problem, found.equilibria.patches, printed.design, profile),
    ]
    return seen or _loading_faults(found, printed.design)


def _goal_faults(problem: Problem, max_smp: float | None, printed: Printed, largest_rms: float) -> list[str]:
    rms, limit, share = printed.rms * problem.length, largest_rms * problem.length, smp_share(problem, printed.smp)
    seen = [f"the error is {rms:.3g} mm RMS, {limit:.3g} mm are allowed"] if rms > limit else []
    if max_smp is not None and share > max_smp:
        seen.append(f"{share:.1%} of the volume are SMP, {max_smp:.1%} are allowed")
    return seen


def _loading_faults(found: Search, design: Design) -> list[str]:
    """What the simulated loading, which takes long, says against a design that is else acceptable."""
    done = program(found.equilibria, design.rho, design.median.x, design.median.forces)
    if same_shape(done, design.median.x):
        return []
    return ["loading from the permanent shape does not end in the designed state"]
