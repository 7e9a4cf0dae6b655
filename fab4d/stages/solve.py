"""Stage `solve`: a near 0/1 density and the points to hold, so that the part takes the temporary shape."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from fab4d.design.equilibria import Equilibria
from fab4d.design.gauss_newton import Design, equilibrate
from fab4d.design.patches import build_patches
from fab4d.design.problem import Problem
from fab4d.design.reduced import Iterate, ReducedSettings, at_rest, solve_reduced
from fab4d.errors import SceneError
from fab4d.io.scene import Goal, RigCard
from fab4d.stages._design import Trace, objective_weights, patch_arrays, problem_of, tau_seconds
from fab4d.stages.monitor import Monitor

CHECKPOINT = "iterate"


def run(inputs: Mapping[str, Any], profile: Mapping[str, Any], monitor: Monitor) -> dict[str, Any]:
    """Choose the points, relax the density, drive it to 0 and 1."""
    mesh, weights = inputs["mesh"], profile["weights"]
    if weights.lam_force is not None:
        msg = (
            "weights.lam_force: the reduced solver takes a number of points ([goal] max_forces), not a price of forces"
        )
        raise SceneError(msg)
    problem = problem_of(mesh, profile["materials"], profile["solver"].element)
    rest = at_rest(problem)
    tau_s = tau_seconds(rest.equilibria)
    trace = Trace(problem, mesh, monitor, tau_s)
    if inputs["check_report"]["nothing_to_program"]:
        trace.add(rest)
        why = [
            {"what": "design, forces and rig sheet", "why": "the temporary shape is the permanent one, moved rigidly"}
        ]
        return _artifacts(problem, rest, trace, {"tau_s": tau_s, "left_out": why})
    settings = _settings(problem, profile)

    def watch(iterate: Iterate) -> None:
        trace.add(iterate)
        monitor.save(CHECKPOINT, _checkpoint(iterate))

    start = _resumed(problem, settings, monitor)
    found = solve_reduced(problem, settings, watch, start)
    return _artifacts(
        problem, found, trace, {"tau_s": tau_s, "iterations": len(trace.rows), "left_out": _left_out(profile)}
    )


def _settings(problem: Problem, profile: Mapping[str, Any]) -> ReducedSettings:
    goal: Goal = profile["goal"]
    rig: RigCard = profile["rig"]
    return ReducedSettings(
        n_points=rig.max_points if goal.max_forces is None else min(goal.max_forces, rig.max_points),
        patch_radius=rig.patch_radius / problem.length,
        weights=objective_weights(problem, goal, profile["weights"], rig, profile["materials"]),
        max_smp_fraction=1.0 if goal.max_smp_fraction is None else goal.max_smp_fraction,
    )


def _left_out(profile: Mapping[str, Any]) -> list[dict[str, str]]:
    left_out = [{"what": "iterative linear solver", "why": "the direct one factors this mesh in memory"}]
    if profile["solver"].element == "linear":
        left_out.append(
            {"what": "quadratic elements", "why": 'the scene asks for linear ones ([solver] element = "linear")'}
        )
    return left_out


def _artifacts(problem: Problem, found: Iterate, trace: Trace, report: dict[str, Any]) -> dict[str, Any]:
    design, n = found.design, len(np.unique(problem.body.elements[:, :4]))
    relaxed = {"rho": design.rho, "x": design.median.x[:n] * problem.length, "y": design.final.y[:n] * problem.length}
    return {
        "relaxed": relaxed | patch_arrays(problem, found.equilibria.patches, design),
        "solve_report": report,
        "solve_trace": trace.csv(),
    }


def _checkpoint(iterate: Iterate) -> dict[str, np.ndarray]:
    design = iterate.design
    return {
        "phase": np.array(iterate.phase),
        "centers": iterate.equilibria.patches.centers,
        "rho": design.rho,
        "held": design.held,
        "x": design.median.x,
        "forces": design.median.forces,
        "y": design.final.y,
    }


def _resumed(problem: Problem, settings: ReducedSettings, monitor: Monitor) -> Iterate | None:
    """The last iterate of a run that was stopped, or None."""
    saved = monitor.restore(CHECKPOINT)
    if saved is None:
        return None
    equilibria = Equilibria(problem, build_patches(problem, saved["centers"], settings.patch_radius))
    design: Design | None = equilibrate(
        equilibria, saved["rho"], saved["held"], saved["x"], saved["forces"], saved["y"]
    )
    return None if design is None else Iterate(str(saved["phase"]), equilibria, design)
