"""Equal rows, their parity, and repeats, against brute force."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from fab4d.mesh.rows import odd_rows, repeats, row_ids


@given(arrays(np.int64, st.tuples(st.integers(0, 12), st.integers(1, 3)), elements=st.integers(-2, 2)))
def test_equal_rows_and_only_they_have_one_number(rows: np.ndarray) -> None:
    ids = row_ids(rows)
    equal = (rows[:, None] == rows[None]).all(axis=2)
    np.testing.assert_array_equal(ids[:, None] == ids[None], equal)
    np.testing.assert_array_equal(repeats(ids), np.tril(equal, -1).any(axis=1))


@given(st.permutations(range(4)))
def test_parity_is_the_sign_of_the_permutation_matrix(order: list[int]) -> None:
    determinant = np.linalg.det(np.eye(4)[order])
    assert odd_rows(np.array([order]) * 7)[0] == (determinant < 0)
