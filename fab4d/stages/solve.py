"""Stage `solve`: a near 0/1 density and the points to hold, so that the part takes the temporary shape."""

import json
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from fab4d.design.problem import Problem
from fab4d.design.reduced import ReducedSettings, Search, at_rest
from fab4d.errors import EquilibriumError, SceneError
from fab4d.io.scene import Goal, Weights
from fab4d.stages._attempts import attempts
from fab4d.stages._bring_up import COARSE_SHARE, brought_up
from fab4d.stages._coarse import MANY_TETS, coarse_for
from fab4d.stages._design import Trace, patch_arrays, problem_of, tau_seconds, tolerance_of
from fab4d.stages._element import elements_for
from fab4d.stages._finish import finished
from fab4d.stages._flips import flip_settings
from fab4d.stages._least import least_smp
from fab4d.stages._limits import limited_by
from fab4d.stages._repair import MORE_REPAIRS, repaired
from fab4d.stages._search import search_from
from fab4d.stages._settings import search_settings
from fab4d.stages.monitor import Monitor, Prefixed

LEFT_OUT = [{"what": "iterative linear solver", "why": "the direct one factors this mesh in memory"}]
# A coarse mesh is searched from so many times more other points where the usual ones nearly do: what is found there
# saves steps on all tets, which take minutes.
MORE_BEGINNINGS = 6


def run(inputs: Mapping[str, Any], profile: Mapping[str, Any], monitor: Monitor) -> dict[str, Any]:
    """Choose the points, relax the density, drive it to 0 and 1; again with other weights if printing costs a lot."""
    mesh = inputs["mesh"]
    _refuse_weights(profile["weights"], profile["goal"])
    problem = problem_of(mesh, profile["materials"], "linear")
    monitor.progress("compile, measure tau")
    tau_s = tau_seconds(problem)
    trace = Trace(problem, mesh, monitor, tau_s)
    if inputs["check_report"]["nothing_to_program"]:
        rest = at_rest(problem)
        trace.add("rest", rest)
        why = [
            {"what": "design, forces and rig sheet", "why": "the temporary shape is the permanent one, moved rigidly"}
        ]
        return _artifacts(mesh, profile, rest, trace, {"tau_s": tau_s, "left_out": why})
    if inputs["picked"] is not None:
        return _picked(problem, inputs, profile, trace, tau_s)
    element = elements_for(mesh, profile["solver"].element).rounding
    designed = _designed_coarse(problem, mesh, profile, element, trace, monitor)
    if designed is None:
        found, _, report = _designed(problem, mesh, profile, element, trace, monitor)
    else:
        found, report = designed
    return _artifacts(mesh, profile, found, trace, {"tau_s": tau_s, "iterations": len(trace.rows)} | report)


def _designed(
    problem: Problem,
    mesh: Mapping[str, np.ndarray],
    profile: Mapping[str, Any],
    element: str,
    trace: Trace,
    monitor: Monitor,
    more_beginnings: int = 1,
) -> tuple[Search, Search, dict[str, Any]]:
    """The design of all attempts, with the least SMP if the goal asks for that, it before rounding, and what the report
    says of it.

    element : in which designs are rounded and judged as printed: that of the last fit, here and below, unless its
        unknowns are too many for that
    """
    tried = attempts(problem, mesh, profile, element, trace, monitor, more_beginnings)
    least = None
    if profile["goal"].smp == "least":
        sections = {name: profile[name] for name in ("printer", "rig", "goal", "acceptance")}
        least = least_smp(problem, mesh, sections, tried.settings, tried.found, trace, monitor)
        finish = finished(mesh, profile, element, least.relaxed, tried.settings, trace)
        tried = replace(tried, found=least.found, relaxed=least.relaxed, printed_rms=least.printed_rms, finish=finish)
    rms = tried.printed_rms
    report = {
        "attempts": tried.count,
        "printed_rms_mm": rms * problem.length if np.isfinite(rms) else None,
        "least_smp": None if least is None else least.trials,
        "limited_by": limited_by(problem, profile, tried.found, tried.more_points),
        "left_out": [*LEFT_OUT, *tried.finish.left_out],
    }
    return tried.finish.found or tried.found, tried.relaxed, report


def _designed_coarse(
    problem: Problem,
    mesh: Mapping[str, np.ndarray],
    profile: Mapping[str, Any],
    element: str,
    trace: Trace,
    monitor: Monitor,
) -> tuple[Search, dict[str, Any]] | None:
    """As `_designed`, on a coarser mesh and carried over.

    None where the mesh is small, or where the coarser one or the way back finds no equilibrium: the whole mesh is then
    searched, which takes longer.
    """
    chain = coarse_for(problem, mesh, profile["materials"], element, monitor)
    if not chain:
        return None
    coarse, goal = chain[-1], profile["goal"]
    own = trace.on(coarse.level.coarse, coarse.mesh)
    tolerance = COARSE_SHARE * tolerance_of(problem, goal) * problem.length
    lower = dict(profile) | {"goal": replace(goal, tolerance=tolerance)}
    try:
        found, before, report = _designed(
            coarse.level.coarse, coarse.mesh, lower, "linear", own, Prefixed(monitor, "coarse-"), MORE_BEGINNINGS
        )
    except EquilibriumError:
        return None

    def settings_of(finer: Problem) -> ReducedSettings:
        return search_settings(finer, profile, report["attempts"] - 1)

    levels = [each.level for each in reversed(chain)]
    meshes = [mesh, *(each.mesh for each in chain[:-1])][::-1]
    traces = [trace.on(level.fine, finer).add for level, finer in zip(levels, meshes, strict=True)]
    carried = brought_up(levels, before, found, settings_of, goal, traces)
    if carried is None:
        return None
    why = f"the design is found on {coarse.level.coarse.n_tets} tets of the same part and carried over"
    left_out = [*report["left_out"], {"what": f"search on all {problem.n_tets} tets", "why": why}]
    return carried, report | {"left_out": left_out}


def _picked(
    problem: Problem, inputs: Mapping[str, Any], profile: Mapping[str, Any], trace: Trace, tau_s: float
) -> dict[str, Any]:
    """The design of a row of the tradeoff, as if it had been searched."""
    picked = inputs["picked"]
    row, found = json.loads(str(picked["row"])), search_from(problem, picked)
    trace.add("picked", found)
    left_out = [{"what": "search for a design", "why": f"row {row['id']} of the tradeoff is picked"}]
    report = {"tau_s": tau_s, "picked": row, "left_out": left_out}
    return _artifacts(inputs["mesh"], profile, found, trace, report)


def _refuse_weights(weights: Weights, goal: Goal) -> None:
    if weights.lam_force is not None:
        msg = (
            "weights.lam_force: the reduced solver takes a number of points ([goal] max_forces), not a price of forces"
        )
        raise SceneError(msg)
    if weights.lam_SMP == 0 and goal.smp == "least":
        msg = 'weights.lam_SMP is 0, from where [goal] smp = "least" cannot search: leave it out or raise it'
        raise SceneError(msg)


def _artifacts(
    mesh: Mapping[str, np.ndarray], profile: Mapping[str, Any], found: Search, trace: Trace, report: dict[str, Any]
) -> dict[str, Any]:
    problem, design = found.equilibria.problem, found.design
    weights = search_settings(problem, profile).weights
    flips = flip_settings(mesh, profile["printer"], profile["goal"], weights.error_scale)
    more = 0 if problem.n_tets > MANY_TETS else MORE_REPAIRS
    relaxed = {
        "rho": design.rho,
        "repair_cost": repaired(mesh, profile["printer"], flips, found, weights, more).cost,
        "x": design.median.x * problem.length,
        "y": design.final.y * problem.length,
        "relaxed_rms": np.array(found.relaxed_rms * problem.length),
        "patch_radius": np.array(found.patch_radius * problem.length),
    }
    return {
        "relaxed": relaxed | patch_arrays(problem, found.equilibria.patches, design),
        "solve_report": report,
        "solve_trace": trace.csv(),
    }
