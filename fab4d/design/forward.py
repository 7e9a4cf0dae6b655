"""Forward simulation of a finished design, from the permanent shape, the way the rig will do it."""

from dataclasses import dataclass

import numpy as np

from fab4d.design.equilibria import RIG_COMPLIANCE, Equilibria, Final, Median
from fab4d.design.problem import at_nodes
from fab4d.elasticity import _kernels as kernels
from fab4d.mesh.interpolation import shape_path
from fab4d.mesh.tetmesh import FloatArray

FIRST_STEP, SMALLEST_STEP = 0.05, 1e-3
PATH_TOLERANCE, END_TOLERANCE = 1e-7, 1e-11
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
    median, steps, loaded = _load(equilibria, rho, x, forces)
    final, more, unloaded = _unload(equilibria, rho, median)
    return Programming(median, final, steps + more, loaded, unloaded)


def same_shape(done: Programming, x: FloatArray) -> bool:
    """Whether the programming went all the way and ended in the median shape x (N, 3)."""
    distance = float(np.linalg.norm(done.median.x - x, axis=1).max())
    return done.loaded == 1.0 and done.unloaded == 1.0 and distance <= SAME_SHAPE


def _load(equilibria: Equilibria, rho: FloatArray, x: FloatArray, forces: FloatArray) -> tuple[Median, int, float]:
    problem, patches = equilibria.problem, equilibria.patches
    corners = problem.body.elements[:, :4]
    n = int(corners.max()) + 1
    path = shape_path(problem.body.X[:n], x[:n], corners, problem.clamp[:n])
    correction = patches.mean(x) + RIG_COMPLIANCE * forces - patches.mean(at_nodes(problem, path.at(1.0)))

    def held(t: float) -> FloatArray:
        return patches.mean(at_nodes(problem, path.at(t))) + t * correction

    none = np.zeros((patches.count, 3))
    median = equilibria.solve_median(rho, patches.mean(problem.body.X), problem.body.X, none)
    done, step, steps = 0.0, FIRST_STEP, 0
    while done < 1.0 and step >= SMALLEST_STEP:
        aim = min(1.0, done + step)
        trial = equilibria.solve_median(rho, held(aim), median.x, median.forces, PATH_TOLERANCE, 15)
        if trial.solution.converged:
            median, done, step, steps = trial, aim, 1.4 * step, steps + 1
        else:
            step /= 2
    return equilibria.solve_median(rho, held(done), median.x, median.forces, END_TOLERANCE, 10), steps, done


def _unload(equilibria: Equilibria, rho: FloatArray, median: Median) -> tuple[Final, int, float]:
    """Let the TPE pull the cold part back, little by little: under dead loads the free part would turn over."""
    y, done, step, steps = median.x, 0.0, 0.25, 0
    while done < 1.0 and step >= SMALLEST_STEP:
        aim = min(1.0, done + step)
        trial = equilibria.solve_final(rho, median, y, PATH_TOLERANCE, 15, aim)
        if trial.solution.converged:
            y, done, step, steps = trial.y, aim, 2 * step, steps + 1
        else:
            step /= 2
    return equilibria.solve_final(rho, median, y, END_TOLERANCE, 10, done), steps, done


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
