"""Forward simulation of a finished design, from the permanent shape, the way the rig will do it."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import TypeVar

import numpy as np

from fab4d.design.equilibria import RIG_COMPLIANCE, Equilibria, Final, Median
from fab4d.design.problem import at_nodes
from fab4d.elasticity import _kernels as kernels
from fab4d.mesh.interpolation import shape_path
from fab4d.mesh.tetmesh import FloatArray

FIRST_LOAD, FIRST_UNLOAD, SMALLEST_STEP = 0.05, 0.25, 1e-3
PATH_TOLERANCE, END_TOLERANCE = 1e-4, 1e-12
PATH_ITERATIONS, END_ITERATIONS = 12, 10
# A load step that takes fewer Newton iterations makes the next one longer, one that takes more, shorter.
USUAL_ITERATIONS = 8
# Farther apart, relative to the diagonal, two median shapes are different equilibria.
SAME_SHAPE = 1e-5


@dataclass(frozen=True, eq=False)
class Programming:
    """What the simulated programming ended in, how many load steps it took, and how far it came (1: all the way)."""

    median: Median
    final: Final
    load_steps: int
    loaded: float
    unloaded: float


def program(equilibria: Equilibria, rho: FloatArray, x: FloatArray, forces: FloatArray) -> Programming:
    """Load the part from its permanent shape until its patches are where they are in x, cool, and unload it.

    rho : (m,) printed labels, 0 or 1        x : (N, 3), forces : (K, 3) the state that the rig is to reach
    The patches move along the path of `mesh.interpolation`; only their mean positions are taken from it.
    """
    median, steps, loaded = load(equilibria, rho, x, forces)
    final, more, unloaded = unload(equilibria, rho, median)
    return Programming(median, final, steps + more, loaded, unloaded)


def programmed_to(
    equilibria: Equilibria, rho: FloatArray, x: FloatArray, forces: FloatArray, y: FloatArray, load_steps: int
) -> Programming:
    """The programming that went all the way to these median and final shapes (N, 3), which are solved to the end."""
    held = equilibria.patches.mean(x) + RIG_COMPLIANCE * forces
    median = equilibria.solve_median(rho, held, x, forces, END_TOLERANCE, END_ITERATIONS)
    final = equilibria.solve_final(rho, median, y, END_TOLERANCE, END_ITERATIONS)
    return Programming(median, final, load_steps, 1.0, 1.0)


def same_shape(done: Programming, x: FloatArray) -> bool:
    """Whether the programming went all the way and ended in the median shape x (N, 3)."""
    distance = float(np.linalg.norm(done.median.x - x, axis=1).max())
    return done.loaded == 1.0 and done.unloaded == 1.0 and distance <= SAME_SHAPE


def load(equilibria: Equilibria, rho: FloatArray, x: FloatArray, forces: FloatArray) -> tuple[Median, int, float]:
    """The median shape that loading ends in, the load steps made, and how far it came; see `program`."""
    problem, patches = equilibria.problem, equilibria.patches
    corners = problem.body.elements[:, :4]
    n = int(corners.max()) + 1
    path = shape_path(problem.body.X[:n], x[:n], corners, problem.clamp[:n])
    correction = patches.mean(x) + RIG_COMPLIANCE * forces - patches.mean(at_nodes(problem, path.at(1.0)))

    @lru_cache(maxsize=2)
    def held(t: float) -> FloatArray:
        return patches.mean(at_nodes(problem, path.at(t))) + t * correction

    def solve(t: float, guess: Median, tolerance: float, iterations: int) -> Median:
        return equilibria.solve_median(rho, held(t), guess.x, guess.forces, tolerance, iterations)

    def onwards(before: Median, now: Median, ratio: float, t: float) -> Median:
        force = now.forces + ratio * (now.forces - before.forces)
        gap = held(t) - RIG_COMPLIANCE * force - patches.mean(now.x)
        return replace(now, x=equilibria.held_turning.repeat(before.x, now.x, now.x, ratio, gap), forces=force)

    none = np.zeros((patches.count, 3))
    rest = equilibria.solve_median(rho, patches.mean(problem.body.X), problem.body.X, none)
    return _follow(rest, solve, onwards, FIRST_LOAD)


def unload(
    equilibria: Equilibria,
    rho: FloatArray,
    median: Median,
    path_tolerance: float = PATH_TOLERANCE,
    tolerance: float = END_TOLERANCE,
    stay: bool = False,
) -> tuple[Final, int, float]:
    """Let the TPE pull the cold part back, little by little: under dead loads the free part would turn over.

    stay : see `newton`
    Returns the final shape that this ends in, the load steps made, and how far it came.
    """

    def solve(t: float, guess: Final, tolerance: float, iterations: int) -> Final:
        return equilibria.solve_final(rho, median, guess.y, tolerance, iterations, t, stay=stay)

    def onwards(before: Final, now: Final, ratio: float, t: float) -> Final:  # noqa: ARG001
        return replace(now, y=equilibria.free_turning.repeat(before.y, now.y, now.y, ratio))

    held = equilibria.solve_final(rho, median, median.x, unloaded=0.0)
    return _follow(held, solve, onwards, FIRST_UNLOAD, path_tolerance, tolerance)


Shape = TypeVar("Shape", Median, Final)


def _follow(
    start: Shape,
    solve: Callable[[float, Shape, float, int], Shape],
    onwards: Callable[[Shape, Shape, float, float], Shape],
    step: float,
    path_tolerance: float = PATH_TOLERANCE,
    end_tolerance: float = END_TOLERANCE,
) -> tuple[Shape, int, float]:
    """The path of equilibria from `start` at t = 0 as far as it goes; returns its end, the steps made and t there.

    solve : t, guess, tolerance, most iterations -> shape        onwards : earlier shape, shape, ratio, t -> guess
    A guess comes from the two shapes before it alone: nothing but the loading decides where the path leads.
    """
    before, now, last, done, steps = start, start, 0.0, 0.0, 0
    while done < 1.0 and step >= SMALLEST_STEP:
        aim = 1.0 if step >= 1.0 - done else done + (1.0 - done) / np.ceil((1.0 - done) / step)
        guess = onwards(before, now, (aim - done) / (done - last), aim) if steps else now
        trial = solve(aim, guess, path_tolerance, PATH_ITERATIONS)
        if trial.solution.converged:
            step = (aim - done) * min(max(USUAL_ITERATIONS / max(trial.solution.iterations, 1), 0.5), 2.0)
            before, now, last, done, steps = now, trial, done, aim, steps + 1
        else:
            step = (aim - done) / 2
    return solve(done, now, end_tolerance, END_ITERATIONS), steps, done


@dataclass(frozen=True)
class Balance:
    """Largest unbalanced nodal force of median and final shape over the largest patch force, and the least det F."""

    median: float
    final: float
    min_det_F: float


def balance(equilibria: Equilibria, rho: FloatArray, median: Median, final: Final) -> Balance:
    """How well the two shapes are in equilibrium with the patch forces and nothing else."""
    problem, body = equilibria.problem, equilibria.problem.body
    g, _, det_x = equilibria.median_gradient(rho, median.x)
    r = g - equilibria.patches.spread(median.forces, problem.n_nodes)
    r[problem.clamp] = 0.0
    r_final, _ = equilibria.final_gradient(rho, median, final.y)
    ones = np.ones(len(body.elements))
    _, det_y = kernels.energy(body.elements, body.dN, body.weights, ones, ones, final.y - body.X)
    largest = float(np.linalg.norm(median.forces, axis=1).max()) if len(median.forces) else 1.0
    return Balance(_largest(r) / largest, _largest(r_final) / largest, min(det_x, det_y))


def _largest(r: FloatArray) -> float:
    return float(np.linalg.norm(r, axis=1).max())
