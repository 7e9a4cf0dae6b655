"""Stage `refit`: the held positions that are best for the labels that will be printed."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from fab4d.design.equilibria import Equilibria
from fab4d.design.forward import Programming, program, same_shape
from fab4d.design.gauss_newton import Design, held_positions
from fab4d.design.objective import ObjectiveWeights
from fab4d.design.patches import Patches
from fab4d.design.problem import Problem
from fab4d.design.reduced import Search, change_density, polished, refit
from fab4d.errors import EquilibriumError
from fab4d.io.scene import Weights
from fab4d.mesh.measures import face_area_vectors
from fab4d.mesh.tetmesh import FloatArray
from fab4d.stages._design import Trace, objective_weights, patch_arrays, patches_of, problem_of, tau_seconds
from fab4d.stages.monitor import Monitor

# How often the held positions are fitted again after the loading has found another equilibrium than the fit.
MOST_FITS = 3


def run(inputs: Mapping[str, Any], profile: Mapping[str, Any], monitor: Monitor) -> dict[str, Any]:
    """Follow the relaxed design to the printed labels and fit the held positions, in a state that loading reaches."""
    mesh, relaxed, smp = inputs["mesh"], inputs["relaxed"], inputs["labels"]["smp"].astype(np.float64)
    problem = problem_of(mesh, profile["materials"], "linear")
    equilibria = Equilibria(problem, patches_of(problem, relaxed))
    trace = Trace(problem, mesh, monitor, tau_seconds(equilibria))
    design = _printed_design(equilibria, _relaxed_design(equilibria, relaxed), smp)
    trace.add("printed", Search(equilibria, design))
    fits = 0
    if equilibria.patches.count:
        weights = objective_weights(problem, profile["goal"], Weights(), profile["rig"], profile["materials"])
        design, fits = _reachable_fit(equilibria, design, weights, trace)
    design = polished(equilibria, design)
    L0 = problem.length
    printed = {"x": design.median.x * L0, "y": design.final.y * L0} | patch_arrays(problem, equilibria.patches, design)
    reasons = _limit_reasons(problem, equilibria.patches, design, profile)
    return {"printed": printed, "refit_report": {"fits": fits, "reasons": reasons}, "refit_trace": trace.csv()}


def _printed_design(equilibria: Equilibria, design: Design, smp: FloatArray) -> Design:
    """The printed labels in equilibrium: near the relaxed design, or else where loading from rest ends."""
    try:
        return change_density(equilibria, design, smp)
    except EquilibriumError:
        return _programmed(program(equilibria, smp, design.median.x, design.median.forces), smp)


def _programmed(done: Programming, smp: FloatArray) -> Design:
    return Design(smp, np.zeros((0, 3)), done.median, done.final)


def _reachable_fit(
    equilibria: Equilibria, design: Design, weights: ObjectiveWeights, trace: Trace
) -> tuple[Design, int]:
    """Fit the held positions; again from where loading ends while that is elsewhere. Returns the fits made too."""
    for fit in range(1, MOST_FITS + 1):
        design = refit(equilibria, design, weights, lambda at: trace.add("refit", at))
        done = program(equilibria, design.rho, design.median.x, design.median.forces)
        if same_shape(done, design.median.x) or fit == MOST_FITS:
            return design, fit
        design = _programmed(done, design.rho)
        trace.add("reached", Search(equilibria, design))
    raise AssertionError  # the loop returns


def _relaxed_design(equilibria: Equilibria, relaxed: Mapping[str, np.ndarray]) -> Design:
    problem, rho = equilibria.problem, relaxed["rho"]
    x, y = relaxed["x"] / problem.length, relaxed["y"] / problem.length
    forces = relaxed["patch_force"] / problem.force
    held = relaxed["patch_held"] / problem.length
    median = equilibria.solve_median(rho, held, x, forces)
    median = equilibria.solve_median(rho, held_positions(equilibria, median), median.x, median.forces)
    return Design(rho, held, median, equilibria.solve_final(rho, median, y))


def _limit_reasons(problem: Problem, patches: Patches, design: Design, profile: Mapping[str, Any]) -> list[str]:
    """What of the rig's limits the design does not keep."""
    rig, forces = profile["rig"], design.median.forces * problem.force
    sizes = np.linalg.norm(forces, axis=1)
    reasons = []
    if len(sizes) and sizes.max() > rig.max_force * (1 + 1e-3):
        point = int(sizes.argmax())
        reasons.append(f"point {point + 1} needs {sizes[point]:.4g} N, the rig gives {rig.max_force:g} N")
    if rig.pull_only:
        pushed = [str(k + 1) for k in range(patches.count) if _pushes(patches, design, k)]
        if pushed:
            reasons.append(f"the rig only pulls, but points {', '.join(pushed)} are pushed")
    return reasons


def _pushes(patches: Patches, design: Design, k: int) -> bool:
    faces = patches.faces[patches.offsets[k] : patches.offsets[k + 1]]
    outward = face_area_vectors(design.median.x, faces).sum(axis=0)
    return bool(design.median.forces[k] @ outward < 0)
