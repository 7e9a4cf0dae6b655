"""Walls and layers thinner than the feature go, thicker ones stay, and coarse meshes are left alone."""

from time import process_time

import numpy as np
import pytest

from fab4d.fabrication._thickness_kernels import nearest_on_triangle
from fab4d.fabrication.features import tet_neighbours, thin_places, without_thin_places
from fab4d.mesh.topology import face_table

FEATURE = 0.8, 0.4


@pytest.fixture(scope="module")
def fine(meshes):
    X, tets = meshes["box"]((14, 14, 10), size=0.2)
    return X, tets, X[tets].mean(axis=1)


def smp_share(labels, wanted):
    return labels[wanted].mean()


@pytest.mark.parametrize("axis", [0, 1])
@pytest.mark.parametrize(("width", "stays"), [(0.2, False), (0.4, False), (0.6, False), (0.8, True), (1.0, True)])
def test_walls(fine, axis, width, stays):
    X, tets, centres = fine
    wall = (centres[:, axis] > 1.0) & (centres[:, axis] < 1.0 + width)
    result = without_thin_places(X, tets, wall, *FEATURE)
    assert np.array_equal(result, wall) if stays else not result.any()


@pytest.mark.parametrize(("height", "stays"), [(0.2, False), (0.4, True), (0.6, True)])
def test_layers_may_be_thinner_than_walls(fine, height, stays):
    X, tets, centres = fine
    layer = (centres[:, 2] > 0.8) & (centres[:, 2] < 0.8 + height)
    result = without_thin_places(X, tets, layer, *FEATURE)
    assert np.array_equal(result, layer) if stays else not result.any()


def test_thin_gaps_of_tpe_are_filled(fine):
    X, tets, centres = fine
    smp = np.abs(centres[:, 0] - 1.3) > 0.1
    assert without_thin_places(X, tets, smp, *FEATURE).all()


def test_a_skin_at_the_surface_is_thin_too(fine):
    X, tets, centres = fine
    assert not without_thin_places(X, tets, centres[:, 0] < 0.4, *FEATURE).any()


def test_a_thin_fin_goes_and_the_block_stays(fine):
    X, tets, centres = fine
    block = centres[:, 0] < 1.2
    fin = (np.abs(centres[:, 1] - 1.3) < 0.1) & ~block
    result = without_thin_places(X, tets, block | fin, *FEATURE)
    assert result[block].all()
    assert not result[fin & (centres[:, 0] > 1.6)].any()


def test_a_part_that_is_thin_itself_keeps_its_labels(meshes):
    X, tets = meshes["box"]((20, 2, 10), size=0.2)
    smp = X[tets].mean(axis=1)[:, 0] < 2
    assert np.array_equal(without_thin_places(X, tets, smp, *FEATURE), smp)


def test_tets_larger_than_the_feature_are_left_alone(meshes):
    X, tets = meshes["box"]((6, 6, 6), size=5.0)
    smp = np.random.default_rng(0).random(len(tets)) < 0.5
    assert np.array_equal(without_thin_places(X, tets, smp, *FEATURE), smp)


def test_length_unit_does_not_matter(fine):
    X, tets, centres = fine
    smp = (np.linalg.norm(centres - centres.mean(axis=0), axis=1) < 0.9) & (np.abs(centres[:, 0] - 1.5) > 0.15)
    result = without_thin_places(X, tets, smp, *FEATURE)
    assert not np.array_equal(result, smp)
    assert np.array_equal(without_thin_places(16 * X, tets, smp, 16 * FEATURE[0], 16 * FEATURE[1]), result)


def test_nearest_point_of_a_triangle_is_the_best_of_many():
    rng = np.random.default_rng(1)
    weights = rng.dirichlet([0.5] * 3, 20000)
    for _ in range(50):
        p, *corners = rng.normal(size=(4, 3))
        nearest = np.array(nearest_on_triangle(tuple(p), *(tuple(c) for c in corners)))
        best = np.linalg.norm(weights @ np.array(corners) - p, axis=1).min()
        assert np.linalg.norm(nearest - p) <= best + 1e-12
        assert np.linalg.norm(nearest - p) > best - 0.05


def test_neighbours_lie_across_the_opposite_face(meshes):
    _, tets = meshes["irregular"](40, 0)
    neighbours = tet_neighbours(tets)
    assert np.sum(neighbours < 0) == len(face_table(tets).boundary)
    for tet, corner in np.argwhere(neighbours >= 0):
        shared = set(tets[tet]) & set(tets[neighbours[tet, corner]])
        assert shared == set(np.delete(tets[tet], corner))


def test_a_part_below_the_feature_is_left_alone_at_once(meshes):
    """As when metres were taken for mm: a search for balls would take hours."""
    X, tets = meshes["box"]((20, 20, 20), size=1e-3)
    smp = X[tets].mean(axis=1)[:, 0] < 0.01
    start = process_time()
    assert np.array_equal(without_thin_places(X, tets, smp, *FEATURE), smp)
    assert thin_places(X, tets, smp, *FEATURE).all()
    assert process_time() - start < 10
