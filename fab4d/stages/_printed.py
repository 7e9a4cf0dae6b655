"""A near 0/1 design as it will be printed: repaired labels, and held positions fitted to them."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from fab4d.design.gauss_newton import Design
from fab4d.design.objective import ObjectiveWeights, shape_error
from fab4d.design.problem import Problem
from fab4d.design.reduced import Search, change_density, refit
from fab4d.errors import EquilibriumError
from fab4d.io.scene import PrinterCard
from fab4d.mesh.tetmesh import BoolArray
from fab4d.stages.threshold import labels_for


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
    weights: ObjectiveWeights,
    found: Search,
) -> Printed:
    """The design with printable labels and refitted held positions."""
    smp = labels_for(mesh["X"], mesh["tets"], found.design.rho, printer).smp
    try:
        design = change_density(found.equilibria, found.design, smp.astype(np.float64))
    except EquilibriumError:
        return Printed(smp, np.inf, None)
    design = refit(found.equilibria, design, weights, lambda at: None)  # noqa: ARG005
    return Printed(smp, shape_error(problem, design.final.y).rms, design)
