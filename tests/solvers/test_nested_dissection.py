"""Elimination orders: permutations, deterministic, and with little fill."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.sparse import coo_array, csr_array, diags_array, eye_array, kron

from fab4d.solvers.nested_dissection import nested_dissection


def graph_of(pairs: np.ndarray, n: int) -> csr_array:
    """Undirected graph without loops."""
    pairs = pairs[pairs[:, 0] != pairs[:, 1]]
    graph = csr_array(coo_array((np.ones(2 * len(pairs)), np.vstack([pairs, pairs[:, ::-1]]).T), shape=(n, n)))
    graph.sum_duplicates()
    return graph


def grid(*lengths: int) -> csr_array:
    """Graph of a rectangular grid."""
    total = csr_array((1, 1))
    for length in lengths:
        line = diags_array([np.ones(length - 1)] * 2, offsets=[-1, 1], shape=(length, length))
        total = kron(total, eye_array(length)) + kron(eye_array(total.shape[0]), line)
    graph = csr_array(total)
    graph.eliminate_zeros()
    return graph


def factor_size(graph: csr_array, order: np.ndarray) -> int:
    """Entries of the Cholesky factor by symbolic elimination."""
    position = np.argsort(order)
    columns = [set(position[graph.indices[graph.indptr[v] : graph.indptr[v + 1]]].tolist()) for v in order]
    total = 0
    for k, column in enumerate(columns):
        later = {i for i in column if i > k}
        total += 1 + len(later)
        if later:
            columns[min(later)] |= later
    return total


@settings(max_examples=60, deadline=None)
@given(n=st.integers(0, 60), n_pairs=st.integers(0, 150), seed=st.integers(0, 2**32 - 1))
def test_every_graph_gets_a_permutation(n, n_pairs, seed):
    """Also graphs that are empty, in pieces, complete or with lone vertices."""
    rng = np.random.default_rng(seed)
    graph = graph_of(rng.integers(0, max(n, 1), (n_pairs if n else 0, 2)), n)
    order = nested_dissection(graph.indptr, graph.indices)
    np.testing.assert_array_equal(np.sort(order), np.arange(n))
    np.testing.assert_array_equal(order, nested_dissection(graph.indptr, graph.indices))


def test_a_complete_graph_is_ordered():
    graph = csr_array(1.0 - np.eye(40))
    np.testing.assert_array_equal(np.sort(nested_dissection(graph.indptr, graph.indices)), np.arange(40))


@pytest.mark.parametrize("shuffled", [False, True])
def test_fill_of_a_line_is_linear(shuffled):
    """A tree needs at most a few entries a vertex whatever its numbering."""
    graph = grid(2000)
    if shuffled:
        mix = np.random.default_rng(0).permutation(2000)
        graph = csr_array(graph[mix][:, mix])
    assert factor_size(graph, nested_dissection(graph.indptr, graph.indices)) < 4 * 2000


def test_fill_of_a_square_grows_as_n_log_n():
    """George's bound for a k x k grid is 31/4 k^2 log2 k for nine-point neighbours; natural order fills k^3."""
    for k in (16, 32):
        graph = grid(k, k)
        assert factor_size(graph, nested_dissection(graph.indptr, graph.indices)) < 31 / 4 * k**2 * np.log2(k)
    assert factor_size(graph, np.arange(k * k)) > 0.9 * k**3


def test_fill_of_a_cube_is_far_below_the_natural_order():
    graph = grid(10, 10, 10)
    dissected = factor_size(graph, nested_dissection(graph.indptr, graph.indices))
    assert dissected < 0.5 * factor_size(graph, np.arange(1000))


def test_a_separator_follows_both_halves():
    """Two cliques joined by one vertex: that vertex is eliminated after one whole clique at least."""
    clique = np.array([(i, j) for i in range(30) for j in range(i)])
    bridge = np.array([(29, 60), (59, 60)])
    graph = graph_of(np.vstack([clique, clique + 30, bridge]), 61)
    order = nested_dissection(graph.indptr, graph.indices)
    side = order[order != 60] // 30
    # The cliques are not interleaved below their separators: fill stays that of two cliques.
    assert factor_size(graph, order) <= 2 * 30 * 31 // 2 + 61
    assert len(side) == 60
