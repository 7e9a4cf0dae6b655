"""Limbs of boxes with arms, seen from where they are held."""

from itertools import permutations

import numpy as np
import pytest

from fab4d.mesh.limbs import limbs
from fab4d.mesh.measures import tet_volumes


def cells(places: list[tuple[int, int, int]]) -> tuple[np.ndarray, np.ndarray]:
    """Unit cubes of six tets at the places: X (n, 3), tets (m, 4)."""
    corners = np.array([[k & 1, k >> 1 & 1, k >> 2] for k in range(8)])
    kuhn = np.array([[0, 1 << a, (1 << a) + (1 << b), 7] for a, b, _ in permutations(range(3))])
    every = (np.array(places)[:, None] + corners).reshape(-1, 3)
    X, number = np.unique(every, axis=0, return_inverse=True)
    tets = number.reshape(-1, 8)[:, kuhn].reshape(-1, 4)
    negative = tet_volumes(X.astype(float), tets) < 0
    tets[negative] = tets[negative][:, [0, 1, 3, 2]]
    return X.astype(float), tets


# Arms of 6, 6, 4 and 1 cells around a middle one.
CROSS = [
    (0, 0, 0),
    *((k, 0, 0) for k in (1, 2, 3, 4, 5, 6, -1, -2, -3, -4, -5, -6)),
    *((0, k, 0) for k in (1, 2, 3, 4, -1)),
]


@pytest.mark.parametrize(("shortest", "expected"), [(2.5, 3), (4.5, 2)])
def test_the_arms_of_a_cross_are_limbs_if_they_are_long_enough(shortest: float, expected: int) -> None:
    X, tets = cells(CROSS)
    found = limbs(X, tets, np.zeros(len(X), bool), shortest)
    assert set(np.unique(found)) == {-1, *range(expected)}
    # The ends of the longest arms are each in a limb of its own.
    ends = [X[:, 0] == 7, X[:, 0] == -6, X[:, 1] == 5][:expected]
    numbers = [np.unique(found[end]) for end in ends]
    assert all(len(number) == 1 for number in numbers)
    assert {int(number[0]) for number in numbers} == set(range(expected))


def test_the_arm_that_is_held_is_no_limb() -> None:
    X, tets = cells(CROSS)
    held = X[:, 0] <= -5
    found = limbs(X, tets, held, 2.5)
    assert found.max() == 1
    assert np.all(found[held] == -1)
    assert found[X[:, 0] == 7][0] != found[X[:, 1] == 5][0]


def test_a_bar_held_at_its_end_is_one_limb_and_in_its_middle_two() -> None:
    X, tets = cells([(k, 0, 0) for k in range(12)])
    assert np.all(limbs(X, tets, X[:, 0] == 0, 2.0) == 0)
    assert limbs(X, tets, np.zeros(len(X), bool), 2.0).max() == 1
    assert limbs(X, tets, X[:, 0] == 6, 2.0).max() == 1


def test_a_ring_held_at_one_side_has_no_end_of_its_own() -> None:
    """Both halves of a ring meet: there is one farthest place, not two limbs."""
    ring = [(i, j, 0) for i in range(6) for j in range(6) if i in (0, 5) or j in (0, 5)]
    X, tets = cells(ring)
    assert limbs(X, tets, X[:, 0] == 0, 2.0).max() == 0
