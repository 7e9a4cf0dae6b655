"""The acceptance figures, clusters, and the steps from a density to printable labels."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fab4d.fabrication.labels import (
    Lines,
    ambiguous_fraction,
    isolated_fraction,
    printable_labels,
    rounded_labels,
    smp_clusters,
    without_small_clusters,
)
from fab4d.mesh.measures import tet_volumes


def test_ambiguous_fraction_counts_its_limits():
    assert ambiguous_fraction(np.array([0.0, 0.049, 0.05, 0.5, 0.95, 0.951, 1.0, 1.0])) == 3 / 8


def test_isolated_fraction(meshes):
    _, tets = meshes["box"]((3, 3, 3))
    smp = np.zeros(len(tets), bool)
    assert isolated_fraction(tets, smp) == 0.0
    smp[[0, 100]] = True
    assert isolated_fraction(tets, smp) == 1.0
    smp[:6] = True  # the six tets of the first cell are joined by faces
    assert isolated_fraction(tets, smp) == pytest.approx(1 / 7)


def test_density_one_half_is_tpe():
    assert rounded_labels(np.array([0.5, 0.5 + 1e-9, 0.0, 1.0])).tolist() == [False, True, False, True]
    assert rounded_labels(np.array([True, False])).tolist() == [True, False]


def test_clusters_fall_in_volume(meshes):
    X, tets = meshes["box"]((9, 2, 2))
    x = X[tets].mean(axis=1)[:, 0]
    smp = (x < 1) | ((x > 2) & (x < 5)) | (x > 7)
    cluster = smp_clusters(tets, tet_volumes(X, tets), smp)
    assert [np.sum(cluster == k) for k in range(4)] == [24 * 3, 24 * 3, 24 * 2, 24]
    assert np.all(cluster[(x > 2) & (x < 5)] == 1)
    assert np.all(cluster[x < 1] == 3)


def test_small_clusters_of_both_materials_go(meshes):
    X, tets = meshes["box"]((6, 6, 6))
    volumes = tet_volumes(X, tets)
    smp = X[tets].mean(axis=1)[:, 0] < 3
    noisy = smp.copy()
    noisy[[5, 6 * 35, len(tets) - 8, len(tets) - 300]] ^= True
    assert not np.array_equal(noisy, smp)
    assert np.array_equal(without_small_clusters(tets, volumes, noisy, 0.5), smp)
    assert np.array_equal(without_small_clusters(tets, volumes, noisy, 0.01), noisy)


def test_nothing_is_absorbed_by_nothing(meshes):
    X, tets = meshes["box"]((1, 1, 1))
    smp = np.arange(6) < 3
    absorbed = without_small_clusters(tets, tet_volumes(X, tets), smp, 100.0)
    assert absorbed.all() or not absorbed.any()


@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 10**6), share=st.floats(0.1, 0.9), feature=st.sampled_from([0.1, 0.8, 2.0]))
def test_any_density_becomes_printable(meshes, seed, share, feature):
    X, tets = meshes["irregular"](40, seed)
    rho = np.clip(np.random.default_rng(seed).normal(share, 0.3, len(tets)), 0, 1)
    result = printable_labels(X, tets, rho, Lines(feature / 2, feature / 4, feature, feature / 2))
    volumes = tet_volumes(X, tets)
    assert result.defects_left.size == result.part_defects.size == 0
    assert np.array_equal(result.cluster > 0, result.smp)
    sizes = np.bincount(result.cluster, volumes)[1:]
    assert np.all(np.diff(sizes) <= 1e-9)
    if not result.smp.all():
        assert np.all(sizes >= feature * feature * feature / 2)
    changed = volumes[(rho > 0.5) != result.smp].sum() / volumes.sum()
    assert result.changed_fraction["total"] == pytest.approx(changed)
    again = printable_labels(X, tets, rho, Lines(feature / 2, feature / 4, feature, feature / 2))
    assert np.array_equal(again.smp, result.smp)


def test_good_labels_stay(meshes):
    X, tets = meshes["box"]((8, 6, 6), size=2.0)
    smp = X[tets].mean(axis=1)[:, 0] < 8
    result = printable_labels(X, tets, smp, Lines(0.42, 0.2, 0.84, 0.4))
    assert np.array_equal(result.smp, smp)
    assert set(result.changed_fraction.values()) == {0.0}


def test_noise_of_single_tets_is_removed_from_a_fine_body(meshes):
    X, tets = meshes["box"]((14, 14, 10), size=0.2)
    half = X[tets].mean(axis=1)[:, 0] < 1.4
    noisy = half ^ (np.random.default_rng(0).random(len(tets)) < 0.03)
    result = printable_labels(X, tets, noisy, Lines(0.4, 0.2, 0.8, 0.4))
    volumes = tet_volumes(X, tets)
    assert volumes[result.smp != half].sum() < 0.02 * volumes.sum()
