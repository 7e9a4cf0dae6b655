"""Labels of bars and what flips of them do, for tests of flips."""

from dataclasses import replace

import numpy as np

from fab4d.design.equilibria import Equilibria
from fab4d.design.flips import FlipSettings
from fab4d.design.gauss_newton import Design
from fab4d.design.influence import FlipEnergy, Influence, influence
from fab4d.design.objective import ObjectiveWeights
from fab4d.design.problem import Problem
from fab4d.fabrication.annealing import annealer

WEIGHTS = ObjectiveWeights(error_scale=1e-3)


def freely(problem: Problem) -> FlipSettings:
    """All labels can be printed that pinch nothing."""
    annealed = annealer(problem.body.elements[:, :4], problem.volume_fractions)
    return FlipSettings(printable=lambda smp: smp, annealed=annealed, target_rms=0.0)


def recording(settings: FlipSettings, energies: list[FlipEnergy]) -> FlipSettings:
    """The same, each energy added to the list."""

    def annealed(labels: np.ndarray, energy: FlipEnergy, *rest: float) -> np.ndarray:
        energies.append(energy)
        return settings.annealed(labels, energy, *rest)

    return replace(settings, annealed=annealed)


def at_all_tets(equilibria: Equilibria, design: Design) -> Influence:
    return influence(equilibria, design, np.arange(equilibria.problem.n_tets), WEIGHTS)


def upper_half(problem: Problem) -> np.ndarray:
    X = problem.body.X
    return X[problem.body.elements].mean(axis=1)[:, 2] > 0.5 * X[:, 2].max()
