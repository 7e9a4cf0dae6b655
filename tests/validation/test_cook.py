"""Cook's membrane in plane strain at finite strain: a tapered panel, clamped left, sheared up along its right edge.

Dead traction mu / 16 on the right edge, mu = 1, kappa = 6.07. The corner C = (48, 60) rises by 6.410 +- 0.002.
Source of the panel: Cook, J. Struct. Div. ASCE 100 (1974) 1851.
"""

import numpy as np
import pytest

RISE = 6.410


def corner_rise(bodies, n: int, order: int) -> float:
    """u_y at C on n x n cells in the plane, one layer of tets across, no motion out of the plane."""
    unit, tets = bodies.box((n, n, 1))
    thickness = 44.0 / n
    x, y, z = unit.T
    X = np.column_stack([48 * x, 44 * x + (44 - 28 * x) * y, thickness * z])
    solid = bodies.solid(X, tets, order)
    right = solid.X[:, 0] > 48 - 1e-9
    load = np.zeros_like(solid.X)
    load[:, 1] = bodies.nodal_areas(solid, right) / 16
    assert load.sum() == pytest.approx(thickness * 16 / 16)
    clamped = bodies.dofs(solid.X[:, 0] < 1e-9, (0, 1))
    plane = bodies.dofs(np.arange(len(solid.X)), (2,))
    u = solid.equilibrium(np.zeros_like(load), np.concatenate([clamped, plane]), load, steps=4)
    corner = np.argmax(solid.X[:, 0] + solid.X[:, 1])
    return float(u[corner, 1])


def extrapolated(coarse: float, middle: float, fine: float) -> float:
    """Limit of a geometric sequence (Aitken): the singular corner (0, 44) lets the error fall as h^1.4 to h^1.2."""
    return fine + (fine - middle) ** 2 / ((middle - coarse) - (fine - middle))


def test_quadratic_tets_reach_the_reference(bodies):
    rises = [corner_rise(bodies, n, 2) for n in (4, 8, 16)]
    assert rises[0] < rises[1] < rises[2] < RISE
    assert rises[2] == pytest.approx(RISE, abs=0.05)
    assert extrapolated(*rises) == pytest.approx(RISE, abs=0.02)


def test_linear_tets_lock(bodies):
    assert corner_rise(bodies, 8, 1) < 0.7 * RISE


@pytest.mark.slow
def test_refined_quadratic_tets_reach_the_reference_closely(bodies):
    rises = [corner_rise(bodies, n, 2) for n in (8, 16, 32)]
    assert extrapolated(*rises) == pytest.approx(RISE, abs=0.006)
