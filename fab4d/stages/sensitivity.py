"""Stage `sensitivity`: whether the verified state is stable, and how its error moves with rig and material."""

from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

import numpy as np

from fab4d.design.equilibria import RIG_COMPLIANCE, Equilibria
from fab4d.design.gauss_newton import Design
from fab4d.design.objective import shape_error
from fab4d.design.robustness import (
    PHASES,
    Instability,
    Response,
    instability_of,
    response_of,
    with_moved_points,
    with_scaled_forces,
    with_scaled_modulus,
)
from fab4d.design.sensitivity import Linearisation, linearise
from fab4d.design.stability import soft_modes
from fab4d.solvers.linear import SingularMatrixError
from fab4d.solvers.threads import side_by_side
from fab4d.stages._design import patches_of, problem_of
from fab4d.stages.monitor import Monitor

HOLD_MM, FORCE_CHANGE, MODULUS_CHANGE = 1.0, 0.05, 0.1
# The worst moves of points are simulated, the worst first, until the quadratic model of the error is off by MODEL_ERROR
# at most for so many in a row: it is better for what moves less. Where it was off, random moves are simulated too, so
# many that come in pairs of opposite ones.
SIMULATED_POINTS, MODEL_ERROR, RANDOM_MOVES = 2, 0.2, 4
# Forces that move the points far take some hundred factorisations, or are not found.
MOST_FORCED_TETS = 100_000
NOT_FORCED = {
    "what": "simulation of changed forces",
    "why": f"it may take hundreds of factorisations of more than {MOST_FORCED_TETS} tets; told by the model",
}
ELEMENTS = {1: "linear", 2: "quadratic"}


def run(inputs: Mapping[str, Any], profile: Mapping[str, Any], monitor: Monitor) -> dict[str, Any]:
    """Count the ways in which the state moves away by itself; change positions, forces and moduli and solve again."""
    why = _why_not(inputs["state"], inputs["verify_report"])
    if why:
        return {"sensitivity_report": _left_out(why)}
    state, order = inputs["state"], inputs["verify_report"]["element_order"]
    problem = problem_of(inputs["mesh"], profile["materials"], ELEMENTS[order])
    equilibria = Equilibria(problem, patches_of(problem, state))
    design = _verified_design(equilibria, inputs["labels"]["smp"].astype(np.float64), state)
    monitor.progress("stability")
    try:
        lin = linearise(equilibria, design.rho, design.median, design.final)
    except SingularMatrixError as error:
        reason = f"the verified state is at the limit of its stability ({error}): allow more points ([goal] max_forces)"
        left_out = _left_out("the state has no stiffness in some direction")
        return {"sensitivity_report": left_out | {"stable": False, "reasons": [reason]}}
    response = response_of(equilibria, design, lin)
    unstable = instability_of(response)
    reasons = _reasons(unstable)
    report = {"stable": not reasons, "instability": _instability_figures(unstable), "reasons": reasons}
    if reasons:
        return {"sensitivity_report": _left_out("the state is not stable") | report}
    softest = _softest_figures(equilibria, design, lin)
    changes = _changes(equilibria, design, lin, response, monitor)
    not_forced = [] if changes["force"]["smaller"]["simulated"] else [NOT_FORCED]
    return {"sensitivity_report": report | {"softest": softest} | changes | {"left_out": not_forced}}


def _why_not(state: Mapping[str, Any], verify_report: Mapping[str, Any]) -> str | None:
    if not len(state["patch_center"]):
        return "no point carries a force: there is nothing to program"
    return None if verify_report["reached"] else "the simulation did not reach the designed state"


def _left_out(why: str) -> dict[str, Any]:
    what = "sensitivity to positions, forces and moduli"
    return {"left_out": [{"what": what, "why": why}], "reasons": []}


def _verified_design(equilibria: Equilibria, smp: np.ndarray, state: Mapping[str, np.ndarray]) -> Design:
    """The state artifact as a design; it is in equilibrium already, so Newton has next to nothing to do."""
    L0, force = equilibria.problem.length, equilibria.problem.force
    x, forces = state["x"] / L0, state["patch_force"] / force
    held = equilibria.patches.mean(x) + RIG_COMPLIANCE * forces
    median = equilibria.solve_median(smp, held, x, forces)
    return Design(smp, median, equilibria.solve_final(smp, median, state["y"] / L0))


# -- stability


def _reasons(unstable: Instability) -> list[str]:
    """Why the delivered state would not stay where it is."""
    states = (("held median shape", unstable.held), ("unloaded final shape", unstable.final))
    return [
        f"the {name} is unstable in {count} ways: the part would not stay in it; allow more points ([goal] max_forces)"
        for name, count in states
        if count
    ]


def _instability_figures(unstable: Instability) -> dict[str, Any]:
    return {
        "held": unstable.held,
        "final": unstable.final,
        "dead_loads": unstable.dead_loads,
        "points": (np.flatnonzero(unstable.points) + 1).tolist(),
    }


def _softest_figures(equilibria: Equilibria, design: Design, lin: Linearisation) -> dict[str, Any] | None:
    """Of the mode of the held median shape that is nearest to buckling: what is left of its stiffness, and where on the
    permanent shape it moves most; None where no mode is found."""
    modes = soft_modes(equilibria, design.rho, design.median, lin.held)
    if not len(modes.ratios):
        return None
    body, L0 = equilibria.problem.body, equilibria.problem.length
    node = int(np.linalg.norm(modes.shapes[0], axis=1).argmax())
    return {"stiffness_left": float(modes.ratios[0]), "at_mm": (body.X[node] * L0).tolist()}


# -- changes


def _changes(
    equilibria: Equilibria, design: Design, lin: Linearisation, response: Response, monitor: Monitor
) -> dict[str, Any]:
    L0 = equilibria.problem.length
    monitor.progress("positions", rms_mm=response.rms * L0)
    hold = _hold_figures(equilibria, design, lin, response)
    monitor.progress("forces", rms_mm=response.rms * L0)
    force = _force_figures(equilibria, design, lin, response)
    monitor.progress("moduli", rms_mm=response.rms * L0)
    modulus = _modulus_figures(equilibria, design, lin)
    return {"rms_mm": response.rms * L0, "hold": hold, "force": force, "modulus": modulus}


def _rms_mm(equilibria: Equilibria, design: Design | None) -> float | None:
    """RMS error of a changed design; None where there is none."""
    if design is None:
        return None
    return shape_error(equilibria.problem, design.final.y).rms * equilibria.problem.length


def _hold_figures(equilibria: Equilibria, design: Design, lin: Linearisation, response: Response) -> dict[str, Any]:
    """Each point moved in its own worst direction; all points in random ones."""
    L0, count = equilibria.problem.length, equilibria.patches.count
    size, unknowns = HOLD_MM / L0, 3 * equilibria.problem.n_nodes

    def simulated(dc: np.ndarray) -> float | None:
        return _rms_mm(equilibria, with_moved_points(equilibria, design, lin, response, dc))

    moves = [_alone(count, point, response.worst_move(point, size)) for point in range(count)]
    told = np.array([response.rms_after(dc) * L0 for dc in moves])
    found = simulated_points(told, lambda some: side_by_side([partial(simulated, moves[k]) for k in some], unknowns))
    holds = all(_told_well(told[k], rms) for k, rms in found.items())
    random_model_rms = response.expected_rms(size) * L0
    random_rms: float | None = random_model_rms
    if not holds:
        random = [partial(simulated, dc) for dc in _random_moves(count, size)]
        random_rms = _root_mean_square(side_by_side(random, unknowns))
    points = [
        {"point": k + 1, "direction": (moves[k][k] / size).tolist(), "model_rms_mm": float(told[k])}
        | {"simulated": k in found, "rms_mm": found.get(k)}
        for k in range(count)
    ]
    expected = {"random_rms_mm": random_rms, "random_model_rms_mm": random_model_rms}
    return {"change_mm": HOLD_MM, "model_holds": holds, **expected, "points": points}


def simulated_points(told: np.ndarray, simulate: Callable[[list[int]], list[float | None]]) -> dict[int, float | None]:
    """RMS errors, mm, of the points whose moves are worst, until the model tells SIMULATED_POINTS in a row well.

    told (K,) : errors by the model        simulate : points -> errors, None where there is no equilibrium
    """
    found = dict[int, float | None]()
    worst_first, well = np.argsort(-told, kind="stable").tolist(), 0
    while worst_first and well < SIMULATED_POINTS:
        some, worst_first = worst_first[:SIMULATED_POINTS], worst_first[SIMULATED_POINTS:]
        for k, rms in zip(some, simulate(some), strict=True):
            found[k] = rms
            well = well + 1 if _told_well(told[k], rms) else 0
    return found


def _told_well(told: float, rms: float | None) -> bool:
    return rms is not None and bool(abs(told - rms) <= MODEL_ERROR * rms)


def _random_moves(count: int, size: float) -> list[np.ndarray]:
    """Moves (K, 3) of all points by `size` in random directions, each followed by its opposite."""
    rng = np.random.default_rng(0)
    directions = rng.standard_normal((RANDOM_MOVES // 2, count, 3))
    directions *= size / np.linalg.norm(directions, axis=2, keepdims=True)
    return [sign * dc for dc in directions for sign in (1, -1)]


def _root_mean_square(values: list[float | None]) -> float | None:
    """None where one is missing."""
    known = [v for v in values if v is not None]
    return float(np.sqrt(np.mean(np.square(known)))) if len(known) == len(values) else None


def _alone(count: int, point: int, change: np.ndarray) -> np.ndarray:
    """(K, 3) zero but for one point."""
    all_points = np.zeros((count, 3))
    all_points[point] = change
    return all_points


def _force_figures(equilibria: Equilibria, design: Design, lin: Linearisation, response: Response) -> dict[str, Any]:
    """All forces larger or smaller by the same part, simulated, and the force of each point alone, by the model."""
    simulated = equilibria.problem.n_tets <= MOST_FORCED_TETS

    def together(change: float) -> dict[str, float | None]:
        model = _by_model(response, change * design.median.forces, L0) | {"simulated": simulated}
        if not simulated:
            return model | {"rms_mm": None}
        return model | {
            "rms_mm": _rms_mm(equilibria, with_scaled_forces(equilibria, design, lin, response, 1 + change))
        }

    def alone(point: int) -> dict[str, float]:
        force = _alone(equilibria.patches.count, point, FORCE_CHANGE * design.median.forces[point])
        return max((_by_model(response, sign * force, L0) for sign in (-1, 1)), key=lambda c: c["model_rms_mm"])

    L0 = equilibria.problem.length
    points = [{"point": k + 1, **alone(k)} for k in range(equilibria.patches.count)]
    both = [partial(together, sign * FORCE_CHANGE) for sign in (-1, 1)]
    smaller, larger = side_by_side(both, 3 * equilibria.problem.n_nodes)
    return {"change": FORCE_CHANGE, "smaller": smaller, "larger": larger, "points": points}


def _by_model(response: Response, change: np.ndarray, L0: float) -> dict[str, float]:
    """Error and largest move of a point, mm, when the forces change by `change` (K, 3); moves to first order."""
    dc = response.moves_for_forces(change)
    travel = float(np.linalg.norm(dc, axis=1).max())
    return {"model_rms_mm": response.rms_after(dc) * L0, "model_travel_mm": travel * L0}


def _modulus_figures(equilibria: Equilibria, design: Design, lin: Linearisation) -> dict[str, Any]:
    """Each phase softer and stiffer at the same held positions: error, and size of all forces relative to before."""
    before = np.linalg.norm(design.median.forces)

    def changed(phase: str, factor: float) -> dict[str, float | None]:
        found = with_scaled_modulus(equilibria, design, lin, phase, factor)
        forces = None if found is None else float(np.linalg.norm(found.median.forces) / before)
        return {"rms_mm": _rms_mm(equilibria, found), "forces": forces}

    signs = {"softer": -1, "stiffer": 1}
    calls = [partial(changed, phase, 1 + sign * MODULUS_CHANGE) for phase in PHASES for sign in signs.values()]
    found = iter(side_by_side(calls, 3 * equilibria.problem.n_nodes))
    return {"change": MODULUS_CHANGE} | {phase: {name: next(found) for name in signs} for phase in PHASES}
