"""Tip-loaded cantilever 8 x 1 x 1 at nu = 0.422: how much too stiff each element is.

Linear tets lock in bending and in twist: with one element across, they give a seventh of the true flexibility. The
tables of ratios are those of model.md section 5; forces on a rig sheet are too large by their inverse.
"""

import numpy as np
import pytest

LENGTH = 8.0
# mu / kappa of the presets: nu = (3 kappa - 2 mu) / (6 kappa + 2 mu) = 0.422.
MU, KAPPA = 1.0, 6.07
YOUNG = 9 * KAPPA * MU / (3 * KAPPA + MU)
NU = (3 * KAPPA - 2 * MU) / (6 * KAPPA + 2 * MU)


def beam(bodies, across: int, order: int):
    return bodies.solid(*bodies.box((8 * across, across, across), (LENGTH, 1.0, 1.0)), order)


def flexibility(bodies, across: int, order: int, load_case: str) -> float:
    """Work of a small end load of unit resultant: deflection of a unit force, or turn of a unit torque."""
    solid = beam(bodies, across, order)
    share = bodies.nodal_areas(solid, solid.X[:, 0] > LENGTH - 1e-9)
    assert share.sum() == pytest.approx(1.0)
    load = np.zeros_like(solid.X)
    arm = solid.X[:, 1:] - 0.5
    if load_case == "bend":
        load[:, 2] = share
    else:
        load[:, 1:] = share[:, None] * np.column_stack([-arm[:, 1], arm[:, 0]])
        load /= np.sum(arm[:, 0] * load[:, 2] - arm[:, 1] * load[:, 1])
    # Small enough for linear elasticity, large enough for its digits.
    size = 1e-7
    u = solid.equilibrium(np.zeros_like(load), bodies.dofs(solid.X[:, 0] < 1e-9), size * load)
    return float(np.sum(load * u)) / size


# Timoshenko, shear factor 5/6; the clamped face, which may not contract, stiffens the bar by about 1 %.
BEND = LENGTH**3 / (3 * YOUNG / 12) + LENGTH / (5 / 6 * MU)
# Saint-Venant, torsion constant of the square 0.1406.
TWIST = LENGTH / (0.1406 * MU)


def test_quadratic_elements_reach_beam_theory(bodies):
    assert flexibility(bodies, 3, 2, "bend") == pytest.approx(BEND, rel=0.025)
    assert flexibility(bodies, 3, 2, "twist") == pytest.approx(TWIST, rel=0.015)


@pytest.mark.parametrize(
    ("across", "order", "ratio"), [(1, 1, 0.15), (2, 1, 0.37), (4, 1, 0.67), (1, 2, 0.93), (2, 2, 0.97)]
)
def test_ratio_of_bending_flexibility(bodies, across, order, ratio):
    assert flexibility(bodies, across, order, "bend") / BEND == pytest.approx(ratio, abs=0.006)


@pytest.mark.parametrize(("across", "ratio"), [(1, 0.17), (2, 0.43), (4, 0.73)])
def test_ratio_of_twisting_flexibility_of_linear_elements(bodies, across, ratio):
    assert flexibility(bodies, across, 1, "twist") / TWIST == pytest.approx(ratio, abs=0.006)


@pytest.mark.parametrize(("load_case", "ratio"), [("bend", 0.87), ("twist", 0.91)])
def test_eight_linear_elements_across_are_still_too_stiff(bodies, load_case, ratio):
    exact = {"bend": BEND, "twist": TWIST}[load_case]
    assert flexibility(bodies, 8, 1, load_case) / exact == pytest.approx(ratio, abs=0.01)
