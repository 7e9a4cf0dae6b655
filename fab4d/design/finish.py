"""A relaxed design carried over to other elements of the same mesh, and rounded there."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from fab4d.design.equilibria import RIG_COMPLIANCE, Equilibria
from fab4d.design.gauss_newton import SEARCH_TOLERANCE, Design, equilibrate
from fab4d.design.objective import smoothness_matrix
from fab4d.design.patches import patches_from_faces
from fab4d.design.problem import Problem, at_nodes
from fab4d.design.reduced import (
    EXCHANGED,
    LARGEST_DAMPING,
    STEPS,
    Phase,
    ReducedSettings,
    Search,
    decided,
    decided_by_and_by,
    undecided_fraction,
)
from fab4d.mesh.tetmesh import FloatArray

# So many steps in a row end the rounding that are not taken, or only with the largest damping and leave more than this
# share of the undecided tets: the equilibria turn unstable on its way.
MOST_HELD_BACK, LITTLE_DECIDED = 3, 0.9
# After so many steps in a row that are not taken, or only with the largest damping, the undecided tets are decided by
# and by, the surest first, if they are at most this share: that takes fewer steps than to raise the price of all of
# them until the last is 0 or 1, and leaves a smaller error.
HARD_STEPS, FEW_LEFT = 2, 0.1
# Up to this share of undecided tets is rounded where the steps come to nothing; with more left, the design that other
# elements have rounded is the better one.
LAST_SHARE = 0.05
# The design is near already: a few steps relax it, and it is rounded in half the steps of a search from the start.
RELAX_ITERATIONS, ROUND_GROWTH = 3, 2.5

Watch = Callable[[str, Search], None]


def carried_over(
    equilibria: Equilibria, rho: FloatArray, x: FloatArray, y: FloatArray, forces: FloatArray
) -> Design | None:
    """The design of these shapes at the vertices, or at all nodes, in the elements of `equilibria`.

    rho (m,); x, y (n or N, 3) median and final shape; forces (K, 3). None where these find no equilibrium near it.
    """
    problem = equilibria.problem
    x, y = (shape if len(shape) == problem.n_nodes else at_nodes(problem, shape) for shape in (x, y))
    held = equilibria.patches.mean(x) + RIG_COMPLIANCE * forces
    median = equilibria.solve_median(rho, held, x, forces, SEARCH_TOLERANCE, 100)
    if not median.solution.converged:
        return None
    # Where that turns a tet over, the shape that was carried over is as good a guess.
    repeated = equilibria.free_turning.repeat(x, y, median.x)
    y = repeated if np.isfinite(equilibria.final_gradient(rho, median, repeated)[1]) else y
    return equilibrate(equilibria, rho, held, median.x, median.forces, y, max_iterations=100)


def carried_in(problem: Problem, relaxed: Search) -> Search | None:
    """A relaxed design, about to be rounded, in the elements of `problem`, which are others of the same mesh.

    None where these find no equilibrium near it.
    """
    before, design = relaxed.equilibria.patches, relaxed.design
    equilibria = Equilibria(problem, patches_from_faces(problem, before.centers, before.faces, before.offsets))
    start = carried_over(equilibria, design.rho, design.median.x, design.final.y, design.median.forces)
    return None if start is None else replace(relaxed, equilibria=equilibria, design=start)


def rounded_from(
    carried: Search, settings: ReducedSettings, watch: Watch, last_share: float = LAST_SHARE
) -> Search | None:
    """A near 0/1 design from a relaxed one that was carried over from another discretisation.

    watch : is shown the phase and the state after each step
    last_share : up to which undecided tets are rounded where the steps come to nothing
    None where no equilibria lead to 0 and 1.
    """
    problem = carried.equilibria.problem
    at = Search(carried.equilibria, carried.design, carried.patch_radius, lam_SMP=carried.lam_SMP, exchanges=EXCHANGED)
    watch("carried over", at)
    settings = replace(settings, relax_iterations=RELAX_ITERATIONS, round_growth=ROUND_GROWTH)
    L, hard, held_back, tried = smoothness_matrix(problem), 0, 0, False
    while at.phase is not Phase.DONE:
        before, at = at, STEPS[at.phase](replace(at, accepted=True), settings, L)
        watch(before.phase.value, at)
        left, all_left = (undecided_fraction(each.design.rho) for each in (at, before))
        hard = hard + 1 if before.phase is Phase.ROUND and _is_hard(at) else 0
        held_back = held_back + 1 if hard and not (at.accepted and left <= LITTLE_DECIDED * all_left) else 0
        if not tried and hard >= HARD_STEPS and left <= FEW_LEFT:
            design, tried = decided_by_and_by(at, settings), True
            if design is not None:
                at = replace(at, design=design, phase=Phase.DONE)
                watch(before.phase.value, at)
                return at
        if held_back == MOST_HELD_BACK:
            break
    return decided(at, settings, last_share)


def _is_hard(after: Search) -> bool:
    """Whether a step was not taken, or only with the largest damping."""
    return not after.accepted or after.damping >= LARGEST_DAMPING
