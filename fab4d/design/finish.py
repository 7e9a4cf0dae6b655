"""A relaxed design carried over to other elements or a finer mesh, and rounded there."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from fab4d.design.equilibria import RIG_COMPLIANCE, Equilibria
from fab4d.design.gauss_newton import SEARCH_TOLERANCE, Design, equilibrate
from fab4d.design.objective import ObjectiveWeights, smoothness_matrix
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
from fab4d.design.stability import soft_modes
from fab4d.mesh.tetmesh import FloatArray

# So many steps in a row end the rounding that are not taken, or only with the largest damping and leave more than this
# share of the undecided tets: the equilibria turn unstable on its way.
MOST_HELD_BACK, LITTLE_DECIDED = 3, 0.9
# After so many steps in a row that are not taken, or only with the largest damping, the undecided tets are decided by
# and by, the surest first, up to this share of all: that takes fewer steps than to raise the price of all of them until
# the last is 0 or 1, and leaves a smaller error. More than that is left to the steps, until they come to nothing.
HARD_STEPS, LAST_SHARE = 2, 0.7
# Whatever its share, what is undecided is so where a design came near unstable states, there without any steps before,
# or where other elements have been searched themselves: steps are hard because of that.
ANY_SHARE = 1.0
# It is rounded in half the steps of a search from the start.
ROUND_GROWTH = 2.5


@dataclass(frozen=True)
class Rounding:
    """How a design that was carried over is relaxed further and rounded.

    relax_iterations : steps of relaxing at most
    most_left : share of all tets, at most, that is decided by and by before steps have come to nothing
    """

    relax_iterations: int
    most_left: float


# The design is near already.
OTHER_ELEMENTS = Rounding(relax_iterations=3, most_left=LAST_SHARE)
# The design is farther from its best on a finer mesh than in other elements of the same one.
FINER_MESH = Rounding(relax_iterations=8, most_left=LAST_SHARE)
# A median shape is clear of unstable states where each mode keeps this share of its stiffness. One that has lost it
# counts as much as an error of the tolerance. Nearer to the edge no step leads on, and the shape snaps over where
# labels change. Designs that are still to be relaxed get there in fewer steps without that price.
LEAST_STABLE, LAM_STABLE = 0.2, 1.0
# Rounding takes stiffness from modes: where relaxing ends with less of it in one than this share, the price is paid
# from then on.
SOFT = 0.4

Watch = Callable[[str, Search], None]


def carried_over(
    equilibria: Equilibria, rho: FloatArray, x: FloatArray, y: FloatArray, forces: FloatArray
) -> Design | None:
    """The design of these shapes at the vertices, or at all nodes, in the elements of `equilibria`.

    rho (m,); x, y (n or N, 3) median and final shape; forces (K, 3). None where these find no equilibrium near it.
    """
    problem = equilibria.problem
    x, y = at_nodes(problem, x), at_nodes(problem, y)
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


@dataclass(frozen=True, eq=False)
class Relaxed:
    """A relaxed design and the settings to round it with.

    clear : whether it came near unstable states, and was relaxed further clear of them
    """

    at: Search
    settings: ReducedSettings
    clear: bool


def rounded_from(carried: Search, settings: ReducedSettings, watch: Watch, how: Rounding) -> Search | None:
    """A near 0/1 design from a relaxed one that was carried over from another discretisation.

    watch : is shown the phase and the state after each step
    None where no equilibria lead to 0 and 1.
    """
    return rounded_on(relaxed_from(carried, settings, watch, how.relax_iterations), watch, how.most_left)


def relaxed_from(carried: Search, settings: ReducedSettings, watch: Watch, iterations: int) -> Relaxed:
    """A design that was carried over, relaxed further.

    iterations : of relaxing at most
    """
    settings = replace(settings, relax_iterations=iterations, nearly=1.0)
    at = Search(carried.equilibria, carried.design, carried.patch_radius, lam_SMP=carried.lam_SMP, exchanges=EXCHANGED)
    watch("carried over", at)
    return relaxed_clear(relaxed_further(at, settings, watch), settings, watch)


def relaxed_clear(at: Search, settings: ReducedSettings, watch: Watch) -> Relaxed:
    """A relaxed design, relaxed further clear of unstable states if it is near them.

    Where it is not far from them, rounding keeps clear of them.
    """
    ratio = least_ratio(at.equilibria, at.design)
    if ratio < SOFT:
        settings = replace(settings, weights=kept_clear(settings.weights))
    clear = ratio < LEAST_STABLE
    if clear:
        at = relaxed_further(replace(at, phase=Phase.RELAX, iteration=0, slow=0), settings, watch)
    return Relaxed(at, settings, clear)


def relaxed_further(at: Search, settings: ReducedSettings, watch: Watch) -> Search:
    """The same after the phase of relaxing."""
    L = smoothness_matrix(at.equilibria.problem)
    while at.phase is Phase.RELAX:
        at = STEPS[Phase.RELAX](replace(at, accepted=True), settings, L)
        watch(Phase.RELAX.value, at)
    return at


def rounded_on(relaxed: Relaxed, watch: Watch, most_left: float) -> Search | None:
    """A near 0/1 design from a relaxed one in the same elements; None where no equilibria lead to 0 and 1.

    most_left : share of all tets, at most, that is decided by and by where steps are hard, and all where they come to
        nothing; all are so at once where it was relaxed clear of unstable states
    """
    most_left = ANY_SHARE if relaxed.clear else most_left
    at, settings = relaxed.at, replace(relaxed.settings, round_growth=ROUND_GROWTH)
    L, hard, held_back, by_and_by, tried = smoothness_matrix(at.equilibria.problem), 0, 0, relaxed.clear, False
    while True:
        left = undecided_fraction(at.design.rho)
        if by_and_by and not tried and left <= most_left:
            found, tried = decided_by_and_by(at, settings, partial(watch, Phase.ROUND.value)), True
            if found is not None:
                return found
        if at.phase is Phase.DONE or held_back == MOST_HELD_BACK:
            break
        at = STEPS[Phase.ROUND](replace(at, accepted=True), settings, L)
        watch(Phase.ROUND.value, at)
        decided_much = at.accepted and undecided_fraction(at.design.rho) <= LITTLE_DECIDED * left
        hard = hard + 1 if _is_hard(at) else 0
        held_back = held_back + 1 if hard and not decided_much else 0
        by_and_by = hard >= HARD_STEPS
    return decided(at, settings, partial(watch, Phase.ROUND.value))


def kept_clear(weights: ObjectiveWeights) -> ObjectiveWeights:
    """The objective that also keeps the median shape clear of unstable states."""
    return weights.replace(least_stable=LEAST_STABLE, lam_stable=LAM_STABLE)


def least_ratio(equilibria: Equilibria, design: Design) -> float:
    """The least share of its stiffness that a mode of the median shape keeps; inf where no soft mode is found."""
    return float(soft_modes(equilibria, design.rho, design.median).ratios.min(initial=np.inf))


def _is_hard(after: Search) -> bool:
    """Whether a step was not taken, or only with the largest damping."""
    return not after.accepted or after.damping >= LARGEST_DAMPING
