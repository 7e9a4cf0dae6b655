"""Which element the last fit and the verification use, and why not the better one."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from fab4d.design.problem import Problem
from fab4d.mesh.topology import unique_edges
from fab4d.mesh.walls import COARSE_SHARE, walls
from fab4d.stages._design import problem_of

# Bars of 8 linear tets across bend to 0.87 of the true flexibility (model.md section 5): forces are at most 15 % large.
FINE_ELEMENTS = 8.0
# More unknowns take longer than a design is worth: rounding, fit, verification and sensitivities take some 800
# factorisations, and many times more back-substitutions.
MOST_QUADRATIC_DOFS = 32_000


def element_for(mesh: Mapping[str, np.ndarray], wanted: str) -> tuple[str, list[dict[str, str]]]:
    """The element for `wanted` (auto, linear, quadratic) and what is left out: [{what, why}]."""
    if wanted == "quadratic":
        return wanted, []
    if wanted == "linear":
        return wanted, [_left_out('the scene asks for linear ones ([solver] element = "auto" changes that)')]
    across = walls(mesh["X"], mesh["tets"]).fewest(COARSE_SHARE)
    if across >= FINE_ELEMENTS:
        return "linear", [_left_out(f"{across:.3g} linear ones span the thinnest walls, which is fine enough")]
    dofs = quadratic_dofs(mesh)
    if dofs > MOST_QUADRATIC_DOFS:
        why = f"{dofs} unknowns take too long (at most {MOST_QUADRATIC_DOFS}), so forces come out too large"
        return "linear", [_left_out(why)]
    return "quadratic", []


def quadratic_dofs(mesh: Mapping[str, np.ndarray]) -> int:
    """Unknowns of the mesh with quadratic elements."""
    return 3 * (len(mesh["X"]) + len(unique_edges(mesh["tets"])[0]))


def element_of(mesh: Mapping[str, np.ndarray], shape: np.ndarray) -> str:
    """The element whose nodes a shape (N, 3) has."""
    return "linear" if len(shape) == len(mesh["X"]) else "quadratic"


def problem_like(mesh: Mapping[str, np.ndarray], materials: Any, shape: np.ndarray) -> Problem:
    """The problem with the element whose nodes a shape (N, 3) has."""
    return problem_of(mesh, materials, element_of(mesh, shape))


def _left_out(why: str) -> dict[str, str]:
    return {"what": "quadratic elements", "why": why}
