"""Stage `verify`: the finished design as simulated from the permanent shape; its end state is what is delivered."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from fab4d.design.equilibria import Equilibria
from fab4d.design.forward import Programming, balance, program, programmed_to, same_shape
from fab4d.design.gauss_newton import Design
from fab4d.design.problem import Problem
from fab4d.mesh.distance import shape_error
from fab4d.mesh.measures import vertex_areas
from fab4d.mesh.tetmesh import FloatArray
from fab4d.stages._design import patch_arrays, patches_of
from fab4d.stages._element import problem_like
from fab4d.stages._forces import Held, force_report
from fab4d.stages.monitor import Monitor

NO_FORCES: dict[str, Any] = {"force_change": None, "force_uncertainty": None, "left_out": []}


def run(inputs: Mapping[str, Any], profile: Mapping[str, Any], monitor: Monitor) -> dict[str, Any]:
    """Load step by step from the permanent shape, cool, unload; measure what comes out.

    A loading that the stage before has followed to this design is not followed again: its end is solved and measured.
    """
    mesh, printed, loaded, materials = inputs["mesh"], inputs["printed"], inputs["loaded"], profile["materials"]
    smp = inputs["labels"]["smp"].astype(np.float64)
    problem = problem_like(mesh, materials, printed["x"])
    equilibria = Equilibria(problem, patches_of(problem, printed))
    monitor.progress("load")
    x = printed["x"] / problem.length
    if loaded is None:
        done = program(equilibria, smp, x, printed["patch_force"] / problem.force)
    else:
        at, forces, y = (
            loaded["x"] / problem.length,
            loaded["patch_force"] / problem.force,
            loaded["y"] / problem.length,
        )
        done = programmed_to(equilibria, smp, at, forces, y, int(loaded["load_steps"]))
    residual = balance(equilibria, smp, done.median, done.final)
    y = done.final.y * problem.length
    n = len(mesh["X"])
    error = shape_error(y[:n], mesh["X_temp"], problem.faces, vertex_areas(mesh["X"], problem.faces))
    stretched = _stretch_reasons(problem, mesh, done.median.x, smp, materials)
    reasons = _path_reasons(problem, done, x) + stretched
    report = {
        "element_order": problem.body.order,
        "equilibrium_residual": {"median": residual.median, "final": residual.final},
        "min_det_F": residual.min_det_F,
        "error": {"rms": error.rms, "max": error.max, "hausdorff": error.hausdorff},
        "load_steps": done.load_steps,
        "reached": not _path_reasons(problem, done, x),
        "reasons": reasons,
    }
    monitor.progress("forces")
    held = Held(equilibria, smp, done.median.x, done.median.forces)
    trust = force_report(mesh, materials, printed, held) if equilibria.patches.count else NO_FORCES
    return {"state": _state(equilibria, smp, done), "verify_report": report | trust}


def _path_reasons(problem: Problem, done: Programming, x: FloatArray) -> list[str]:
    if done.loaded < 1.0:
        return [f"loading from the permanent shape stops after {done.loaded:.0%} of the way: no equilibrium further on"]
    if done.unloaded < 1.0:
        return [f"unloading stops after {done.unloaded:.0%} of the way: no equilibrium further on"]
    if not same_shape(done, x):
        distance = float(np.linalg.norm(done.median.x - x, axis=1).max())
        return [
            f"loading from the permanent shape ends {distance * problem.length:.3g} mm off the designed median shape"
        ]
    return []


def _stretch_reasons(
    problem: Problem, mesh: Mapping[str, np.ndarray], x: FloatArray, smp: FloatArray, materials: Any
) -> list[str]:
    """Materials that the median shape x (N, 3) stretches beyond their card's limit, as the mean of a tet."""
    body = problem.body
    F = np.einsum("mai,maj->mij", x[body.elements], body.dN.mean(axis=1))
    stretch = np.linalg.svd(F, compute_uv=False)[:, 0]
    reasons = []
    for name, inside, limit in (
        ("SMP", smp > 0, materials.smp_max_stretch),
        ("TPE", smp == 0, materials.tpe_max_stretch),
    ):
        over = inside & (stretch > limit)
        if over.any():
            tet = int(np.argmax(np.where(over, stretch, 0.0)))
            reasons.append(
                f"{name} is stretched {stretch[tet]:.3g} times in tet {mesh['tet_map'][tet]} "
                f"({int(over.sum())} tets in all); the card allows {limit:g}"
            )
    return reasons


def _state(equilibria: Equilibria, smp: FloatArray, done: Programming) -> dict[str, np.ndarray]:
    """The state artifact: what design.vtu shows and the rig sheet is made from, in mm and N."""
    problem, patches = equilibria.problem, equilibria.patches
    L0, force = problem.length, problem.force
    g, _, _ = equilibria.median_gradient(smp, done.median.x)
    held = np.full(problem.n_nodes, -1)
    held[patches.nodes] = patches.rows
    x = done.median.x * L0
    reaction = g[problem.clamp] * force
    arms = x[problem.clamp] - x[problem.clamp].mean(axis=0) if problem.clamp.any() else np.zeros((0, 3))
    design = Design(smp, done.median, done.final)
    return {
        "nodes": problem.body.X * L0,
        "elements": problem.body.elements,
        "x": x,
        "y": done.final.y * L0,
        "force": patches.spread(done.median.forces, problem.n_nodes) * force,
        "held": held,
        "clamp": problem.clamp,
        "clamp_reaction": reaction.sum(axis=0),
        "clamp_moment": np.cross(arms, reaction).sum(axis=0),
        **patch_arrays(problem, patches, design),
    }
