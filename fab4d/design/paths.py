"""Paths of equilibria from one density to another, in steps that are halved where they lead to none."""

from collections.abc import Callable
from functools import partial

import numpy as np

from fab4d.design.equilibria import Equilibria
from fab4d.design.gauss_newton import (
    FIRST_DAMPING,
    STIFFER,
    Ahead,
    Design,
    build_model,
    equilibrate,
    guessed,
    held_positions,
    prescribed_step,
)
from fab4d.design.objective import ObjectiveWeights, smoothness_matrix
from fab4d.errors import EquilibriumError
from fab4d.mesh.tetmesh import FloatArray
from fab4d.solvers.threads import first_found

# So many steps lead on before a longer one is tried: one that failed fails mostly again.
BEFORE_LONGER = 3
# Labels whose equilibria are farther away than steps of this share of the change go are given up.
SMALLEST_STEP = 0.25
# Steps that held positions follow may be so many times shorter: they are quicker, and keep the error low.
FINER = 8.0

# The share of the rest of the way from a design, and how many tries have failed there -> the design at the end of that
# share, None where no equilibrium is found.
Try = Callable[[float, int], Design | None]
# A design -> tries from there.
Lead = Callable[[Design], Try]


def change_density(
    equilibria: Equilibria, design: Design, rho: FloatArray, smallest: float = 1e-3, stay: bool = False
) -> Design:
    """The design with density rho (m,) at the same held positions.

    smallest : share of the way that a step may come down to        stay : see `newton`
    Raises EquilibriumError when the path ends before.
    """
    return _arrived(*toward_density(equilibria, design, rho, smallest, stay))


def toward_density(
    equilibria: Equilibria, design: Design, rho: FloatArray, smallest: float, stay: bool = False
) -> tuple[Design, float]:
    """As `change_density`, as far as the path leads: the design there, and its share of the way."""
    held = held_positions(equilibria, design.median)
    return _along(equilibria, design, 0.0, _by_unloading(equilibria, rho, held, stay), smallest)


def follow_density(
    equilibria: Equilibria, design: Design, rho: FloatArray, weights: ObjectiveWeights, ahead: Ahead
) -> Design:
    """The design with density rho (m,), and held positions that follow it so that the objective stays low.

    ahead : what the change does, held positions that move along included
    As far as that leads at once; then by linear models, made anew in each step. Unloading, which takes longer, leads on
    where these come to nothing. A step ends at unstable states.
    Raises EquilibriumError when the path ends before.
    """
    design, done = _at_once(equilibria, design, rho, ahead)
    design, done = _along(equilibria, design, done, _by_models(equilibria, rho, weights), SMALLEST_STEP / FINER)
    held = held_positions(equilibria, design.median) + (1.0 - done) * ahead.moves
    return _arrived(*_along(equilibria, design, done, _by_unloading(equilibria, rho, held, stay=True), SMALLEST_STEP))


def _at_once(equilibria: Equilibria, design: Design, rho: FloatArray, ahead: Ahead) -> tuple[Design, float]:
    """The farthest design that is found where `ahead` has it, and its share of the way."""
    held = held_positions(equilibria, design.median)

    def tried(share: float) -> Design | None:
        mixed, part = _between(design.rho, rho, share), ahead.part(share)
        guess = guessed(equilibria, design, mixed, part)
        return equilibrate(equilibria, mixed, held + part.moves, *guess, stay=True, near=ahead.near)

    shares = _halved(1.0, SMALLEST_STEP)
    found = first_found([partial(tried, share) for share in shares], 3 * equilibria.problem.n_nodes)
    return (design, 0.0) if found is None else (found[1], shares[found[0]])


def _by_models(equilibria: Equilibria, rho: FloatArray, weights: ObjectiveWeights) -> Lead:
    """Steps on a linear model of the objective at each design; what fails damps the held positions of the next try."""
    L = smoothness_matrix(equilibria.problem)

    def lead(at: Design) -> Try:
        model = build_model(equilibria, weights, L, at)

        def tried(share: float, failed: int) -> Design | None:
            damping = FIRST_DAMPING * STIFFER**failed
            return prescribed_step(equilibria, model, at, _between(at.rho, rho, share), damping)

        return tried

    return lead


def _by_unloading(equilibria: Equilibria, rho: FloatArray, held: FloatArray, stay: bool) -> Lead:
    """Steps from the shapes before, or else by unloading; the held positions move to `held` (K, 3) on the way."""

    def lead(at: Design) -> Try:
        guess = at.median.x, at.median.forces, at.final.y

        def tried(share: float, _failed: int) -> Design | None:
            mixed = _between(at.rho, rho, share)
            moved = _between(held_positions(equilibria, at.median), held, share)
            return equilibrate(equilibria, mixed, moved, *guess, stay=stay, by_unloading=True)

        return tried

    return lead


def _between(start: FloatArray, end: FloatArray, share: float) -> FloatArray:
    return end if share == 1.0 else start + share * (end - start)


def _along(equilibria: Equilibria, design: Design, done: float, lead: Lead, smallest: float) -> tuple[Design, float]:
    """The last design that `lead` comes to from `done` on the way to 1, and where it is.

    A length that has failed is not tried again before BEFORE_LONGER steps of half of it have led on.
    """
    step, failed, led_on = 1.0 - done, np.inf, 0
    while done < 1.0 and step >= smallest:
        lengths, tried = _halved(step, smallest), lead(design)
        aims = [min(1.0, done + length) for length in lengths]
        shares = [(aim - done) / (1.0 - done) for aim in aims]
        tries = [partial(tried, share, failures) for failures, share in enumerate(shares)]
        found = first_found(tries, 3 * equilibria.problem.n_nodes)
        if found is None:
            break
        failures, design = found
        step, done, led_on = lengths[failures], aims[failures], 1 if failures else led_on + 1
        failed = 2 * step if failures else failed
        if 2 * step < failed or led_on == BEFORE_LONGER:
            step, failed = 2 * step, np.inf
    return design, done


def _halved(longest: float, smallest: float) -> list[float]:
    """Lengths of steps to try: each half of the one before, the last at least `smallest`."""
    lengths = list[float]()
    while longest >= smallest:
        lengths.append(longest)
        longest /= 2
    return lengths


def _arrived(design: Design, done: float) -> Design:
    if done < 1.0:
        msg = "the printed labels have no equilibrium near that of the relaxed design"
        raise EquilibriumError(msg)
    return design
