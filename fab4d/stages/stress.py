"""Study `stress`: the finished design programmed anew with stiff and extreme materials, sizes and places."""

import json
import time
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from fab4d.design.equilibria import Equilibria
from fab4d.design.forward import Balance, Programming, balance, program
from fab4d.design.objective import shape_error
from fab4d.design.robustness import PHASES
from fab4d.errors import SceneError
from fab4d.materials.cards import MaterialCard, Moduli
from fab4d.mesh.measures import bounding_box_diagonal
from fab4d.report.stress import stress_csv
from fab4d.solvers.linear import SingularMatrixError
from fab4d.stages._design import patches_of, tau_seconds
from fab4d.stages._element import problem_like
from fab4d.stages.monitor import Monitor

POSITIONS = ("X", "X_temp", "x", "y")
# Largest unbalanced nodal force, over the largest force of a point, of a shape that counts as solved; or what a change
# of all positions in their last bit does to it, if that is more: no solver gets below that.
SOLVED = 1e-8

Arrays = Mapping[str, np.ndarray]
Row = dict[str, Any]


@dataclass(frozen=True)
class Case:
    """One way in which the design is harder to simulate than as it is.

    stiffer : factors of mu and kappa, by phase        bulkier : factor of kappa of all phases
    size : factor of all lengths        away : distance from the origin, in diagonals of the part
    """

    name: str
    stiffer: Mapping[str, float] = field(default_factory=dict)
    bulkier: float = 1.0
    size: float = 1.0
    away: float = 0.0


CASES = (
    Case("as designed"),
    Case("cold SMP 10 x stiffer", {"glassy": 10.0}),
    Case("cold SMP 1000 x stiffer", {"glassy": 1000.0}),
    Case("hot SMP 100 x stiffer", {"rubbery": 100.0}),
    Case("hot SMP 100 x softer", {"rubbery": 0.01}),
    Case("TPE 100 x stiffer", {"tpe": 100.0}),
    Case("TPE 100 x softer", {"tpe": 0.01}),
    Case("bulk moduli 10 x larger", bulkier=10.0),
    Case("bulk moduli 1000 x larger", bulkier=1000.0),
    Case("a thousandth of the size", size=1e-3),
    Case("a thousand times the size", size=1e3),
    Case("a thousand diagonals away", away=1e3),
)


def run(inputs: Mapping[str, Any], profile: Mapping[str, Any], monitor: Monitor) -> dict[str, Any]:
    """Load, cool and unload the finished design in each of CASES, from the permanent shape to the same positions.

    Cases that the monitor kept are not simulated again. Raises SceneError for a design without points.
    """
    mesh, state, materials = inputs["mesh"], inputs["state"], profile["materials"]
    if not len(state["patch_center"]):
        msg = "no point carries a force: there is nothing to program, and nothing to stress"
        raise SceneError(msg)
    smp = inputs["labels"]["smp"].astype(np.float64)
    monitor.progress("compile, measure tau")
    tau_s = tau_seconds(problem_like(mesh, materials, state["x"]))

    def made(number: int, case: Case) -> Row:
        name = f"case-{number}"
        kept = monitor.restore(name)
        if kept is not None:
            return dict(json.loads(str(kept["row"])))
        monitor.progress(case.name)
        row = row_of(case, mesh, state, smp, materials, tau_s)
        monitor.save(name, {"row": np.array(json.dumps(row))})
        return row

    rows = [made(number, case) for number, case in enumerate(CASES)]
    largest = max((max(row["residual_median"], row["residual_final"]) for row in rows if row["solved"]), default=None)
    report = {"tau_s": tau_s, "cases": len(rows), "solved": sum(row["solved"] for row in rows)}
    return {"stress_csv": stress_csv(rows), "stress_report": report | {"largest_residual": largest}}


def row_of(case: Case, mesh: Arrays, state: Arrays, smp: np.ndarray, materials: MaterialCard, tau_s: float) -> Row:
    """The figures of a case.

    mesh, state : the artifacts, mm and N        smp : (m,) 0 or 1
    """
    began, diagonal = time.perf_counter(), bounding_box_diagonal(mesh["X"])
    mesh, state = (_moved(arrays, case, diagonal) for arrays in (mesh, state))
    problem = problem_like(mesh, materials, state["x"])
    designed = Equilibria(problem, patches_of(problem, state))
    changed = {phase: _moduli(getattr(problem, phase), phase, case) for phase in PHASES}
    equilibria = designed.with_moduli(**changed)
    x, forces = state["x"] / problem.length, state["patch_force"] / problem.force
    done = program(equilibria, smp, x, forces)
    left = balance(equilibria, smp, done.median, done.final)
    y = state["y"] / problem.length
    off = shape_error(replace(problem, X_temp=y), done.final.y).rms
    rounding = _rounding(equilibria, smp, done)
    whole = done.loaded == done.unloaded == 1.0
    balanced = left.median <= max(SOLVED, rounding.median) and left.final <= max(SOLVED, rounding.final)
    return {
        "case": case.name,
        "solved": bool(whole and balanced and left.min_det_F > 0),
        "loaded": done.loaded,
        "unloaded": done.unloaded,
        "load_steps": done.load_steps,
        "residual_median": left.median,
        "residual_final": left.final,
        "rounding_median": rounding.median,
        "rounding_final": rounding.final,
        "min_det_F": left.min_det_F,
        "off_rel": off,
        "negative_modes": _negative_modes(equilibria, smp, done),
        "tau": (time.perf_counter() - began) / tau_s,
    }


def _moved(arrays: Arrays, case: Case, diagonal: float) -> dict[str, np.ndarray]:
    """Positions and forces of an artifact in another size and place; diagonal : of the part, mm."""
    positions = {name: case.size * arrays[name] + case.away * diagonal for name in POSITIONS if name in arrays}
    forces = {name: case.size**2 * arrays[name] for name in ("patch_force",) if name in arrays}
    return {**arrays, **positions, **forces}


def _moduli(moduli: Moduli, phase: str, case: Case) -> Moduli:
    factor = case.stiffer.get(phase, 1.0)
    return Moduli(factor * moduli.mu, factor * case.bulkier * moduli.kappa)


def _rounding(equilibria: Equilibria, smp: np.ndarray, done: Programming) -> Balance:
    """How far from equilibrium the two shapes are once all their positions have changed by a rounding error."""
    x, y = done.median.x, done.final.y
    signs = np.random.default_rng(0).choice([-1.0, 1.0], size=(2, *x.shape))
    x, y = (shape * (1 + np.finfo(np.float64).eps * each) for shape, each in zip((x, y), signs, strict=True))
    return balance(equilibria, smp, replace(done.median, x=x), replace(done.final, y=y))


def _negative_modes(equilibria: Equilibria, smp: np.ndarray, done: Programming) -> int | None:
    """Ways in which the held median shape moves away by itself; None where its tangent is singular."""
    try:
        tangent = equilibria.held_analysis.factor(equilibria.median_tangent(smp, done.median.x))
    except SingularMatrixError:
        return None
    return int(tangent.n_negative - done.median.forces.size)
