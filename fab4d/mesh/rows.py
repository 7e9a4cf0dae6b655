"""Equal rows of integer arrays: the same tet, the same face, the same edge."""

import numpy as np

from fab4d.mesh.tetmesh import BoolArray, IntArray


def row_ids(rows: IntArray) -> IntArray:
    """Number (k,) of each of the rows (k, c): equal rows, and only they, have the same number."""
    if len(rows) == 0:
        return np.zeros(0, np.int64)
    order = np.lexsort(rows.T[::-1])
    in_order = rows[order]
    is_new = np.r_[False, np.any(in_order[1:] != in_order[:-1], axis=1)]
    ids = np.zeros(len(rows), np.int64)
    ids[order] = np.cumsum(is_new)
    return ids


def odd_rows(rows: IntArray) -> BoolArray:
    """Whether sorting each row (k, c) of different numbers takes an odd number of exchanges."""
    first, second = np.triu_indices(rows.shape[1], 1)
    inversions: BoolArray = np.sum(rows[:, first] > rows[:, second], axis=1) % 2 == 1
    return inversions


def repeats(ids: IntArray) -> BoolArray:
    """Whether the same number stands earlier in `ids` (k,)."""
    repeated = np.ones(len(ids), bool)
    repeated[np.unique(ids, return_index=True)[1]] = False
    return repeated
