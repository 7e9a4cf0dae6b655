"""Small bars with a clamp at one end: the bodies of these tests."""

from pathlib import Path

import numpy as np
from shapes.boxes import box
from shapes.warps import Turn, ramp, rod, warped

from fab4d.design.equilibria import Equilibria
from fab4d.design.gauss_newton import Design, equilibrate
from fab4d.design.patches import build_patches
from fab4d.design.problem import Problem, build_problem
from fab4d.io.cards import load_material
from fab4d.materials.cards import MaterialCard

# Close to what rounding leaves of the final equilibrium of quadratic tets.
TIGHT = 3e-11

SIZE = (40.0, 10.0, 8.0)
CLAMPED = 8.0
CARD = load_material("paper-corrected", Path())


def bent(X: np.ndarray, degrees: float, axis: tuple[float, float, float] = (0, 0, 1)) -> np.ndarray:
    """X (n, 3) with the part beyond the clamp bent (or twisted, axis x) by `degrees`."""
    line = rod((CLAMPED, SIZE[1] / 2, SIZE[2] / 2), (SIZE[0], SIZE[1] / 2, SIZE[2] / 2), (0, 0, 1))
    return warped(X, line, (Turn(axis, degrees, lambda s: ramp(s, 0, 5)),))


def bar(
    cells: tuple[int, int, int] = (5, 2, 2), degrees: float = 30.0, element: str = "linear", card: MaterialCard = CARD
) -> Problem:
    """A bar clamped at its left end that wants to be bent."""
    X, tets = box(SIZE, cells, "six")
    return build_problem(X, bent(X, degrees), tets, X[:, 0] <= CLAMPED, card, element)


def corner(problem: Problem, place: tuple[float, float, float]) -> int:
    """The boundary vertex nearest to `place`, in shares of the bar's size."""
    on_surface = np.unique(problem.faces)
    goal = np.array(place) * SIZE / problem.length
    return int(on_surface[np.argmin(np.linalg.norm(problem.body.X[on_surface] - goal, axis=1))])


def two_patches(problem: Problem) -> Equilibria:
    """A patch at the tip and one on the side half-way."""
    centers = np.array([corner(problem, (1.0, 0.5, 1.0)), corner(problem, (0.6, 1.0, 0.5))])
    return Equilibria(problem, build_patches(problem, centers, 6.0 / problem.length))


def held_design(equilibria: Equilibria, rho: np.ndarray, x: np.ndarray, tolerance: float = TIGHT) -> Design:
    """The equilibria with the patches where the shape x (N, 3) has them."""
    none = np.zeros((equilibria.patches.count, 3))
    design = equilibrate(equilibria, rho, equilibria.patches.mean(x), x, none, x, tolerance, 60)
    assert design is not None
    return design


def mixed_density(problem: Problem, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).uniform(0.2, 0.8, problem.n_tets)
