"""Paths of equilibria from one density to another, in steps that are halved where they lead to none."""

from collections.abc import Callable

import numpy as np

from fab4d.design.equilibria import Equilibria
from fab4d.design.gauss_newton import (
    FIRST_DAMPING,
    STIFFER,
    Ahead,
    Design,
    Model,
    build_model,
    equilibrate,
    guessed,
    held_positions,
    prescribed_step,
)
from fab4d.design.objective import ObjectiveWeights, smoothness_matrix
from fab4d.errors import EquilibriumError
from fab4d.mesh.tetmesh import FloatArray

# So many steps lead on before a longer one is tried: one that failed fails mostly again.
BEFORE_LONGER = 3
# Labels whose equilibria are farther away than steps of this share of the change go are given up.
SMALLEST_STEP = 0.25
# Steps that held positions follow may be so many times shorter: they are quicker, and keep the error low.
FINER = 8.0

# A design and the share of the rest of the way -> the design there, None where no equilibrium is found.
Lead = Callable[[Design, float], Design | None]


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
    return _along(design, 0.0, _by_unloading(equilibria, rho, held, stay), smallest)


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
    design, done = _along(design, done, _by_models(equilibria, rho, weights), SMALLEST_STEP / FINER)
    held = held_positions(equilibria, design.median) + (1.0 - done) * ahead.moves
    return _arrived(*_along(design, done, _by_unloading(equilibria, rho, held, stay=True), SMALLEST_STEP))


def _at_once(equilibria: Equilibria, design: Design, rho: FloatArray, ahead: Ahead) -> tuple[Design, float]:
    """The farthest design that is found where `ahead` has it, and its share of the way."""
    held, share = held_positions(equilibria, design.median), 1.0
    while share >= SMALLEST_STEP:
        mixed, part = _between(design.rho, rho, share), ahead.part(share)
        guess = guessed(equilibria, design, mixed, part)
        found = equilibrate(equilibria, mixed, held + part.moves, *guess, stay=True, near=ahead.near)
        if found is not None:
            return found, share
        share /= 2
    return design, 0.0


def _by_models(equilibria: Equilibria, rho: FloatArray, weights: ObjectiveWeights) -> Lead:
    """Steps on a linear model of the objective at each design; what fails damps the held positions of the next try."""
    L = smoothness_matrix(equilibria.problem)
    known: tuple[Design, Model] | None = None
    damping = FIRST_DAMPING

    def lead(at: Design, share: float) -> Design | None:
        nonlocal known, damping
        if known is None or known[0] is not at:
            known, damping = (at, build_model(equilibria, weights, L, at)), FIRST_DAMPING
        found = prescribed_step(equilibria, known[1], at, _between(at.rho, rho, share), damping)
        damping *= STIFFER
        return found

    return lead


def _by_unloading(equilibria: Equilibria, rho: FloatArray, held: FloatArray, stay: bool) -> Lead:
    """Steps from the shapes before, or else by unloading; the held positions move to `held` (K, 3) on the way."""

    def lead(at: Design, share: float) -> Design | None:
        mixed = _between(at.rho, rho, share)
        moved = _between(held_positions(equilibria, at.median), held, share)
        guess = at.median.x, at.median.forces, at.final.y
        return equilibrate(equilibria, mixed, moved, *guess, stay=stay, by_unloading=True)

    return lead


def _between(start: FloatArray, end: FloatArray, share: float) -> FloatArray:
    return end if share == 1.0 else start + share * (end - start)


def _along(design: Design, done: float, lead: Lead, smallest: float) -> tuple[Design, float]:
    """The last design that `lead` comes to from `done` on the way to 1, and where it is.

    A length that has failed is not tried again before BEFORE_LONGER steps of half of it have led on.
    """
    step, failed, led_on = 1.0 - done, np.inf, 0
    while done < 1.0 and step >= smallest:
        aim = min(1.0, done + step)
        trial = lead(design, (aim - done) / (1.0 - done))
        if trial is not None:
            design, done, led_on = trial, aim, led_on + 1
            if 2 * step < failed or led_on == BEFORE_LONGER:
                step, failed = 2 * step, np.inf
        else:
            step, failed, led_on = step / 2, step, 0
    return design, done


def _arrived(design: Design, done: float) -> Design:
    if done < 1.0:
        msg = "the printed labels have no equilibrium near that of the relaxed design"
        raise EquilibriumError(msg)
    return design
