"""Compiled energies, forces and tangents: derivatives, invariances, precision at tiny strains, felupe."""

import felupe
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from fab4d.elasticity import _kernels as kernels
from fab4d.elasticity.neo_hooke import energy_density, first_piola


@pytest.fixture(params=[1, 2], ids=["linear", "quadratic"])
def solid(request, bodies):
    X, tets = bodies.irregular_box((2, 2, 2), np.random.default_rng(0))
    plain = bodies.solid(X, tets, request.param)
    contrast = np.where(np.arange(len(tets)) % 3 == 0, 158.0, 1.0)
    return bodies.Solid(plain.body, plain.mu * contrast, plain.kappa * contrast)


@pytest.fixture
def u(solid) -> np.ndarray:
    """Large displacements that invert no element: a bend and a stretch, and noise."""
    x, y, z = solid.X.T
    noise = 0.02 * np.random.default_rng(1).standard_normal(solid.X.shape)
    u = np.column_stack([0.3 * x + 0.1 * y * z, 0.4 * x * x, -0.2 * z + 0.1 * x * y]) + noise
    assert np.isfinite(solid.energy(u))
    return u


def gradients(solid, u: np.ndarray) -> np.ndarray:
    """F (m, nq, 3, 3)."""
    return np.eye(3) + np.einsum("mai,mqaj->mqij", u[solid.body.elements], solid.body.dN)


def test_energy_and_forces_equal_the_numpy_form(solid, u):
    F, w = gradients(solid, u), solid.body.weights
    mu, kappa = solid.mu[:, None], solid.kappa[:, None]
    assert solid.energy(u) == pytest.approx(np.sum(w * energy_density(F, mu, kappa)), rel=1e-12)
    forces = np.einsum("mq,mqij,mqaj->mai", w, first_piola(F, mu, kappa), solid.body.dN)
    np.testing.assert_allclose(solid.element_forces(u), forces, atol=1e-12 * np.abs(forces).max())


def test_forces_are_the_gradient_of_the_energy(solid, u, bodies):
    direction = np.random.default_rng(2).standard_normal(u.shape)
    slope = np.sum(solid.forces(u) * direction)
    assert bodies.best_difference_error(solid.energy, slope, u, direction) < 1e-7


def test_tangent_is_the_derivative_of_the_forces(solid, u, bodies):
    direction = np.random.default_rng(2).standard_normal(u.shape)
    change = (solid.stiffness(u) @ direction.ravel()).reshape(u.shape)
    assert bodies.best_difference_error(solid.forces, change, u, direction) < 1e-7


def test_tangents_of_the_elements_add_up_to_the_tangent(solid, u):
    direction = np.random.default_rng(2).standard_normal(u.shape)
    elements, change = solid.body.elements, np.zeros_like(u)
    np.add.at(change, elements, np.einsum("mabik,mbk->mai", solid.element_tangents(u), direction[elements]))
    expected = (solid.stiffness(u) @ direction.ravel()).reshape(u.shape)
    np.testing.assert_allclose(change, expected, atol=1e-12 * np.abs(expected).max())


def test_mixed_block_is_the_derivative_with_respect_to_the_median_shape(solid, u, bodies):
    """Forces of the glassy term at fixed y, differentiated with respect to the shape x that it is stress-free in."""
    rng = np.random.default_rng(5)
    x, y = solid.X + u, solid.X + u + 0.01 * rng.standard_normal(u.shape)

    def frozen_in(x: np.ndarray):
        dN = np.zeros_like(solid.body.dN)
        kernels.deformed_gradients(solid.body.elements, solid.body.dN, x - solid.X, dN)
        body = bodies.Discretisation(x, solid.body.elements, dN, solid.body.weights)
        return bodies.Solid(body, solid.mu, solid.kappa)

    direction = rng.standard_normal(u.shape)
    blocks = frozen_in(x).mixed(y - x)
    change = np.zeros_like(u)
    elements = solid.body.elements
    np.add.at(change, elements, np.einsum("mabik,mbk->mai", blocks, direction[elements]))
    assert bodies.best_difference_error(lambda x: frozen_in(x).forces(y - x), change, x, direction) < 1e-7


def test_deformed_gradients_are_those_of_the_deformed_mesh(bodies):
    X, tets = bodies.irregular_box((2, 2, 2), np.random.default_rng(0))
    u = 0.03 * np.random.default_rng(1).standard_normal(X.shape)
    before, after = bodies.solid(X, tets).body, bodies.solid(X + u, tets).body
    dN = np.zeros_like(before.dN)
    smallest = kernels.deformed_gradients(before.elements, before.dN, u, dN)
    np.testing.assert_allclose(dN, after.dN, rtol=1e-10, atol=1e-10)
    assert smallest == pytest.approx(np.min(after.volumes / before.volumes), rel=1e-10)


def test_forces_and_moments_of_each_element_balance(solid, u):
    forces, x = solid.element_forces(u), (solid.X + u)[solid.body.elements]
    size = np.abs(forces).max()
    np.testing.assert_allclose(forces.sum(axis=1), 0.0, atol=1e-13 * size)
    np.testing.assert_allclose(np.cross(x, forces).sum(axis=1), 0.0, atol=1e-12 * size)
    total = np.zeros_like(u)
    np.add.at(total, solid.body.elements, forces)
    np.testing.assert_allclose(solid.forces(u), total, atol=1e-13 * size)


def test_rigid_motion_costs_nothing(solid):
    R = Rotation.from_rotvec([0.3, -2.0, 1.1]).as_matrix()
    u = solid.X @ R.T + [5.0, -3.0, 2.0] - solid.X
    assert abs(solid.energy(u)) < 1e-12
    np.testing.assert_allclose(solid.forces(u), 0.0, atol=1e-11)


def test_turning_the_deformed_body_turns_its_forces(solid, u):
    R = Rotation.from_rotvec([0.3, -2.0, 1.1]).as_matrix()
    turned = (solid.X + u) @ R.T + [1.0, 2.0, 3.0] - solid.X
    assert solid.energy(turned) == pytest.approx(solid.energy(u), rel=1e-12, abs=0.0)
    forces = solid.forces(u) @ R.T
    np.testing.assert_allclose(solid.forces(turned), forces, atol=1e-11 * np.abs(forces).max())


@pytest.mark.parametrize("strain", [1e-6, 1e-9, 1e-12])
def test_tiny_strains_keep_their_digits(solid, strain):
    """Forces against Hooke's law, which they approach as the strain itself."""
    gradient = strain * np.random.default_rng(8).standard_normal((3, 3))
    e = 0.5 * (gradient + gradient.T)
    trace = np.trace(e) * np.eye(3)
    stress = 2 * solid.mu[:, None, None] * (e - trace / 3) + solid.kappa[:, None, None] * trace
    hooke = np.einsum("mq,mij,mqaj->mai", solid.body.weights, stress, solid.body.dN)
    forces = solid.element_forces(solid.X @ gradient.T)
    assert np.linalg.norm(forces - hooke) < max(20 * strain, 1e-12) * np.linalg.norm(hooke)


def test_tiny_strains_keep_the_digits_of_the_energy(solid):
    u = 1e-9 * np.random.default_rng(8).standard_normal(solid.X.shape)
    quadratic = 0.5 * u.ravel() @ (solid.stiffness(np.zeros_like(u)) @ u.ravel())
    assert solid.energy(u) == pytest.approx(quadratic, rel=1e-6, abs=0.0)


def test_an_inverted_element_has_infinite_energy_and_reports_its_determinant(bodies):
    X, tets = bodies.box((1, 1, 1))
    solid = bodies.solid(X, tets)
    u = np.zeros_like(X)
    u[:, 0] = -1.5 * X[:, 0]
    body = solid.body
    energy, smallest = kernels.energy(body.elements, body.dN, body.weights, solid.mu, solid.kappa, u)
    assert energy == np.inf
    assert smallest == pytest.approx(-0.5)
    energy, _ = kernels.gradient(body.elements, body.dN, body.weights, solid.mu, solid.kappa, u, np.zeros_like(u))
    assert energy == np.inf


@pytest.mark.parametrize(("length", "stress"), [(1e-3, 1.0), (25.4, 1e6), (1e3, 1e-6)])
def test_units_of_length_and_stress_scale_out(solid, u, bodies, length, stress):
    body = bodies.discretise(length * solid.X, solid.body.elements)
    other = bodies.Solid(body, stress * solid.mu, stress * solid.kappa)
    assert other.energy(length * u) == pytest.approx(stress * length**3 * solid.energy(u), rel=1e-12, abs=0.0)
    forces = stress * length**2 * solid.forces(u)
    np.testing.assert_allclose(other.forces(length * u), forces, atol=1e-12 * np.abs(forces).max())
    K = stress * length * solid.stiffness(u).toarray()
    np.testing.assert_allclose(other.stiffness(length * u).toarray(), K, atol=1e-12 * np.abs(K).max())


def test_felupe_assembles_the_same_forces_and_stiffness(bodies, solid):
    linear = solid.body.order == 1
    plain = bodies.Solid(solid.body, np.ones_like(solid.mu), np.full_like(solid.mu, 6.07))
    mesh = felupe.Mesh(solid.X, solid.body.elements, "tetra" if linear else "tetra10")
    region = felupe.RegionTetra(mesh) if linear else felupe.RegionQuadraticTetra(mesh)
    field = felupe.FieldContainer([felupe.Field(region, dim=3)])
    u = field[0].values[:] = 0.03 * np.random.default_rng(1).standard_normal(solid.X.shape)
    body = felupe.SolidBody(felupe.NeoHooke(mu=1.0, bulk=6.07), field)
    # The points of the quadratic rule are given with 8 digits.
    digits = 1e-12 if linear else 1e-7
    forces, K = body.assemble.vector().toarray().ravel(), body.assemble.matrix().toarray()
    np.testing.assert_allclose(plain.forces(u).ravel(), forces, atol=digits * np.abs(forces).max())
    np.testing.assert_allclose(plain.stiffness(u).toarray(), K, atol=digits * np.abs(K).max())
