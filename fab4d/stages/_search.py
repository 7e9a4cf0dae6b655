"""The state of a search as arrays and back."""

from collections.abc import Mapping
from dataclasses import fields
from typing import Any

import numpy as np

from fab4d.design.equilibria import RIG_COMPLIANCE, Equilibria
from fab4d.design.gauss_newton import equilibrate
from fab4d.design.patches import build_patches
from fab4d.design.problem import Problem
from fab4d.design.reduced import Phase, Search
from fab4d.errors import ArtifactError

_NUMBERS = {field.name: field.type for field in fields(Search) if field.type in (bool, int, float)}


def search_arrays(at: Search) -> dict[str, np.ndarray]:
    """All that `search_from` needs to go on as if nothing had happened."""
    design = at.design
    return {
        "phase": np.array(at.phase.value),
        "numbers": np.array([getattr(at, name) for name in _NUMBERS], dtype=np.float64),
        "centers": at.equilibria.patches.centers,
        "rho": design.rho,
        "x": design.median.x,
        "forces": design.median.forces,
        "y": design.final.y,
    }


def search_from(problem: Problem, saved: Mapping[str, np.ndarray]) -> Search:
    """The state that `search_arrays` saved; its shapes are in equilibrium as they are.

    Raises ArtifactError when they are not.
    """
    values = zip(_NUMBERS.items(), saved["numbers"].tolist(), strict=True)
    numbers: dict[str, Any] = {name: kind(value) for (name, kind), value in values}
    equilibria = Equilibria(problem, build_patches(problem, saved["centers"], numbers["patch_radius"]))
    held = equilibria.patches.mean(saved["x"]) + RIG_COMPLIANCE * saved["forces"]
    design = equilibrate(equilibria, saved["rho"], held, saved["x"], saved["forces"], saved["y"])
    if design is None:
        msg = "a saved state of the solver is not in equilibrium: run again with --force"
        raise ArtifactError(msg)
    return Search(equilibria, design, phase=Phase(str(saved["phase"])), **numbers)
