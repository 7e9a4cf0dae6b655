"""The positive semidefinite part of the tangent against eigenvalues of the full 9 x 9 derivative."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from fab4d.elasticity import _kernels as kernels
from fab4d.elasticity.neo_hooke import stress_tangent


def point_tangent(F: np.ndarray, mu: float, kappa: float) -> np.ndarray:
    """dP/dF (9, 9)."""
    unit = np.eye(9).reshape(9, 3, 3)
    return stress_tangent(np.broadcast_to(F, (9, 3, 3)), unit, mu, kappa).reshape(9, 9).T


def clamped(A: np.ndarray) -> np.ndarray:
    values, vectors = np.linalg.eigh(0.5 * (A + A.T))
    return (vectors * np.maximum(values, 0.0)) @ vectors.T


def projected_stiffness(solid, u: np.ndarray) -> np.ndarray:
    """The stiffness with every 9 x 9 block clamped by `eigh`."""
    body, n = solid.body, len(solid.X)
    K = np.zeros((n, 3, n, 3))
    for m, nodes in enumerate(body.elements):
        for dN, w in zip(body.dN[m], body.weights[m], strict=True):
            A = clamped(point_tangent(np.eye(3) + u[nodes].T @ dN, solid.mu[m], solid.kappa[m])).reshape(3, 3, 3, 3)
            block = w * np.einsum("ijkl,aj,bl->aibk", A, dN, dN)
            K[np.ix_(nodes, range(3), nodes, range(3))] += block
    return K.reshape(3 * n, 3 * n)


def single_tet(bodies, F: np.ndarray):
    """One tet under the constant gradient F: the body and its displacements."""
    X = np.random.default_rng(3).standard_normal((4, 3))
    X = X if np.linalg.det(X[1:] - X[0]) > 0 else X[[0, 2, 1, 3]]
    return bodies.solid(X, np.arange(4)[None]), X @ (F - np.eye(3)).T


@pytest.mark.parametrize(
    "stretches",
    [(1, 1, 1), (1.2, 1.2, 1.2), (0.6, 0.6, 0.6), (0.5, 0.5, 1.3), (0.4, 1, 1), (2, 2, 0.3), (0.3, 0.7, 1.9)],
    ids=str,
)
def test_equals_the_eigenvalue_clamp_also_for_equal_stretches(bodies, stretches):
    U, V = Rotation.random(2, rng=7).as_matrix()
    solid, u = single_tet(bodies, U @ np.diag(stretches) @ V.T)
    expected = projected_stiffness(solid, u)
    actual = solid.stiffness(u, kernels.tangent_spd).toarray()
    np.testing.assert_allclose(actual, expected, atol=1e-12 * np.abs(expected).max())


@pytest.mark.parametrize("order", [1, 2], ids=["linear", "quadratic"])
def test_equals_the_eigenvalue_clamp_in_a_distorted_body(bodies, order):
    X, tets = bodies.irregular_box((2, 1, 2), np.random.default_rng(0))
    solid = bodies.solid(X, tets, order)
    u = 0.01 * np.random.default_rng(2).standard_normal(solid.X.shape) - 0.45 * solid.X * [0, 0, 1]
    assert np.isfinite(solid.energy(u))
    expected = projected_stiffness(solid, u)
    actual = solid.stiffness(u, kernels.tangent_spd).toarray()
    full = solid.stiffness(u).toarray()
    assert np.linalg.eigvalsh(full)[0] < -1e-3 * np.abs(full).max()
    np.testing.assert_allclose(actual, expected, atol=1e-12 * np.abs(expected).max())
    assert np.linalg.eigvalsh(actual)[0] > -1e-12 * np.abs(actual).max()


def test_changes_nothing_where_every_point_is_positive(bodies):
    """A small stretch in all directions has no negative eigenvalue."""
    X, tets = bodies.irregular_box((2, 2, 2), np.random.default_rng(0))
    solid = bodies.solid(X, tets)
    u = 0.02 * X + 1e-4 * np.random.default_rng(1).standard_normal(X.shape)
    F = np.eye(3) + np.einsum("mai,mqaj->mqij", u[tets], solid.body.dN)[:, 0]
    assert min(np.linalg.eigvalsh(point_tangent(f, 1.0, 6.07))[0] for f in F) > 0
    full = solid.stiffness(u).toarray()
    projected = solid.stiffness(u, kernels.tangent_spd).toarray()
    np.testing.assert_allclose(projected, full, atol=1e-12 * np.abs(full).max())


def test_nearly_equal_stretches_give_nearly_equal_matrices(bodies):
    """No division by differences of stretches: a change of 1e-9 moves the matrix by about as much."""
    solid, u = single_tet(bodies, np.diag([0.7, 0.7, 0.7]))
    _, v = single_tet(bodies, np.diag([0.7, 0.7 + 1e-9, 0.7 - 1e-9]))
    one, other = (solid.stiffness(w, kernels.tangent_spd).toarray() for w in (u, v))
    np.testing.assert_allclose(other, one, atol=1e-7 * np.abs(one).max())
