"""After the repair every body is a 2-manifold, whatever the labels were."""

from time import process_time

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pinches import pinched_by_hand

from fab4d.fabrication.wellcomposed import pinched_vertices, well_composed
from fab4d.mesh.measures import tet_volumes


def repaired(X, tets, smp):
    return well_composed(tets, smp, tet_volumes(X, tets))


def changed_fraction(X, tets, before, after):
    volumes = tet_volumes(X, tets)
    return volumes[before != after].sum() / volumes.sum()


@settings(max_examples=40, deadline=None)
@given(seed=st.integers(0, 10**6), share=st.floats(0.02, 0.98), n_points=st.integers(0, 60))
def test_repairs_irregular_meshes(meshes, seed, share, n_points):
    X, tets = meshes["irregular"](n_points, seed)
    smp = np.random.default_rng(seed).random(len(tets)) < share
    assert pinched_by_hand(tets, smp) == pinched_vertices(tets, smp).tolist()
    assert pinched_by_hand(tets, repaired(X, tets, smp)) == []


@settings(max_examples=40, deadline=None)
@given(seed=st.integers(0, 10**6), shape=st.tuples(*[st.integers(1, 5)] * 3), share=st.floats(0.02, 0.98))
def test_repairs_boxes(meshes, seed, shape, share):
    X, tets = meshes["box"](shape)
    smp = np.random.default_rng(seed).random(len(tets)) < share
    assert pinched_by_hand(tets, repaired(X, tets, smp)) == []


def test_well_composed_labels_stay(meshes):
    X, tets = meshes["box"]((8, 7, 6))
    for smp in (X[tets].mean(axis=1)[:, 0] < 4, np.zeros(len(tets), bool), np.ones(len(tets), bool)):
        assert pinched_by_hand(tets, smp) == []
        assert np.array_equal(repaired(X, tets, smp), smp)


@pytest.mark.parametrize(("noise", "most_changed"), [(0.0, 0.01), (0.02, 0.03), (0.06, 0.07)])
def test_noise_costs_little_more_than_itself(meshes, noise, most_changed):
    X, tets = meshes["box"]((12, 10, 10))
    smp = meshes["blob"](X, tets) ^ (np.random.default_rng(1).random(len(tets)) < noise)
    result = repaired(X, tets, smp)
    assert len(pinched_vertices(tets, result)) == 0
    assert changed_fraction(X, tets, smp, result) < most_changed


def test_two_cells_at_an_edge_are_joined_or_parted(meshes):
    X, tets = meshes["box"]((2, 2, 1))
    centres = X[tets].mean(axis=1)
    smp = (centres[:, 0] < 1) == (centres[:, 1] < 1)
    edge = np.flatnonzero(np.all(X[:, :2] == 1, axis=1))
    assert pinched_vertices(tets, smp).tolist() == edge.tolist()
    assert len(pinched_vertices(tets, repaired(X, tets, smp))) == 0


def test_costly_tets_are_kept(meshes):
    X, tets = meshes["box"]((8, 8, 8))
    smp = np.random.default_rng(2).random(len(tets)) < 0.5
    dear = X[tets].mean(axis=1)[:, 2] < 4
    plain = well_composed(tets, smp, np.ones(len(tets)))
    careful = well_composed(tets, smp, np.where(dear, 100.0, 1.0))
    assert np.sum(dear & (careful != smp)) < np.sum(dear & (plain != smp))


def test_equal_input_gives_equal_labels(meshes):
    X, tets = meshes["box"]((6, 6, 6))
    smp = np.random.default_rng(4).random(len(tets)) < 0.5
    assert np.array_equal(repaired(X, tets, smp), repaired(X, tets, smp))


def test_input_is_left_alone(meshes):
    X, tets = meshes["box"]((4, 4, 4))
    smp = np.random.default_rng(5).random(len(tets)) < 0.5
    before = smp.copy()
    repaired(X, tets, smp)
    assert np.array_equal(before, smp)


def test_one_label_flips_end_the_search_alone(meshes):
    """What the free search may leave is always removed by flips of one label."""
    from fab4d.fabrication import wellcomposed as w

    _, tets = meshes["box"]((6, 6, 5))
    links = w.links_of(w.split_fans(tets))
    smp = np.random.default_rng(6).random(len(tets)) < 0.5
    nowhere = np.zeros(len(links.n_nodes), bool)
    state = w._state(smp, smp, np.ones(len(tets)), nowhere, w.FREE, links, w._scratch(links))
    result = w._one_way(state, links, w._scratch(links))
    assert len(pinched_vertices(tets, result)) == 0
    assert np.all(result >= smp) or np.all(result <= smp)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["box", "irregular"])
def test_hundred_thousand_tossed_coins_take_ten_seconds(meshes, kind):
    X, tets = meshes["box"]((26, 26, 25)) if kind == "box" else meshes["irregular"](15000, 8)
    smp = np.random.default_rng(0).random(len(tets)) < 0.5
    repaired(*meshes["box"]((2, 2, 2)), np.arange(48) % 2 == 0)
    start = process_time()
    result = repaired(X, tets, smp)
    assert process_time() - start < 10
    assert len(tets) > 100000
    assert len(pinched_vertices(tets, result)) == 0
    assert 0.4 < np.mean(result) < 0.6


class TestPartThatTouchesItself:
    """Labels cannot help where the part itself is pinched."""

    def test_two_cubes_at_a_vertex_are_repaired_each_for_itself(self, meshes):
        X, tets = meshes["ring"]()
        smp = np.random.default_rng(7).random(len(tets)) < 0.5
        part = pinched_vertices(tets)
        assert len(part) == 1
        assert np.setdiff1d(pinched_vertices(tets, repaired(X, tets, smp)), part).size == 0

    def test_around_two_meeting_hollows_there_is_one_material(self, meshes):
        X, tets = meshes["hollows"]()
        part = pinched_vertices(tets)
        assert X[part].tolist() == [[2.0, 2.0, 2.0]]
        result = repaired(X, tets, np.random.default_rng(8).random(len(tets)) < 0.5)
        assert len(np.unique(result[(tets == part[0]).any(axis=1)])) == 1
        assert np.setdiff1d(pinched_vertices(tets, result), part).size == 0

    def test_a_double_edge_does_not_keep_the_search_going(self, meshes):
        X, tets = meshes["cells"]([(0, 0, 0), (1, 1, 0), (0, 0, 1), (0, 1, 1), (1, 1, 1)])
        part = pinched_vertices(tets)
        assert len(part) >= 2
        result = repaired(X, tets, np.random.default_rng(9).random(len(tets)) < 0.5)
        assert np.setdiff1d(pinched_vertices(tets, result), part).size == 0


def test_noise_on_an_irregular_mesh_is_repaired_and_both_materials_are_left(meshes):
    """Once the search flipped every tet of such a mesh up and down without an end."""
    X, tets = meshes["irregular"](1500, 8)
    smp = np.random.default_rng(0).random(len(tets)) < 0.5
    result = repaired(X, tets, smp)
    assert len(pinched_vertices(tets, result)) == 0
    assert changed_fraction(X, tets, smp, result) < 0.36
    volumes = tet_volumes(X, tets)
    assert 0.4 < volumes[result].sum() / volumes.sum() < 0.6
