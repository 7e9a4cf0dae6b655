"""Whether two tet lists describe the same tets of the same vertices."""

from typing import NamedTuple

import numpy as np

from fab4d.mesh.rows import odd_rows, row_ids
from fab4d.mesh.tetmesh import BoolArray, IntArray


class TetDifference(NamedTuple):
    """Rows of two tet lists that have no counterpart in the other, or one of opposite orientation."""

    only_first: IntArray
    only_second: IntArray
    opposite: IntArray
    """Rows of the second list."""


def has_repeated_vertex(tets: IntArray) -> BoolArray:
    """Whether a vertex stands twice in each of the tets (m, 4)."""
    in_order = np.sort(tets, axis=1)
    repeated: BoolArray = np.any(in_order[:, 1:] == in_order[:, :-1], axis=1)
    return repeated


def compare_tets(first: IntArray, second: IntArray) -> TetDifference:
    """Differences of tets (m, 4) and (k, 4) as sets, each tet up to even permutations of its vertices."""
    ids = row_ids(np.sort(np.concatenate([first, second]), axis=1))
    first_ids, second_ids = ids[: len(first)], ids[len(first) :]
    odd_in_first = np.zeros(len(ids), bool)
    odd_in_first[first_ids] = odd_rows(first)
    common = np.isin(second_ids, first_ids)
    opposite = common & (odd_rows(second) != odd_in_first[second_ids])
    return TetDifference(
        np.flatnonzero(~np.isin(first_ids, second_ids)), np.flatnonzero(~common), np.flatnonzero(opposite)
    )


def same_degrees(first: IntArray, second: IntArray) -> bool:
    """Whether as many vertices have as many tets in both lists: a sign that only the numbering differs."""
    a, b = (np.sort(np.unique(tets, return_counts=True)[1]) for tets in (first, second))
    return np.array_equal(a, b)
