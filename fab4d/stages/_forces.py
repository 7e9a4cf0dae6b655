"""How far the forces of a verified state are to be trusted: the same hold positions in other or finer elements."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from fab4d.design.equilibria import RIG_COMPLIANCE, Equilibria
from fab4d.design.patches import Patches, patches_from_faces
from fab4d.design.problem import Problem, at_nodes, build_problem
from fab4d.materials.cards import MaterialCard
from fab4d.mesh.quadratic import with_midpoints
from fab4d.mesh.refinement import on_children, refined, refined_faces
from fab4d.mesh.tetmesh import FloatArray
from fab4d.stages._design import patches_of, problem_of
from fab4d.stages._element import quadratic_dofs

# Only one equilibrium is solved on the refined mesh, so it may be larger than a mesh to design on.
MOST_REFINED_DOFS = 100_000
# A design in linear elements is compared with quadratic ones up to here: beyond, that takes longer than the design.
MOST_COMPARED_DOFS = 60_000
# Order with which forces converge on refined meshes of quadratic tets. Smooth states reach 4 (twice that of strains:
# Strang and Fix, An Analysis of the Finite Element Method, 1973); edges of pads, clamps and materials lower it, to
# 1.4 on a bar one tet thick.
REFINED_ORDER = 2
# The same from linear to quadratic elements on one mesh: of bars of 1 to 8 tets, 1/50 to 1/15 of that change is left.
ELEMENT_ORDER = 4
# Of an error estimated from two meshes. Source: Roache, J. Fluids Eng. 116 (1994) 405, the factor of that paper's
# grid convergence index where the order is known.
SAFETY = 1.25
_TOLERANCE, _ITERATIONS = 1e-8, 20
# On a refined mesh each iteration takes seconds; nine were enough wherever an equilibrium was found, and more follow
# short waves in which finer elements buckle.
_REFINED_ITERATIONS = 10


@dataclass(frozen=True, eq=False)
class Held:
    """A state whose hold positions are given to other elements: labels (m,), x (N, 3) and forces (K, 3), no units."""

    equilibria: Equilibria
    rho: FloatArray
    x: FloatArray
    forces: FloatArray

    @property
    def positions(self) -> FloatArray:
        return self.equilibria.patches.mean(self.x) + RIG_COMPLIANCE * self.forces


def force_report(
    mesh: Mapping[str, np.ndarray], materials: MaterialCard, patch_arrays: Mapping[str, np.ndarray], held: Held
) -> dict[str, Any]:
    """`force_change`, `force_uncertainty` (None where they are left out) and `left_out` of verify_report."""
    order = held.equilibria.problem.body.order
    other = _in_other_element(mesh, materials, patch_arrays, held) if _fits(mesh, order) else None
    pair = (other, held.forces) if order == 2 else (held.forces, other)
    finer = _refined_forces(mesh, materials, patch_arrays, held) if order == 2 and _refinable(mesh) else None
    uncertainty = _uncertainty(held, other, finer)
    left_out = [] if uncertainty else [{"what": "uncertainty of the forces", "why": _why_not(mesh, order)}]
    change = None if other is None else _change(held.equilibria.problem.force, *pair)
    return {"force_change": change, "force_uncertainty": uncertainty, "left_out": left_out}


def _fits(mesh: Mapping[str, np.ndarray], order: int) -> bool:
    return order == 2 or quadratic_dofs(mesh) <= MOST_COMPARED_DOFS


def _refinable(mesh: Mapping[str, np.ndarray]) -> bool:
    return quadratic_dofs({"X": np.zeros(quadratic_dofs(mesh) // 3), "tets": _fine(mesh)[1]}) <= MOST_REFINED_DOFS


def _why_not(mesh: Mapping[str, np.ndarray], order: int) -> str:
    if not _fits(mesh, order):
        return f"quadratic elements to compare with would have {quadratic_dofs(mesh)} unknowns"
    return "no equilibrium was found at these hold positions with other elements"


def _change(unit: float, linear: FloatArray, quadratic: FloatArray) -> dict[str, Any]:
    """Sizes of the forces in both elements, N, and the largest difference over the largest force."""
    sizes = {"linear": _sizes(linear) * unit, "quadratic": _sizes(quadratic) * unit}
    largest = float(_sizes(quadratic - linear).max() * unit / sizes["quadratic"].max())
    return {"linear_N": sizes["linear"].tolist(), "quadratic_N": sizes["quadratic"].tolist(), "largest": largest}


def _uncertainty(held: Held, other: FloatArray | None, finer: FloatArray | None) -> dict[str, Any] | None:
    """What the true force of each point may be off by, N, by the best comparison there is."""
    is_quadratic = held.equilibria.problem.body.order == 2
    if finer is not None:
        method, order = "quadratic elements on a mesh refined 1:8", REFINED_ORDER
        off = SAFETY * 2**order / (2**order - 1) * _sizes(finer - held.forces)
    elif other is not None:
        order = ELEMENT_ORDER
        name = "linear" if is_quadratic else "quadratic"
        method = f"Richardson extrapolation from {name} elements at the same positions, order {order}"
        off = (SAFETY / (2**order - 1) + (0 if is_quadratic else 1)) * _sizes(other - held.forces)
    else:
        return None
    newton, sizes = off * held.equilibria.problem.force, _sizes(held.forces) * held.equilibria.problem.force
    return {
        "method": method,
        "order": order,
        "N": newton.tolist(),
        "relative": (newton / sizes).tolist(),
        "largest": float(newton.max() / sizes.max()),
    }


def _in_other_element(
    mesh: Mapping[str, np.ndarray], materials: MaterialCard, patch_arrays: Mapping[str, np.ndarray], held: Held
) -> FloatArray | None:
    if held.equilibria.problem.body.order == 2:
        problem = problem_of(mesh, materials, "linear")
        x = held.x[: len(mesh["X"])]
    else:
        problem = problem_of(mesh, materials, "quadratic")
        x = at_nodes(problem, held.x)
    return _forces_at(problem, patches_of(problem, patch_arrays), held, held.rho, x)


def _refined_forces(
    mesh: Mapping[str, np.ndarray], materials: MaterialCard, patch_arrays: Mapping[str, np.ndarray], held: Held
) -> FloatArray | None:
    X, tets, edges = _fine(mesh)
    clamp = np.r_[mesh["clamp"], mesh["clamp"][edges].all(axis=1)]
    problem = build_problem(X, with_midpoints(mesh["X_temp"], edges), tets, clamp, materials, "quadratic")
    faces = refined_faces(patch_arrays["patch_faces"], edges, len(mesh["X"]))
    patches = patches_from_faces(problem, patch_arrays["patch_center"], faces, 4 * patch_arrays["patch_offsets"])
    x = on_children(held.equilibria.problem.body.elements, held.x, problem.body.elements, problem.n_nodes)
    return _forces_at(problem, patches, held, np.repeat(held.rho, 8), x, _REFINED_ITERATIONS)


def _fine(mesh: Mapping[str, np.ndarray]) -> tuple[FloatArray, np.ndarray, np.ndarray]:
    """Vertices and tets of the mesh refined 1:8, and the edges halved."""
    fine = refined(mesh["tets"], len(mesh["X"]))
    return with_midpoints(mesh["X"], fine.edges), fine.tets, fine.edges


def _forces_at(
    problem: Problem, patches: Patches, held: Held, rho: FloatArray, x: FloatArray, iterations: int = _ITERATIONS
) -> FloatArray | None:
    """(K, 3) forces at the same hold positions in another discretisation, None without an equilibrium near x."""
    equilibria = Equilibria(problem, patches)
    median = equilibria.solve_median(rho, held.positions, x, held.forces, _TOLERANCE, iterations)
    return median.forces if median.solution.converged else None


def _sizes(forces: FloatArray) -> FloatArray:
    return np.linalg.norm(forces, axis=1)
