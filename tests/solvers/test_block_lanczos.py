"""Eigenpairs against dense ones, and what happens where they are not found."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose
from scipy.linalg import eigh

from fab4d.solvers.block_lanczos import Modes, end_modes


def pencil(rng: np.random.Generator, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """B symmetric in the inner product of a positive definite M, with these eigenvalues: both (n, n)."""
    n = len(values)
    root = np.eye(n) + 0.3 * rng.standard_normal((n, n)) / np.sqrt(n)
    turn = np.linalg.qr(rng.standard_normal((n, n)))[0]
    M = root.T @ root
    return np.linalg.solve(root, turn @ np.diag(values) @ turn.T @ root), M


def modes_of(B: np.ndarray, M: np.ndarray, start: np.ndarray, lowest: int, highest: int, blocks: int) -> Modes:
    # `end_modes` applies the operator as inverse after mass.
    inverse = B @ np.linalg.inv(M)
    return end_modes(lambda u: inverse @ u, lambda u: M @ u, start, lowest, highest, 1e-8, blocks)


@given(st.integers(0, 2**32 - 1), st.integers(0, 4), st.integers(1, 4), st.integers(1, 8))
def test_both_ends_of_the_spectrum_are_found(seed: int, lowest: int, highest: int, b: int) -> None:
    rng = np.random.default_rng(seed)
    values = np.sort(rng.standard_normal(30)) ** 3
    B, M = pencil(rng, values)
    modes = modes_of(B, M, rng.standard_normal((30, b)), lowest, highest, 40)
    assert_allclose(modes.values, np.r_[values[:lowest], values[30 - highest :]], atol=1e-7 * np.abs(values).max())
    assert_allclose(modes.vectors.T @ M @ modes.vectors, np.eye(lowest + highest), atol=1e-7)
    assert_allclose(B @ modes.vectors, modes.vectors * modes.values, atol=1e-5 * np.abs(values).max())
    assert modes.converged.all()


def test_what_has_converged_keeps_its_promise() -> None:
    rng = np.random.default_rng(0)
    values = np.r_[-5.0, np.linspace(0.0, 1.0, 200), 3.0]
    B, M = pencil(rng, values)
    inverse = B @ np.linalg.inv(M)
    few = end_modes(lambda u: inverse @ u, lambda u: M @ u, rng.standard_normal((202, 2)), 1, 3, 1e-2, 6)
    residual = B @ few.vectors - few.vectors * few.values
    sizes = np.sqrt(np.einsum("ik,ij,jk->k", residual, M, residual))
    assert few.converged.tolist() == [True, False, False, True]
    assert (few.converged == (sizes <= 1e-2 * np.abs(few.values))).all()
    assert_allclose(few.found.values, [-5.0, 3.0], rtol=1e-3)


def test_a_space_that_the_operator_does_not_leave_ends_it() -> None:
    values = np.r_[-1.0, 2.0, np.ones(18)]
    B, M = pencil(np.random.default_rng(1), values)
    # Three eigenvalues, so that Krylov spaces of one vector have three dimensions.
    modes = modes_of(B, M, np.random.default_rng(2).standard_normal((20, 1)), 2, 2, 20)
    assert_allclose(modes.values, [-1.0, 1.0, 2.0], atol=1e-9)


@pytest.mark.parametrize("b", [1, 3])
def test_more_vectors_than_unknowns_do_no_harm(b: int) -> None:
    B, M = np.diag([1.0, 2.0]), np.eye(2)
    modes = modes_of(B, M, np.random.default_rng(0).standard_normal((2, b)), 0, 5, 9)
    assert_allclose(modes.values, eigh(B, eigvals_only=True))
