"""The inversion-safe energy has the right gradient, and mending moves no more than it must."""

import numpy as np
import pytest

from fab4d.elasticity._untangle_kernels import regularised_energy
from fab4d.elasticity.untangle import untangle
from fab4d.mesh.measures import deformation_gradients, edge_matrices

CENTRE = np.array([[0.0, 0, 0], [10, 0, 0], [0, 10, 0], [0, 0, 10], [2.5, 2.5, 2.5]])
NONE, SURFACE = np.zeros(5, bool), np.arange(5) < 4
# One tet split in four at an inner vertex.
TETS = np.array([[4, 1, 2, 3], [0, 4, 2, 3], [0, 1, 4, 3], [0, 1, 2, 4]])


@pytest.mark.parametrize("epsilon", [1.0, 0.1, 1e-3])
def test_the_gradient_is_that_of_the_energy_also_where_inverted(epsilon: float) -> None:
    rng = np.random.default_rng(0)
    X, inverse, shares = CENTRE / 10, np.linalg.inv(edge_matrices(CENTRE / 10, TETS)), rng.random(4)
    y = X + rng.normal(size=X.shape) * 0.4
    assert np.linalg.det(deformation_gradients(X, y, TETS)).min() < 0
    gradient, direction = np.zeros_like(y), rng.normal(size=y.shape)
    regularised_energy(y, TETS, inverse, shares, epsilon, gradient)

    def energy(step: float) -> float:
        return regularised_energy(y + step * direction, TETS, inverse, shares, epsilon, np.zeros_like(y))

    slope = np.vdot(gradient, direction)
    errors = [abs((energy(h) - energy(-h)) / (2 * h) - slope) / abs(slope) for h in (1e-4, 1e-5, 1e-6, 1e-7)]
    assert min(errors) < 1e-7


def test_a_sound_shape_is_returned_as_it_is() -> None:
    mended = untangle(CENTRE, CENTRE * 1.1, TETS, NONE)
    np.testing.assert_array_equal(mended.x, CENTRE * 1.1)
    assert (mended.surface_moved, mended.moved) == (0, 0)


@pytest.mark.parametrize("outside", [[20, 20, 20], [-30, 1, 2], [2.5, 2.5, -0.01]])
def test_an_inner_vertex_is_brought_back_and_the_surface_stays(outside: list[float]) -> None:
    x = CENTRE.copy()
    x[4] = outside
    mended = untangle(CENTRE, x, TETS, SURFACE)
    np.testing.assert_array_equal(mended.x[:4], CENTRE[:4])
    assert mended.surface_moved == 0
    # The best place by symmetry of the energy is near the centroid.
    np.testing.assert_allclose(mended.x[4], CENTRE[4], atol=0.2)
    assert mended.min_det_F == pytest.approx(np.linalg.det(deformation_gradients(CENTRE, mended.x, TETS)).min())
    assert mended.min_det_F > 0.8


def test_an_inverted_surface_moves_just_as_far_as_told() -> None:
    x = CENTRE.copy()
    x[3, 2] = -0.1
    mended = untangle(CENTRE, x, TETS, NONE)
    assert mended.min_det_F > 0
    assert mended.surface_moved == pytest.approx(np.linalg.norm(mended.x - x, axis=1)[:4].max())
    assert mended.surface_moved > 0.1
