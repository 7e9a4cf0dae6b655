"""The neo-Hookean solid at a point: closed forms, derivatives, invariances, and felupe as an independent oracle."""

import felupe
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from fab4d.elasticity.neo_hooke import energy_density, first_piola, stress_tangent

MU, KAPPA = 1.3, 6.07


@pytest.fixture
def F() -> np.ndarray:
    """(50, 3, 3) gradients with det F > 0.1."""
    random = np.eye(3) + 0.4 * np.random.default_rng(3).standard_normal((200, 3, 3))
    return random[np.linalg.det(random) > 0.1][:50]


def test_rest_state_is_free_of_energy_and_stress():
    rest = np.eye(3)[None]
    assert energy_density(rest, MU, KAPPA) == pytest.approx(0.0, abs=1e-15)
    np.testing.assert_allclose(first_piola(rest, MU, KAPPA), 0.0, atol=1e-15)


@pytest.mark.parametrize("shear", [-0.7, 0.1, 2.0])
def test_simple_shear_closed_form(shear):
    F = np.eye(3)
    F[0, 1] = shear
    P = first_piola(F[None], MU, KAPPA)[0]
    expected = -MU * shear**2 / 3 * np.eye(3)
    expected[0, 1], expected[1, 0] = MU * shear, MU * (shear + shear**3 / 3)
    np.testing.assert_allclose(P, expected, atol=1e-14)


@pytest.mark.parametrize("stretch", [0.6, 1.0, 1.4])
def test_dilation_closed_form(stretch):
    J = stretch**3
    P = first_piola(stretch * np.eye(3)[None], MU, KAPPA)[0]
    np.testing.assert_allclose(P, KAPPA * (J - 1) * J ** (2 / 3) * np.eye(3), atol=1e-13)


def test_small_strain_limit_is_hookes_law():
    strain = np.random.default_rng(0).standard_normal((3, 3))
    strain = strain + strain.T
    stress = stress_tangent(np.eye(3)[None], strain[None], MU, KAPPA)[0]
    deviator = strain - np.trace(strain) / 3 * np.eye(3)
    np.testing.assert_allclose(stress, 2 * MU * deviator + KAPPA * np.trace(strain) * np.eye(3), rtol=1e-13)


def test_stress_is_the_derivative_of_the_energy(F, bodies):
    H = np.random.default_rng(1).standard_normal(F.shape)
    power = np.einsum("mij,mij->m", first_piola(F, MU, KAPPA), H)
    assert bodies.best_difference_error(lambda F: energy_density(F, MU, KAPPA), power, F, H) < 1e-7


def test_tangent_is_the_derivative_of_the_stress(F, bodies):
    H = np.random.default_rng(1).standard_normal(F.shape)
    dP = stress_tangent(F, H, MU, KAPPA)
    assert bodies.best_difference_error(lambda F: first_piola(F, MU, KAPPA), dP, F, H) < 1e-7


def test_tangent_is_symmetric(F):
    rng = np.random.default_rng(1)
    H, K = rng.standard_normal((2, *F.shape))
    one = np.einsum("mij,mij->m", K, stress_tangent(F, H, MU, KAPPA))
    np.testing.assert_allclose(np.einsum("mij,mij->m", H, stress_tangent(F, K, MU, KAPPA)), one, rtol=1e-9, atol=1e-9)


def test_turning_the_body_turns_the_stress(F):
    R = Rotation.random(len(F), rng=2).as_matrix()
    P = first_piola(F, MU, KAPPA)
    np.testing.assert_allclose(first_piola(R @ F, MU, KAPPA), R @ P, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(first_piola(F @ R, MU, KAPPA), P @ R, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(energy_density(R @ F, MU, KAPPA), energy_density(F, MU, KAPPA), rtol=1e-12)


def test_moments_balance(F):
    """The Kirchhoff stress P F^T is symmetric."""
    tau = first_piola(F, MU, KAPPA) @ np.swapaxes(F, 1, 2)
    np.testing.assert_allclose(tau, np.swapaxes(tau, 1, 2), rtol=1e-9, atol=1e-9)


def test_moduli_may_differ_from_point_to_point(F):
    mu, kappa = np.linspace(1, 2, len(F)), np.linspace(5, 9, len(F))
    P = first_piola(F, mu, kappa)
    np.testing.assert_allclose(P[7], first_piola(F[7:8], mu[7], kappa[7])[0], rtol=1e-13)


def test_felupe_agrees(F):
    """felupe.NeoHooke(mu, bulk) is the same energy; it keeps quadrature points and cells on trailing axes."""
    umat = felupe.NeoHooke(mu=MU, bulk=KAPPA)
    trailing = np.moveaxis(F, 0, -1)[..., None, :]
    P = np.moveaxis(umat.gradient([trailing, None])[0][..., 0, :], -1, 0)
    np.testing.assert_allclose(first_piola(F, MU, KAPPA), P, rtol=1e-9, atol=1e-9)
    H = np.random.default_rng(1).standard_normal(F.shape)
    A = umat.hessian([trailing, None])[0][..., 0, :]
    dP = np.einsum("ijklm,mkl->mij", A, H)
    np.testing.assert_allclose(stress_tangent(F, H, MU, KAPPA), dP, rtol=1e-8, atol=1e-8)
