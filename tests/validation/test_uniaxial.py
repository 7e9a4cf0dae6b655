"""Homogeneous states of a block: uniaxial stress, simple shear and dilation, on linear and quadratic tets."""

import numpy as np
import pytest

# Uniaxial stress at mu = 1, kappa = 6.07: stretch -> (lateral stretch, P11), from P22 = 0 solved to 13 digits.
UNIAXIAL = {
    0.5: (1.340488222191, -3.322747429508),
    0.7: (1.163811862371, -1.279587976662),
    1.1: (0.960758286382, 0.258219926887),
    1.5: (0.846438659816, 0.974427369495),
    2.0: (0.758021290477, 1.561061097269),
    3.0: (0.658968434568, 2.393743941715),
}


@pytest.fixture(params=[1, 2], ids=["linear", "quadratic"])
def block(request, bodies):
    """An irregularly meshed unit cube."""
    return bodies.solid(*bodies.irregular_box((2, 2, 2), np.random.default_rng(4)), request.param)


def mean_stress(solid, u: np.ndarray) -> np.ndarray:
    """Volume mean of P (3, 3) from the nodal forces: sum of f_a (x) X_a over the volume."""
    forces = solid.element_forces(u)
    return np.einsum("mai,maj->ij", forces, solid.X[solid.body.elements]) / solid.body.volumes.sum()


def pulled(bodies, solid, stretch: float, steps: int) -> np.ndarray:
    """Equilibrium of the block between two plates on rollers, which move apart in steps."""
    X = solid.X
    rollers = [bodies.dofs(X[:, axis] == 0.0, (axis,)) for axis in range(3)]
    moved = bodies.dofs(X[:, 0] == 1.0, (0,))
    u = np.zeros_like(X)
    for now in np.linspace(1.0, stretch, steps + 1)[1:]:
        # The last state, stretched on: a start without inverted elements.
        u[:, 0] = (now * (X[:, 0] + u[:, 0]) / np.max(X[:, 0] + u[:, 0])) - X[:, 0]
        u = solid.equilibrium(u, np.concatenate([*rollers, moved]), np.zeros_like(X))
    return u


@pytest.mark.parametrize("stretch", UNIAXIAL)
def test_uniaxial_stress(bodies, block, stretch):
    lateral, P11 = UNIAXIAL[stretch]
    u = pulled(bodies, block, stretch, 8)
    X = block.X
    np.testing.assert_allclose(X + u, X * [stretch, lateral, lateral], atol=1e-10)
    right = X[:, 0] == 1.0
    # The plate's area is 1: its reaction is P11, and 12 digits are given.
    assert block.forces(u)[right, 0].sum() == pytest.approx(P11, abs=1e-10)
    np.testing.assert_allclose(mean_stress(block, u), np.diag([P11, 0.0, 0.0]), atol=1e-10)


@pytest.mark.parametrize("shear", [-0.5, 0.2, 1.5])
def test_simple_shear(block, shear):
    u = np.outer(block.X[:, 1], [shear, 0.0, 0.0])
    P = mean_stress(block, u)
    expected = -(shear**2) / 3 * np.eye(3)
    expected[0, 1], expected[1, 0] = shear, shear + shear**3 / 3
    np.testing.assert_allclose(P, expected, atol=1e-12)


@pytest.mark.parametrize("stretch", [0.7, 1.3])
def test_dilation(block, stretch):
    J = stretch**3
    P = mean_stress(block, (stretch - 1) * block.X)
    np.testing.assert_allclose(P, 6.07 * (J - 1) * J ** (2 / 3) * np.eye(3), atol=1e-11)
    assert block.energy((stretch - 1) * block.X) == pytest.approx(6.07 / 2 * (J - 1) ** 2, rel=1e-12)
