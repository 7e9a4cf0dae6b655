"""A part turned on the printer: a rotation that puts `up` on top, exact along the axes."""

from itertools import product

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fab4d.fabrication.orientation import printer_axes, standing

UNIT = st.tuples(*[st.floats(-1, 1)] * 3).filter(lambda v: np.linalg.norm(v) > 1e-3)


@given(UNIT)
def test_axes_are_a_rotation_that_puts_up_on_top(vector):
    up = np.array(vector) / np.linalg.norm(vector)
    axes = printer_axes(tuple(up.tolist()))
    assert axes @ axes.T == pytest.approx(np.eye(3), abs=1e-12)
    assert np.linalg.det(axes) == pytest.approx(1)
    assert standing(up[None], tuple(up.tolist())) == pytest.approx(np.array([[0, 0, 1]]), abs=1e-12)


@pytest.mark.parametrize(("axis", "sign"), list(product(range(3), (1.0, -1.0))))
def test_along_an_axis_coordinates_change_places_only(axis, sign):
    up = tuple((sign * np.eye(3)[axis]).tolist())
    X = np.random.default_rng(0).normal(size=(5, 3))
    turned = standing(X, up)
    assert np.array_equal(turned[:, 2], sign * X[:, axis])
    assert np.array_equal(np.sort(np.abs(turned)), np.sort(np.abs(X)))
    assert np.linalg.det(printer_axes(up)) == 1


def test_a_standing_part_is_not_turned():
    assert np.array_equal(printer_axes((0.0, 0.0, 1.0)), np.eye(3))
