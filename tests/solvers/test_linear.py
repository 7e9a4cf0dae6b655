"""Both direct solvers behind one interface: solutions, inertia, constraints, singular matrices, determinism."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.sparse import csc_array, tril

from fab4d.elasticity.pattern import build_pattern, dirichlet_mask
from fab4d.errors import MissingToolError
from fab4d.solvers import linear
from fab4d.solvers.linear import SingularMatrixError, analyse, backward_error


@pytest.fixture(params=linear.BACKENDS)
def backend(request) -> str:
    if request.param == "rslab":
        pytest.importorskip("rslab")
    return request.param


def lower(A: np.ndarray):
    """CSC structure (with the whole diagonal) and values of the lower triangle."""
    stored = csc_array(tril(csc_array((A != 0) | np.eye(len(A), dtype=bool))))
    stored.sort_indices()
    columns = np.repeat(np.arange(len(A)), np.diff(stored.indptr))
    return stored.indptr.astype(np.int64), stored.indices.astype(np.int64), A[stored.indices, columns]


def factor(A: np.ndarray, backend: str):
    indptr, indices, data = lower(A)
    return analyse(indptr, indices, backend).factor(data)


def random_symmetric(seed: int, n: int) -> np.ndarray:
    """Indefinite, well away from singular: |eigenvalues| between 1 and 4."""
    rng = np.random.default_rng(seed)
    Q = np.linalg.qr(rng.standard_normal((n, n)))[0]
    return (Q * (rng.choice([-1, 1], n) * rng.uniform(1, 4, n))) @ Q.T


@pytest.fixture
def held(bodies):
    """A body under its KKT matrix: one face fixed, six patches held; a compressed state, so that K is indefinite."""
    X, tets = bodies.box((4, 4, 3), (4.0, 4.0, 3.0))
    solid = bodies.solid(X, tets)
    rng = np.random.default_rng(2)
    top = np.flatnonzero(X[:, 2] == 3.0)
    nodes = top[np.r_[0, 1, 5, 3, 4, 9, 12, 13, 20, 21, 24, 23]]
    rows = np.repeat(np.arange(4), 3)
    pattern = build_pattern(tets, len(X), rows, nodes, 4)

    def matrix(u: np.ndarray, compliance: float = 0.0):
        body, data = solid.body, np.zeros(pattern.nnz)
        bodies.kernels.tangent(
            body.elements, body.dN, body.weights, solid.mu, solid.kappa, u, pattern.rank, pattern.indptr, data
        )
        data[pattern.coupling] = -rng.uniform(0.2, 0.5, (len(rows), 1))
        data[pattern.indptr[3 * len(X) : -1]] = -compliance
        dirichlet_mask(pattern, bodies.dofs(X[:, 2] == 0.0)).apply(data, 1.0)
        return data, bodies.whole(pattern, data).toarray()

    return pattern, X, matrix


@settings(max_examples=40, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), n=st.integers(1, 20))
def test_rslab_solves_indefinite_dense_matrices_and_counts_negatives(seed, n):
    pytest.importorskip("rslab")
    A = random_symmetric(seed, n)
    b = np.random.default_rng(seed).standard_normal(n)
    f = factor(A, "rslab")
    np.testing.assert_allclose(f.solve(b), np.linalg.solve(A, b), atol=1e-11)
    assert f.n_negative == np.count_nonzero(np.linalg.eigvalsh(A) < 0)


def test_indefinite_stiffness_inertia_and_solution(bodies, backend):
    """A crushed column: the tangent has negative eigenvalues, and the same number in both factorisations."""
    X, tets = bodies.box((2, 2, 6), (1.0, 1.0, 3.0))
    solid = bodies.solid(X, tets)
    u = 0.01 * np.random.default_rng(0).standard_normal(X.shape) - 0.6 * X * [0, 0, 1]
    data = solid.tangent_data(u)
    dirichlet_mask(solid.pattern, bodies.dofs(X[:, 2] == 0.0)).apply(data, 1.0)
    A = bodies.whole(solid.pattern, data).toarray()
    n_negative = np.count_nonzero(np.linalg.eigvalsh(A) < 0)
    assert n_negative > 3
    f = analyse(solid.pattern.indptr, solid.pattern.indices, backend).factor(data)
    b = np.random.default_rng(1).standard_normal(len(A))
    x = f.solve(b)
    assert f.n_negative == n_negative
    assert backward_error(solid.pattern.indptr, solid.pattern.indices, data, x, b) < 1e-12
    np.testing.assert_allclose(A @ x, b, atol=1e-10)


@pytest.mark.parametrize("compliance", [0.0, 1e-4], ids=["rigid", "compliant"])
@pytest.mark.parametrize("squeeze", [0.0, 0.55], ids=["stable", "unstable"])
def test_held_patches(held, backend, compliance, squeeze):
    """Constraint rows with zero diagonal, or a small compliance: twelve negatives, plus those of the body."""
    pattern, X, matrix = held
    u = -squeeze * X * [0, 0, 1] + 0.005 * np.random.default_rng(0).standard_normal(X.shape)
    data, A = matrix(u, compliance)
    f = analyse(pattern.indptr, pattern.indices, backend).factor(data)
    B = np.random.default_rng(1).standard_normal((len(A), 7))
    exact = np.linalg.solve(A, B)
    n_negative = np.count_nonzero(np.linalg.eigvalsh(A) < 0)
    assert n_negative == 12 if squeeze == 0.0 else n_negative > 12
    assert f.n_negative == n_negative
    np.testing.assert_allclose(f.solve(B[:, 0]), exact[:, 0], atol=1e-8 * np.abs(exact).max())
    np.testing.assert_allclose(f.solve_many(B), exact, atol=1e-8 * np.abs(exact).max())
    assert backward_error(pattern.indptr, pattern.indices, data, f.solve_many(B), B) < 1e-11


def test_many_right_hand_sides_equal_single_ones(held, backend):
    pattern, X, matrix = held
    data, A = matrix(np.zeros_like(X), 1e-4)
    f = analyse(pattern.indptr, pattern.indices, backend).factor(data)
    B = np.random.default_rng(1).standard_normal((len(A), 30))
    columns = np.column_stack([f.solve(b) for b in B.T])
    np.testing.assert_allclose(f.solve_many(B), columns, atol=1e-9 * np.abs(columns).max())
    np.testing.assert_array_equal(f.solve_many(np.asfortranarray(B)), f.solve_many(B))


def test_one_analysis_serves_many_values(held, backend):
    pattern, X, matrix = held
    analysis = analyse(pattern.indptr, pattern.indices, backend)
    first, A = matrix(np.zeros_like(X), 1e-4)
    second, B = matrix(0.01 * np.random.default_rng(3).standard_normal(X.shape), 1e-4)
    f, g = analysis.factor(first), analysis.factor(second)
    b = np.ones(len(A))
    np.testing.assert_allclose(A @ f.solve(b), b, atol=1e-8)
    np.testing.assert_allclose(B @ g.solve(b), b, atol=1e-8)


def test_the_right_hand_side_is_left_alone(held, backend):
    pattern, X, matrix = held
    data, A = matrix(np.zeros_like(X))
    b, kept = np.ones(len(A)), data.copy()
    f = analyse(pattern.indptr, pattern.indices, backend).factor(data)
    f.solve(b)
    np.testing.assert_array_equal(b, 1.0)
    np.testing.assert_array_equal(data, kept)


def test_a_body_without_support_is_singular(bodies, backend):
    X, tets = bodies.box((5, 4, 2))
    solid = bodies.solid(X, tets)
    analysis = analyse(solid.pattern.indptr, solid.pattern.indices, backend)
    with pytest.raises(SingularMatrixError):
        analysis.factor(solid.tangent_data(np.zeros_like(X)))
    hinge = solid.tangent_data(np.zeros_like(X))
    dirichlet_mask(solid.pattern, bodies.dofs(np.array([0]))).apply(hinge, 1.0)
    with pytest.raises(SingularMatrixError):
        analysis.factor(hinge)


def test_a_slender_strip_of_high_contrast_is_not_singular(bodies, backend):
    """Condition about 1e11, and still regular: tip-loaded strip of 300 elements, moduli 158 : 1."""
    X, tets = bodies.box((300, 1, 1), (300.0, 1.0, 1.0))
    plain = bodies.solid(X, tets)
    contrast = np.where(np.arange(len(tets)) % 2, 158.0, 1.0)
    solid = bodies.Solid(plain.body, contrast, 6.07 * contrast)
    data = solid.tangent_data(np.zeros_like(X))
    dirichlet_mask(solid.pattern, bodies.dofs(X[:, 0] == 0.0)).apply(data, 1.0)
    f = analyse(solid.pattern.indptr, solid.pattern.indices, backend).factor(data)
    assert f.n_negative == 0
    b = np.zeros(3 * len(X))
    b[-1] = 1e-6
    assert backward_error(solid.pattern.indptr, solid.pattern.indices, data, f.solve(b), b) < 1e-11


def test_a_repeated_constraint_is_singular(held, backend):
    pattern, X, matrix = held
    data, _ = matrix(np.zeros_like(X))
    twice = build_pattern(np.arange(8).reshape(2, 4), 8, np.array([0, 0, 1, 1]), np.array([1, 6, 1, 6]), 2)
    values = np.zeros(twice.nnz)
    values[twice.indptr[:24]] = 2.0
    values[twice.coupling] = 0.5
    with pytest.raises(SingularMatrixError):
        analyse(twice.indptr, twice.indices, backend).factor(values)
    assert len(data) == pattern.nnz


@pytest.mark.parametrize("value", [0.0, np.nan, np.inf])
def test_empty_and_infinite_rows_are_refused_by_number(backend, value):
    A = np.diag([2.0, 3.0, 4.0, 5.0, 6.0, 7.0])
    A[4, 4] = value
    with pytest.raises(SingularMatrixError, match="row 4"):
        factor(A, backend)


def test_badly_scaled_rows_are_not_singular(backend):
    A = np.diag(10.0 ** np.arange(-30, 30, 10))
    np.testing.assert_allclose(factor(A, backend).solve(np.ones(6)), 1 / np.diag(A), rtol=1e-12)


@pytest.mark.parametrize("n", [1, 2, 4, 5, 6])
def test_sizes_that_are_not_triples(backend, n):
    A = 4 * np.eye(n) + np.ones((n, n))
    b = np.arange(1.0, n + 1)
    np.testing.assert_allclose(factor(A, backend).solve(b), np.linalg.solve(A, b), rtol=1e-12)


def test_rslab_gives_the_same_bits_on_one_and_two_threads(bodies):
    pytest.importorskip("rslab")
    X, tets = bodies.box((9, 9, 9))
    solid = bodies.solid(X, tets)
    data = solid.tangent_data(np.zeros_like(X))
    dirichlet_mask(solid.pattern, bodies.dofs(X[:, 2] == 0.0)).apply(data, 1.0)
    b = np.random.default_rng(1).standard_normal(3 * len(X))
    one, two = (
        linear._RslabAnalysis(solid.pattern.indptr, solid.pattern.indices, threads).factor(data) for threads in (1, 2)
    )
    np.testing.assert_array_equal(one.solve(b), two.solve(b))
    B = np.column_stack([b, -b, 2 * b])
    np.testing.assert_array_equal(one.solve_many(B), two.solve_many(B))


def test_backward_error_is_that_of_the_changed_matrix():
    """A solution of the system with entries changed by 1e-6 has a backward error of at most 1e-6, and not far below."""
    A = random_symmetric(5, 30)
    rng = np.random.default_rng(0)
    change = np.triu(rng.choice([-1e-6, 1e-6], A.shape))
    b = rng.standard_normal(30)
    x = np.linalg.solve(A * (1 + change + change.T), b)
    assert 1e-8 < backward_error(*lower(A), x, b) <= 2e-6
    assert backward_error(*lower(A), np.linalg.solve(A, b), b) < 1e-14
    assert backward_error(*lower(A), np.zeros(30), np.zeros(30)) == 0.0


def test_the_backend_can_be_named_by_argument_and_by_environment(monkeypatch):
    indptr, indices, _ = lower(np.eye(3))
    monkeypatch.setenv(linear.BACKEND_VARIABLE, "splu")
    assert isinstance(analyse(indptr, indices), linear._SpluAnalysis)
    monkeypatch.setenv(linear.BACKEND_VARIABLE, "cholesky")
    with pytest.raises(ValueError, match="cholesky"):
        analyse(indptr, indices)
    assert isinstance(analyse(indptr, indices, "splu"), linear._SpluAnalysis)


def test_without_rslab_splu_is_used_and_asking_for_rslab_says_so(monkeypatch):
    indptr, indices, _ = lower(np.eye(3))
    monkeypatch.delenv(linear.BACKEND_VARIABLE, raising=False)
    monkeypatch.setattr(linear, "find_spec", lambda _: None)
    assert isinstance(analyse(indptr, indices), linear._SpluAnalysis)
    with pytest.raises(MissingToolError, match="rslab"):
        analyse(indptr, indices, "rslab")


@pytest.mark.parametrize(
    ("indptr", "indices"),
    [([0, 1, 1], [0]), ([0, 2, 3], [1, 0, 1]), ([0, 1, 2], [0, 0])],
    ids=["no diagonal", "descending", "upper"],
)
def test_other_structures_are_refused(indptr, indices):
    with pytest.raises(ValueError, match="lower triangle"):
        analyse(np.array(indptr), np.array(indices))
