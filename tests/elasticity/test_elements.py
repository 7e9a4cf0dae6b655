"""Shape functions and quadrature of linear and quadratic tets."""

import numpy as np
import pytest

from fab4d.elasticity.elements import QUADRATURE_4
from fab4d.mesh.measures import tet_volumes


@pytest.fixture(params=[1, 2], ids=["linear", "quadratic"])
def order(request) -> int:
    return request.param


def test_volumes_are_those_of_the_tets(bodies, order):
    X, tets = bodies.irregular_box((2, 3, 2), np.random.default_rng(0))
    body = bodies.solid(X, tets, order).body
    assert body.order == order
    np.testing.assert_allclose(body.volumes, tet_volumes(X, tets), rtol=1e-12)
    assert body.volumes.sum() == pytest.approx(1.0, rel=1e-12)


def test_gradients_of_polynomials_up_to_the_order_are_exact(bodies, order):
    """Constants have gradient 0, X has gradient I, and X_i X_j (quadratic) is differentiated exactly."""
    X, tets = bodies.irregular_box((2, 2, 2), np.random.default_rng(1))
    body = bodies.solid(X, tets, order).body
    np.testing.assert_allclose(body.dN.sum(axis=2), 0.0, atol=1e-11)
    at_nodes = body.X[body.elements]
    gradient = np.einsum("mai,mqaj->mqij", at_nodes, body.dN)
    np.testing.assert_allclose(gradient, np.broadcast_to(np.eye(3), gradient.shape), atol=1e-11)
    if order == 2:
        points = np.einsum("qc,mci->mqi", QUADRATURE_4, at_nodes[:, :4])
        square = np.einsum("ma,mqaj->mqj", at_nodes[:, :, 0] * at_nodes[:, :, 1], body.dN)
        expected = np.stack([points[..., 1], points[..., 0], 0 * points[..., 0]], axis=-1)
        # 8 digits: the quadrature points are given with 8.
        np.testing.assert_allclose(square, expected, atol=1e-7)


def test_four_point_rule_is_exact_for_quadratics():
    """Integral of L_i L_j over a tet of volume 1 is (1 + delta_ij) / 20."""
    mean = np.einsum("qi,qj->ij", QUADRATURE_4, QUADRATURE_4) / 4
    np.testing.assert_allclose(mean, (1 + np.eye(4)) / 20, atol=1e-8)
    np.testing.assert_allclose(QUADRATURE_4.sum(axis=1), 1.0, rtol=1e-15)
