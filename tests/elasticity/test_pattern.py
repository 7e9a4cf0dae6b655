"""The fixed sparsity pattern: direct scatter against a dense assembly, constraints, fixed dofs."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fab4d.elasticity.neo_hooke import stress_tangent
from fab4d.elasticity.pattern import build_pattern, dirichlet_mask, local_pairs


def dense_stiffness(solid, u: np.ndarray) -> np.ndarray:
    """K (3 N, 3 N) summed entry by entry from the NumPy tangent of neo_hooke.py."""
    body, n = solid.body, len(solid.X)
    K = np.zeros((n, 3, n, 3))
    for m, nodes in enumerate(body.elements):
        for dN, w in zip(body.dN[m], body.weights[m], strict=True):
            F = np.eye(3) + u[nodes].T @ dN
            for b, node in enumerate(nodes):
                for k in range(3):
                    H = np.zeros((3, 3))
                    H[k] = dN[b]
                    dP = stress_tangent(F[None], H[None], solid.mu[m], solid.kappa[m])[0]
                    np.add.at(K, (nodes, slice(None), node, k), w * dN @ dP.T)
    return K.reshape(3 * n, 3 * n)


@settings(max_examples=15, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), order=st.sampled_from([1, 2]))
def test_scatter_equals_dense_assembly_for_any_mesh_and_numbering(bodies, seed, order):
    rng = np.random.default_rng(seed)
    X, tets = bodies.irregular_box(tuple(rng.integers(1, 3, 3)), rng)
    tets = tets[rng.random(len(tets)) < 0.5] if len(tets) > 6 else tets
    renumbered = rng.permutation(len(X) + 2)  # two numbers belong to no tet
    Y = np.zeros((len(X) + 2, 3))
    Y[renumbered[: len(X)]] = X
    rotated = np.array([[0, 1, 2, 3], [1, 2, 0, 3], [3, 1, 0, 2]])[rng.integers(0, 3, len(tets))]
    solid = bodies.solid(Y, np.take_along_axis(renumbered[tets], rotated, axis=1), order, mu=rng.uniform(0.5, 2))
    u = 0.02 * rng.standard_normal(solid.X.shape)
    K = dense_stiffness(solid, u)
    np.testing.assert_allclose(solid.stiffness(u).toarray(), K, atol=1e-11 * np.abs(K).max())
    structure = solid.pattern
    ascending = np.diff(structure.column_of_entry() * structure.n_dofs + structure.indices)
    assert np.all(ascending > 0)
    assert len(structure.indices) == structure.nnz == structure.indptr[-1]


def test_elements_of_zero_modulus_are_skipped(bodies):
    X, tets = bodies.box((2, 1, 1))
    whole = bodies.solid(X, tets)
    half = whole.mu * (np.arange(len(tets)) % 2)
    some = bodies.Solid(whole.body, half, whole.kappa)
    u = 0.05 * np.random.default_rng(0).standard_normal(X.shape)
    kept = bodies.Solid(bodies.solid(X, tets[1::2]).body, half[1::2], whole.kappa[1::2])
    assert some.energy(u) == pytest.approx(kept.energy(u), rel=1e-13)
    np.testing.assert_allclose(some.forces(u), kept.forces(u), atol=1e-14)
    np.testing.assert_allclose(some.stiffness(u).toarray(), kept.stiffness(u).toarray(), atol=1e-14)


def test_constraint_weights_land_in_their_rows(bodies):
    X, tets = bodies.box((2, 2, 1))
    rng = np.random.default_rng(4)
    rows = np.array([1, 0, 1, 0, 2, 1])
    nodes = np.array([7, 3, 2, 9, 7, 17])
    weights = rng.uniform(0.1, 1, len(rows))
    pattern = build_pattern(tets, len(X), rows, nodes, 3)
    data = np.zeros(pattern.nnz)
    data[pattern.coupling] = weights[:, None]
    matrix = bodies.whole(pattern, data).toarray()
    n = 3 * len(X)
    W = np.zeros((9, n))
    for row, node, weight in zip(rows, nodes, weights, strict=True):
        W[3 * row + np.arange(3), 3 * node + np.arange(3)] = weight
    np.testing.assert_array_equal(matrix[n:, :n], W)
    assert not matrix[:n, :n].any()
    assert not matrix[n:, n:].any()


def test_constraints_do_not_move_the_stiffness(bodies):
    X, tets = bodies.box((2, 1, 2))
    solid = bodies.solid(X, tets)
    pattern = build_pattern(tets, len(X), np.array([0, 0, 1]), np.array([4, 11, 4]), 2)
    data = np.zeros(pattern.nnz)
    u = np.zeros_like(X)
    b = solid.body
    bodies.kernels.tangent(b.elements, b.dN, b.weights, solid.mu, solid.kappa, u, pattern.rank, pattern.indptr, data)
    n = 3 * len(X)
    np.testing.assert_array_equal(bodies.whole(pattern, data).toarray()[:n, :n], solid.stiffness(u).toarray())


def test_dirichlet_mask_decouples_the_fixed_dofs_alone(bodies):
    X, tets = bodies.box((2, 2, 2))
    solid = bodies.solid(X, tets)
    fixed = np.array([0, 4, 17, 3 * len(X) - 1])
    before = solid.stiffness(np.zeros_like(X)).toarray()
    data = solid.tangent_data(np.zeros_like(X))
    dirichlet_mask(solid.pattern, fixed).apply(data, 2.5)
    after = bodies.whole(solid.pattern, data).toarray()
    free = np.setdiff1d(np.arange(3 * len(X)), fixed)
    np.testing.assert_array_equal(after[np.ix_(free, free)], before[np.ix_(free, free)])
    np.testing.assert_array_equal(after[np.ix_(fixed, fixed)], 2.5 * np.eye(len(fixed)))
    assert not after[np.ix_(free, fixed)].any()


@pytest.mark.parametrize("nn", [4, 10])
def test_local_pairs_are_the_lower_triangle_by_rows(nn):
    a, b = local_pairs(nn)
    assert list(zip(a, b, strict=True)) == [(i, j) for i in range(nn) for j in range(i + 1)]
