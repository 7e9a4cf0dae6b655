"""How many elements span a wall: cells of box grids, and balls."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from shapes.boxes import box

from fab4d.mesh.walls import walls


@settings(max_examples=20, deadline=None)
@given(st.integers(1, 4), st.integers(1, 4), st.integers(1, 4))
def test_cells_of_a_box_are_counted_exactly(a: int, b: int, c: int) -> None:
    """Every boundary face has a wall behind it, as thick as the box, whatever the shape of its cells."""
    size, cells = np.array([13.0, 7.0, 3.0]), np.array([a, b, c])
    X, tets = box(tuple(size), (a, b, c), "six")
    found = walls(X, tets)
    axis = np.argmin(np.ptp(X[found.faces], axis=1), axis=1)
    np.testing.assert_allclose(found.thickness, size[axis], rtol=1e-9)
    np.testing.assert_allclose(found.elements, cells[axis], rtol=1e-9)
    assert found.areas.sum() == pytest.approx(2 * (13 * 7 + 13 * 3 + 7 * 3))


def test_shares_are_of_the_area() -> None:
    X, tets = box((10.0, 10.0, 2.0), (5, 5, 1), "six")
    found = walls(X, tets)
    assert found.thin_share(2.0) == pytest.approx(200 / 280)
    assert found.fewest(0.05) == pytest.approx(1.0)
    assert found.fewest(0.9) == pytest.approx(5.0)


def test_a_corner_is_no_wall() -> None:
    """A single tet has faces, but none opposite to another."""
    found = walls(np.vstack([np.zeros(3), np.eye(3)]), np.array([[0, 1, 2, 3]]))
    assert len(found.areas) == 0
    assert found.fewest(0.05) == np.inf
    assert found.thin_share(2.0) == 0.0
