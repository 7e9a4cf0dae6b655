"""A bar that wants to be bent, designed and rounded for stage refit, and what that makes of it."""

from functools import cache
from typing import Any

from bent_bar import PROFILE as BENT_BAR
from bent_bar import bent_bar

from fab4d.design.equilibria import Equilibria
from fab4d.design.flips import FlipSettings
from fab4d.design.gauss_newton import Design
from fab4d.design.objective import ObjectiveWeights, shape_error
from fab4d.design.problem import Problem
from fab4d.io.scene import Goal
from fab4d.stages import solve, threshold
from fab4d.stages._design import objective_weights, patches_of, problem_of
from fab4d.stages._flips import fit_flips
from fab4d.stages._ways import carried
from fab4d.stages.monitor import SilentMonitor

PROFILE = BENT_BAR | {"goal": Goal(tolerance=0.8, max_forces=4)}

Artifacts = dict[str, Any]


@cache
def designed_bar() -> Artifacts:
    """The inputs of stage refit for a bar that wants to be bent by 40 degrees."""
    mesh = bent_bar((10, 2, 2), 40.0)
    given = {"mesh": mesh, "check_report": {"nothing_to_program": False}, "picked": None}
    relaxed = solve.run(given, PROFILE, SilentMonitor())["relaxed"]
    rounded = threshold.run({"mesh": mesh, "relaxed": relaxed}, PROFILE, SilentMonitor())["rounded"]
    return {"mesh": mesh, "relaxed": relaxed, "rounded": rounded}


def fit_of(inputs: Artifacts) -> tuple[Equilibria, ObjectiveWeights, FlipSettings]:
    """What stage refit makes of its inputs, in linear elements."""
    problem = problem_of(inputs["mesh"], PROFILE["materials"], "linear")
    weights = objective_weights(problem, *(PROFILE[name] for name in ("goal", "weights", "rig", "materials")))
    relaxed_rms = float(inputs["relaxed"]["relaxed_rms"]) / problem.length
    given = inputs["mesh"], PROFILE["printer"], PROFILE["goal"], relaxed_rms, weights.error_scale
    settings = fit_flips(problem, *given)
    return Equilibria(problem, patches_of(problem, inputs["relaxed"])), weights, settings


def relaxed_design(equilibria: Equilibria, inputs: Artifacts) -> Design:
    """The design before its labels are repaired."""
    design = carried(equilibria, inputs["relaxed"], inputs["relaxed"]["rho"])
    assert design is not None
    return design


def rms(problem: Problem, design: Design) -> float:
    """RMS error, L0."""
    return shape_error(problem, design.final.y).rms
