"""The coarser mesh on which designs of large meshes are searched."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from fab4d.design.levels import Level, level_of
from fab4d.design.problem import Problem
from fab4d.materials.cards import MaterialCard
from fab4d.mesh.coarsening import coarsened
from fab4d.stages._design import problem_of
from fab4d.stages.monitor import Monitor

# Meshes of more tets are searched on a coarser one of so many: steps on them take minutes, and hardly lead anywhere
# where squeezed surfaces turn unstable in waves that coarse meshes are too stiff for.
MANY_TETS, COARSE_TETS = 40_000, 20_000
# The relaxed design is rounded on all tets, or where they are more than the first number, on a mesh of the second, and
# carried over from there.
MOST_ROUNDED, ROUNDED_TETS = 100_000, 55_000
# Coarser meshes that keep more than this share of the tets, for thin walls, gain nothing.
MOST_KEPT = 0.6


@dataclass(frozen=True, eq=False)
class Coarse:
    """The coarse mesh, as the arrays X, X_temp, tets and clamp of the `mesh` artifact, and its level."""

    mesh: dict[str, np.ndarray]
    level: Level


def coarse_for(
    problem: Problem, mesh: Mapping[str, np.ndarray], materials: MaterialCard, element: str, monitor: Monitor
) -> list[Coarse]:
    """Coarse meshes of linear elements, each of the one before it; empty where the search is on the mesh itself.

    The search is on the last one, and its relaxed design is rounded on the one before. element : of the rounding
    """
    if element != "linear" or problem.n_tets <= MANY_TETS:
        return []
    monitor.progress("coarsen")
    chain, finer = list[Coarse](), (problem, mesh)
    for n_tets in [ROUNDED_TETS] * (problem.n_tets > MOST_ROUNDED) + [COARSE_TETS]:
        chain.append(coarse_of(*finer, materials, n_tets))
        finer = (chain[-1].level.coarse, chain[-1].mesh)
    return [] if chain[-1].level.coarse.n_tets > MOST_KEPT * problem.n_tets else chain


def coarse_of(problem: Problem, mesh: Mapping[str, np.ndarray], materials: MaterialCard, n_tets: int) -> Coarse:
    """The mesh coarsened to some `n_tets`, or as few as its walls allow."""
    X, X_temp, clamp = mesh["X"], mesh["X_temp"], mesh["clamp"]
    found = coarsened(X, X_temp, mesh["tets"], clamp, n_tets)
    kept = found.vertices
    arrays = {"X": X[kept], "X_temp": X_temp[kept], "tets": found.tets, "clamp": clamp[kept]}
    return Coarse(arrays, level_of(problem_of(arrays, materials, "linear"), problem, kept))
