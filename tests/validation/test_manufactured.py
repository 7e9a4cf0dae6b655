"""Orders of convergence against a manufactured solution: 2 for linear, 3 for quadratic tets, in the L2 norm.

The displacement is chosen, the body force that it needs follows from -div P, both at finite strain.
"""

import numpy as np
import pytest

from fab4d.elasticity.neo_hooke import first_piola
from fab4d.mesh.measures import edge_matrices
from fab4d.mesh.topology import TET_EDGES

AMPLITUDE = 0.15
WAVE = np.pi / 2


def displacement(X: np.ndarray) -> np.ndarray:
    x, y, z = WAVE * np.moveaxis(X, -1, 0)
    return AMPLITUDE * np.stack([np.sin(x) * np.cos(y), np.sin(y) * np.sin(z), np.cos(x) * np.sin(z)], axis=-1)


def gradient(X: np.ndarray) -> np.ndarray:
    """F = I + grad u (..., 3, 3)."""
    x, y, z = WAVE * np.moveaxis(X, -1, 0)
    zero = np.zeros_like(x)
    rows = [
        [np.cos(x) * np.cos(y), -np.sin(x) * np.sin(y), zero],
        [zero, np.cos(y) * np.sin(z), np.sin(y) * np.cos(z)],
        [-np.sin(x) * np.sin(z), zero, np.cos(x) * np.cos(z)],
    ]
    return np.eye(3) + AMPLITUDE * WAVE * np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def body_force(X: np.ndarray) -> np.ndarray:
    """-div P by fourth-order differences, exact to 1e-11."""
    total, h = np.zeros_like(X), 1e-3
    for j in range(3):
        step = h * np.eye(3)[j]
        column = [first_piola(gradient(X + k * step), 1.0, 6.07)[..., j] for k in (-2, -1, 1, 2)]
        total -= (column[0] - 8 * column[1] + 8 * column[2] - column[3]) / (12 * h)
    return total


def collapsed_gauss(n: int = 3) -> tuple[np.ndarray, np.ndarray]:
    """Barycentric points (q, 4) and weights (q,), sum 1, of a rule exact to degree 2 n - 3 on a tet."""
    t, w = np.polynomial.legendre.leggauss(n)
    t, w = 0.5 * (t + 1), 0.5 * w
    a, b, c = (g.ravel() for g in np.meshgrid(t, t, t, indexing="ij"))
    weights = np.einsum("i,j,k->ijk", w, w, w).ravel() * 6 * (1 - a) ** 2 * (1 - b)
    points = np.column_stack([a, (1 - a) * b, (1 - a) * (1 - b) * c])
    return np.column_stack([1 - points.sum(axis=1), points]), weights


def shape_functions(L: np.ndarray, order: int) -> np.ndarray:
    """(q, nn) values at barycentric points."""
    if order == 1:
        return L
    i, j = TET_EDGES.T
    return np.hstack([L * (2 * L - 1), 4 * L[:, i] * L[:, j]])


def l2_error(bodies, n: int, order: int) -> float:
    solid = bodies.solid(*bodies.box((n, n, n)), order)
    body, X = solid.body, solid.X
    L, weights = collapsed_gauss()
    N = shape_functions(L, order)
    points = np.einsum("qc,mci->mqi", L, X[body.elements[:, :4]])
    dV = np.linalg.det(edge_matrices(X, body.elements[:, :4]))[:, None] / 6 * weights
    load = np.zeros_like(X)
    np.add.at(load, body.elements, np.einsum("mq,qa,mqi->mai", dV, N, body_force(points)))
    boundary = np.any((X < 1e-9) | (X > 1 - 1e-9), axis=1)
    u = solid.equilibrium(displacement(X), bodies.dofs(boundary), load)
    difference = np.einsum("qa,mai->mqi", N, u[body.elements]) - displacement(points)
    return float(np.sqrt(np.sum(dV[..., None] * difference**2)))


def test_the_gradient_is_that_of_the_displacement(bodies):
    X = np.random.default_rng(0).random((20, 3))
    H = np.random.default_rng(1).standard_normal((20, 3))
    change = np.einsum("mij,mj->mi", gradient(X) - np.eye(3), H)
    assert bodies.best_difference_error(displacement, change, X, H) < 1e-8


@pytest.mark.parametrize(("order", "sizes", "expected"), [(1, (4, 6), 2), (2, (2, 4), 3)], ids=["linear", "quadratic"])
def test_order_of_convergence(bodies, order, sizes, expected):
    errors = [l2_error(bodies, n, order) for n in sizes]
    rate = np.log(errors[0] / errors[1]) / np.log(sizes[1] / sizes[0])
    assert abs(rate - expected) < 0.15
