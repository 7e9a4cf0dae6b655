"""Which elements a design is rounded, fitted and verified in, and why not in better ones."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from fab4d.design.problem import Problem
from fab4d.mesh.topology import unique_edges
from fab4d.mesh.walls import COARSE_SHARE, walls
from fab4d.stages._design import problem_of

# Bars of 8 linear tets across bend to 0.87 of the true flexibility (model.md section 5): forces are at most 15 % large.
FINE_ELEMENTS = 8.0
# Rounding and flips take some thousand factorisations, and many times more back-substitutions: more unknowns take
# longer than that is worth.
MOST_ROUNDED_DOFS = 60_000
# A last fit and its loading take a hundred.
MOST_FITTED_DOFS = 120_000


@dataclass(frozen=True)
class Elements:
    """linear or quadratic: those in which densities are rounded and labels flipped, and those in which held positions
    are fitted last and the design is verified. left_out : [{what, why}]"""

    rounding: str
    last_fit: str
    left_out: list[dict[str, str]]


def elements_for(mesh: Mapping[str, np.ndarray], wanted: str) -> Elements:
    """The elements for `wanted` (auto, linear, quadratic)."""
    if wanted == "quadratic":
        return Elements(wanted, wanted, [])
    if wanted == "linear":
        return _linear('the scene asks for linear ones ([solver] element = "auto" changes that)')
    across = walls(mesh["X"], mesh["tets"]).fewest(COARSE_SHARE)
    if across >= FINE_ELEMENTS:
        return _linear(f"{across:.3g} linear ones span the thinnest walls, which is fine enough")
    dofs = quadratic_dofs(mesh)
    if dofs > MOST_FITTED_DOFS:
        return _linear(f"{dofs} unknowns take too long (at most {MOST_FITTED_DOFS}), so forces come out too large")
    if dofs > MOST_ROUNDED_DOFS:
        why = f"{dofs} unknowns take too long (at most {MOST_ROUNDED_DOFS})"
        return Elements("linear", "quadratic", [{"what": "rounding in quadratic elements", "why": why}])
    return Elements("quadratic", "quadratic", [])


def _linear(why: str) -> Elements:
    return Elements("linear", "linear", [{"what": "quadratic elements", "why": why}])


def quadratic_dofs(mesh: Mapping[str, np.ndarray]) -> int:
    """Unknowns of the mesh with quadratic elements."""
    return 3 * (len(mesh["X"]) + len(unique_edges(mesh["tets"])[0]))


def element_of(mesh: Mapping[str, np.ndarray], shape: np.ndarray) -> str:
    """The element whose nodes a shape (N, 3) has."""
    return "linear" if len(shape) == len(mesh["X"]) else "quadratic"


def problem_like(mesh: Mapping[str, np.ndarray], materials: Any, shape: np.ndarray) -> Problem:
    """The problem with the element whose nodes a shape (N, 3) has."""
    return problem_of(mesh, materials, element_of(mesh, shape))
