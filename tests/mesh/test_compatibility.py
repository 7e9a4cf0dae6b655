"""Tets as sets up to even permutations."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from fab4d.mesh.compatibility import compare_tets, has_repeated_vertex, same_degrees

TETS = np.array([[0, 1, 2, 3], [1, 4, 2, 3], [4, 5, 2, 3]])


@given(st.permutations(range(3)), st.lists(st.permutations(range(4)), min_size=3, max_size=3))
def test_only_odd_permutations_are_told(rows: list[int], orders: list[list[int]]) -> None:
    other = np.array([TETS[row][order] for row, order in zip(rows, orders, strict=True)])
    odd = [np.linalg.det(np.eye(4)[order]) < 0 for order in orders]
    difference = compare_tets(TETS, other)
    assert len(difference.only_first) == len(difference.only_second) == 0
    np.testing.assert_array_equal(difference.opposite, np.flatnonzero(odd))


def test_rows_without_counterpart_are_told() -> None:
    difference = compare_tets(TETS, np.array([[5, 4, 3, 2], [0, 1, 2, 5], [3, 2, 1, 0]]))
    assert difference.only_first.tolist() == [1]
    assert difference.only_second.tolist() == [1]
    assert difference.opposite.tolist() == []


def test_renumbering_keeps_the_degrees() -> None:
    assert same_degrees(TETS, np.array([5, 3, 1, 0, 2, 4])[TETS])
    assert not same_degrees(TETS, TETS[:2])
    assert not same_degrees(TETS, np.vstack([TETS[:2], [[4, 0, 2, 3]]]))


def test_a_repeated_vertex_is_seen_wherever_it_stands() -> None:
    assert has_repeated_vertex(np.array([[0, 1, 2, 3], [0, 1, 2, 0], [5, 4, 4, 1]])).tolist() == [False, True, True]
