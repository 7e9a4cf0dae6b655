"""The warps against the closed forms of circular arcs, helicoids and rigid motions."""

import numpy as np
import pytest
from shapes.warps import Turn, bump, domed, rod, twisted_plate, warped

LINE = rod((10, 2, 3), (110, 2, 3), (0, 1, 0))


def points() -> np.ndarray:
    return np.random.default_rng(1).uniform([-5, -4, -3], [130, 8, 9], (200, 3))


def test_constant_curvature_gives_a_circular_arc() -> None:
    X = points()
    X = X[(X[:, 0] > 10) & (X[:, 0] < 110)]
    moved = warped(X, LINE, (Turn((0, 0, 1), 90, np.ones_like),))
    radius = 100 / (np.pi / 2)
    angle, across = (X[:, 0] - 10) / radius, X[:, 1] - 2
    expected = np.column_stack(
        [10 + (radius - across) * np.sin(angle), 2 + radius - (radius - across) * np.cos(angle), X[:, 2]]
    )
    np.testing.assert_allclose(moved, expected, atol=1e-5)


def test_twist_turns_the_end_and_keeps_the_line() -> None:
    moved = warped(np.array([[110.0, 6.0, 3.0], [110.0, 2.0, 3.0]]), LINE, (Turn((1, 0, 0), 90, bump(0, 100)),))
    np.testing.assert_allclose(moved, [[110, 2, 7], [110, 2, 3]], atol=1e-9)


def test_before_the_line_nothing_moves_and_behind_it_the_body_is_rigid() -> None:
    X = points()
    turns = (Turn((0, 0, 1), 70, bump(0, 60)), Turn((0, 1, 0), -40, bump(30, 100)), Turn((1, 0, 0), 25, bump(0, 100)))
    moved = warped(X, LINE, turns)
    before, behind = X[:, 0] <= 10, X[:, 0] > 110
    np.testing.assert_allclose(moved[before], X[before], atol=1e-12)
    distance = [np.linalg.norm(P[behind][:, None] - P[behind], axis=2) for P in (X, moved)]
    np.testing.assert_allclose(*distance, atol=1e-9)


def test_centre_line_keeps_its_length() -> None:
    s = np.linspace(10, 110, 4001)
    line = np.column_stack([s, np.full_like(s, 2.0), np.full_like(s, 3.0)])
    moved = warped(line, LINE, (Turn((0, 0, 1), 120, bump(0, 80)), Turn((0, 1, 0), 50, bump(20, 100))))
    assert np.linalg.norm(np.diff(moved, axis=0), axis=1).sum() == pytest.approx(100.0, rel=1e-6)


def test_twisted_plate_is_a_helicoid_with_fibres_of_the_old_mean_square_length() -> None:
    line = rod((0, 0, 0), (0, 150, 0), (1, 0, 0))
    width, rate = 50.0, np.pi / 150
    a = (np.arange(1000) + 0.5) / 1000 * width - width / 2
    fibres = np.array([[[x, y, 0.0] for x in a] for y in (70.0, 70.001)])
    moved = [twisted_plate(row, line, 180, np.ones_like, width) for row in fibres]
    stretch = np.linalg.norm(moved[1] - moved[0], axis=1) / 0.001
    assert np.mean(stretch**2) == pytest.approx(1.0, abs=1e-5)
    np.testing.assert_allclose(stretch**2 - stretch[500] ** 2, rate**2 * (a**2 - a[500] ** 2), atol=1e-5)


def test_twisted_plate_keeps_lines_through_the_thickness_normal() -> None:
    line = rod((0, 0, 0), (0, 150, 0), (1, 0, 0))
    base, step = np.array([18.0, 90.0, 0.0]), 1e-4
    moved = twisted_plate(base + step * np.vstack([np.zeros(3), np.eye(3)]), line, 180, np.ones_like, 50.0)
    across, along, through = (moved[1:] - moved[0]) / step
    assert np.linalg.norm(through) == pytest.approx(1.0, abs=1e-6)
    assert abs(through @ across) < 1e-3
    assert abs(through @ along) < 1e-3


def test_dome_keeps_the_length_of_its_radii_and_its_axis() -> None:
    radius = np.linspace(0, 60, 2001)
    X = np.column_stack([0.6 * radius, 0.8 * radius, np.full_like(radius, 2.0)])
    moved = domed(X, 10.0, 60.0, 2.0, 40)
    assert np.linalg.norm(np.diff(moved, axis=0), axis=1).sum() == pytest.approx(60.0, rel=1e-6)
    np.testing.assert_allclose(moved[radius <= 10], X[radius <= 10], atol=1e-12)
    assert moved[-1, 2] < -5
