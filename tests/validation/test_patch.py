"""Patch test: an affine boundary gives an affine inside, whatever the mesh, with no force on any inner node."""

import numpy as np
import pytest

GRADIENT = np.array([[0.2, 0.3, -0.1], [0.0, -0.15, 0.25], [0.1, -0.2, 0.1]])


@pytest.mark.parametrize("order", [1, 2], ids=["linear", "quadratic"])
def test_affine_displacements_are_reproduced(bodies, order):
    rng = np.random.default_rng(6)
    solid = bodies.solid(*bodies.irregular_box((3, 3, 3), rng, 0.25), order)
    X = solid.X
    inside = np.all((X > 1e-9) & (X < 1 - 1e-9), axis=1)
    affine = X @ GRADIENT.T + [0.5, -0.2, 0.1]
    size = np.abs(solid.forces(affine)).max()
    np.testing.assert_allclose(solid.forces(affine)[inside], 0.0, atol=1e-13 * size)
    start = affine + inside[:, None] * 0.01 * rng.standard_normal(X.shape)
    u = solid.equilibrium(start, bodies.dofs(~inside), np.zeros_like(X))
    assert np.abs(start - affine).max() > 0.01
    np.testing.assert_allclose(u, affine, atol=1e-11)


def test_the_patch_test_fails_for_a_bent_boundary(bodies):
    solid = bodies.solid(*bodies.box((3, 3, 3)))
    X = solid.X
    inside = np.all((X > 1e-9) & (X < 1 - 1e-9), axis=1)
    bent = 0.2 * X**2
    assert np.abs(solid.forces(bent)[inside]).max() > 1e-3 * np.abs(solid.forces(bent)).max()
