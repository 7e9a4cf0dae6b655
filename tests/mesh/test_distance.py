"""Shape errors against closed forms."""

import time

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from fab4d.mesh.distance import (
    aligned_hausdorff_distance,
    hausdorff_distance,
    largest_surface_distance,
    shape_error,
    surface_distances,
)
from fab4d.mesh.measures import vertex_areas


def grid_surface(n: int, size: float = 1.0) -> tuple[np.ndarray, np.ndarray]:
    """A flat square of 2 (n - 1)^2 triangles in z = 0."""
    u = np.linspace(0.0, size, n)
    X = np.array([(a, b, 0.0) for b in u for a in u])
    corner = (np.arange(n - 1)[:, None] * n + np.arange(n - 1)).ravel()
    low = np.column_stack([corner, corner + 1, corner + n + 1])
    high = np.column_stack([corner, corner + n + 1, corner + n])
    return X, np.vstack([low, high])


def tube(n_around: int, n_along: int, twist: float, radius: float = 1.0, length: float = 4.0):
    """A round tube whose far end is turned by `twist` rad; the same surface (up to facets) for every twist."""
    s, k = np.meshgrid(np.linspace(0, 1, n_along), np.arange(n_around), indexing="ij")
    angle = 2 * np.pi * k / n_around + twist * s
    X = np.column_stack([(radius * np.cos(angle)).ravel(), (radius * np.sin(angle)).ravel(), (length * s).ravel()])
    i, j = (a.ravel() for a in np.meshgrid(np.arange(n_along - 1), np.arange(n_around), indexing="ij"))
    a, b = i * n_around + j, i * n_around + (j + 1) % n_around
    faces = np.vstack([np.column_stack([a, b, b + n_around]), np.column_stack([a, b + n_around, a + n_around])])
    return X, faces


def brute_distance(p: np.ndarray, tri: np.ndarray) -> float:
    """Distance to a triangle by minimising over barycentric coordinates on edges and inside, by least squares."""
    E = np.column_stack([tri[1] - tri[0], tri[2] - tri[0]])
    st_ = np.linalg.lstsq(E, p - tri[0], rcond=None)[0]
    found = [np.linalg.norm(E @ st_ + tri[0] - p)] if st_.min() >= 0 and st_.sum() <= 1 else []
    for k in range(3):
        a, d = tri[k], tri[(k + 1) % 3] - tri[k]
        t = np.clip((p - a) @ d / (d @ d), 0, 1)
        found.append(np.linalg.norm(a + t * d - p))
    return min(found)


def test_tree_search_equals_brute_force():
    rng = np.random.default_rng(1)
    X = rng.normal(size=(40, 3))
    faces = np.array([rng.choice(40, 3, replace=False) for _ in range(57)])
    points = 2 * rng.normal(size=(60, 3))
    brute = [min(brute_distance(p, t) for t in X[faces]) for p in points]
    np.testing.assert_allclose(surface_distances(points, X, faces), brute, rtol=1e-12, atol=1e-12)
    assert largest_surface_distance(points, X, faces) == pytest.approx(max(brute), rel=1e-12)


def test_degenerate_triangles_are_segments_and_points():
    X = np.array([[0.0, 0, 0], [2, 0, 0], [1, 0, 0]])
    assert surface_distances(np.array([[1.5, 3, 4]]), X, np.array([[0, 1, 2]])) == pytest.approx(5.0)
    assert surface_distances(np.array([[3.0, 4, 0]]), X, np.array([[0, 0, 0]])) == pytest.approx(5.0)


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_rigid_copies_have_no_error(seed):
    X, faces = tube(12, 9, 0.3)
    rng = np.random.default_rng(seed)
    moved = X @ Rotation.random(random_state=rng).as_matrix().T + rng.normal(size=3)
    error = shape_error(moved, X, faces, vertex_areas(X, faces))
    assert max(error.rms, error.max, error.hausdorff) < 1e-12


def test_known_offset_of_a_pair_of_surfaces():
    """Unaligned: a square lifted by h is h away; slid along itself by s it is s away, at its rim."""
    X, faces = grid_surface(6, 3.0)
    assert hausdorff_distance(X, X + np.array([0, 0, 0.25]), faces) == pytest.approx(0.25)
    assert hausdorff_distance(X, X + np.array([0.4, 0, 0]), faces) == pytest.approx(0.4)


def test_bump_gives_rms_max_and_hausdorff():
    """Antisymmetric bumps that no rigid motion removes: every vertex moves by h, so rms = max = hausdorff = h."""
    X, faces = grid_surface(2, 1.0)
    h = 1e-3
    y = X + np.outer([h, -h, -h, h], [0, 0, 1.0])
    error = shape_error(y, X, faces, np.ones(4))
    assert error.rms == pytest.approx(h, rel=1e-5)
    assert error.max == pytest.approx(h, rel=1e-5)


def test_rms_uses_the_areas():
    X, faces = tube(10, 8, 0.0)
    y = X + 0.01 * np.sin(X[:, [2, 0, 1]] * 3)
    a = vertex_areas(X, faces)
    whole = shape_error(y, X, faces, a)
    doubled = shape_error(y, X, faces, 2 * a)
    uneven = shape_error(y, X, faces, a * (1 + 5 * (X[:, 2] > 2)))
    assert whole == doubled
    assert abs(uneven.rms - whole.rms) > 1e-5


def test_areas_of_all_or_of_boundary_vertices_agree():
    X, faces = tube(10, 8, 0.0)
    X = np.vstack([[[9.0, 9, 9]], X])
    faces = faces + 1
    y = X + 0.01 * np.sin(X[:, [2, 0, 1]])
    a = vertex_areas(X, faces)
    assert shape_error(y, X, faces, a) == shape_error(y, X, faces, a[1:])


def test_hausdorff_does_not_see_sliding_but_rms_does():
    """A twisted round bar: the reason why corresponding-vertex errors stand beside the Hausdorff distance."""
    n = 96
    X, faces = tube(n, 40, 0.0)
    y, _ = tube(n, 40, np.pi)
    error = shape_error(y, X, faces, vertex_areas(X, faces))
    assert error.rms > 0.5
    assert error.hausdorff < 0.03


def test_hausdorff_is_two_sided():
    """One spike: from the flat side nothing is farther than the mesh width, from the spike its height."""
    X, faces = grid_surface(11, 1.0)
    y = X.copy()
    y[60, 2] = 0.7
    assert hausdorff_distance(X, y, faces) == pytest.approx(0.7)
    assert hausdorff_distance(y, X, faces) == pytest.approx(0.7)


def test_hausdorff_equals_all_distances():
    """The early exits change nothing."""
    X, faces = tube(17, 13, 0.0)
    y, _ = tube(17, 13, 2.5, radius=1.1)
    y = y + 0.05 * np.sin(5 * y[:, [1, 2, 0]])
    both = max(surface_distances(X, y, faces).max(), surface_distances(y, X, faces).max())
    assert hausdorff_distance(X, y, faces) == pytest.approx(both, rel=1e-12)
    assert aligned_hausdorff_distance(X, X + 3.0, faces, vertex_areas(X, faces)) < 1e-12


def test_fast_enough_for_every_iterate():
    X, faces = tube(100, 70, 0.0)
    y = X + 0.02 * np.sin(3 * X[:, [1, 2, 0]])
    a = vertex_areas(X, faces)
    shape_error(y, X, faces, a)
    start = time.process_time()
    shape_error(y, X, faces, a)
    assert time.process_time() - start < 0.25
