"""Stage `solve`: a near 0/1 density and the points to hold, so that the part takes the temporary shape."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from fab4d.design.equilibria import RIG_COMPLIANCE, Equilibria
from fab4d.design.gauss_newton import equilibrate
from fab4d.design.patches import build_patches
from fab4d.design.problem import Problem
from fab4d.design.reduced import Phase, ReducedSettings, Search, at_rest, solve_reduced
from fab4d.errors import SceneError
from fab4d.io.scene import Goal, RigCard
from fab4d.stages._design import Trace, objective_weights, patch_arrays, problem_of, tau_seconds
from fab4d.stages.monitor import Monitor

CHECKPOINT = "iterate"
# Above this share of SMP the search makes it dearer, even if the goal names no limit.
USUAL_SMP_FRACTION = 0.5


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
        trace.add("rest", rest)
        why = [
            {"what": "design, forces and rig sheet", "why": "the temporary shape is the permanent one, moved rigidly"}
        ]
        return _artifacts(problem, rest, trace, {"tau_s": tau_s, "left_out": why})
    settings = _settings(problem, profile)

    start = _resumed(problem, settings, trace, monitor)
    phase = "start" if start is None else start.phase.value

    def watch(at: Search) -> None:
        nonlocal phase
        trace.add(phase, at)
        phase = at.phase.value
        monitor.save(CHECKPOINT, _checkpoint(at, trace))

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
        max_smp_fraction=USUAL_SMP_FRACTION if goal.max_smp_fraction is None else goal.max_smp_fraction,
    )


def _left_out(profile: Mapping[str, Any]) -> list[dict[str, str]]:
    left_out = [{"what": "iterative linear solver", "why": "the direct one factors this mesh in memory"}]
    if profile["solver"].element == "linear":
        left_out.append(
            {"what": "quadratic elements", "why": 'the scene asks for linear ones ([solver] element = "linear")'}
        )
    return left_out


def _artifacts(problem: Problem, found: Search, trace: Trace, report: dict[str, Any]) -> dict[str, Any]:
    design, n = found.design, len(np.unique(problem.body.elements[:, :4]))
    relaxed = {"rho": design.rho, "x": design.median.x[:n] * problem.length, "y": design.final.y[:n] * problem.length}
    return {
        "relaxed": relaxed | patch_arrays(problem, found.equilibria.patches, design),
        "solve_report": report,
        "solve_trace": trace.csv(),
    }


_NUMBERS = ("lam_SMP", "lam_round", "damping", "iteration", "slow")


def _checkpoint(at: Search, trace: Trace) -> dict[str, np.ndarray]:
    design = at.design
    return {
        "phase": np.array(at.phase.value),
        "numbers": np.array([getattr(at, name) for name in _NUMBERS], dtype=np.float64),
        "centers": at.equilibria.patches.centers,
        "rho": design.rho,
        "x": design.median.x,
        "forces": design.median.forces,
        "y": design.final.y,
        "trace": np.frombuffer(trace.csv(), np.uint8),
    }


def _resumed(problem: Problem, settings: ReducedSettings, trace: Trace, monitor: Monitor) -> Search | None:
    """The state of a run that was stopped, or None; the rows of the trace go on from there."""
    saved = monitor.restore(CHECKPOINT)
    if saved is None:
        return None
    equilibria = Equilibria(problem, build_patches(problem, saved["centers"], settings.patch_radius))
    held = equilibria.patches.mean(saved["x"]) + RIG_COMPLIANCE * saved["forces"]
    design = equilibrate(equilibria, saved["rho"], held, saved["x"], saved["forces"], saved["y"])
    if design is None:
        return None
    trace.go_on(saved["trace"].tobytes())
    lam_SMP, lam_round, damping, iteration, slow = saved["numbers"].tolist()
    phase = Phase(str(saved["phase"]))
    return Search(equilibria, design, phase, lam_SMP, lam_round, damping, int(iteration), int(slow))
