"""The bodies are solids that share an interface, add up, and survive an STL file; what is wrong is refused."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fab4d.errors import BodyError
from fab4d.fabrication.bodies import (
    TIP_GAP,
    Bodies,
    Body,
    bodies_from_labels,
    genus,
    require_bodies,
    require_solid,
    shells,
    snapped,
)
from fab4d.fabrication.labels import Lines, printable_labels
from fab4d.fabrication.wellcomposed import pinched_vertices, well_composed
from fab4d.mesh.measures import tet_volumes
from fab4d.mesh.topology import face_table


def printable_bodies(X, tets, smp):
    return bodies_from_labels(X, tets, printable_labels(X, tets, smp, Lines(0.05, 0.05, 0.1, 0.1)).smp)


def sorted_triangles(body):
    """The triangles as coordinates, each turned so that its smallest corner is first."""
    corners = body.vertices[body.faces].tolist()
    return {tuple(map(tuple, t[k:] + t[:k])) for t in corners for k in [t.index(min(t))]}


@settings(max_examples=40, deadline=None)
@given(seed=st.integers(0, 10**6), share=st.floats(0.05, 0.95), n_points=st.integers(0, 80))
def test_bodies_of_any_labels_are_solid_and_add_up(meshes, seed, share, n_points):
    X, tets = meshes["irregular"](n_points, seed)
    if tet_volumes(snapped(X), tets).min() <= 0:
        with pytest.raises(BodyError, match="flat or inverted"):
            printable_bodies(X, tets, np.zeros(len(tets), bool))
        return
    bodies = printable_bodies(X, tets, np.random.default_rng(seed).random(len(tets)) < share)
    require_bodies(bodies)
    assert sum(body.volume for body in bodies.printed) == pytest.approx(bodies.whole.volume, rel=1e-12)
    assert bodies.whole.volume == pytest.approx(1000.0, rel=1e-9)


def test_interface_is_the_same_triangles_reversed(meshes):
    X, tets = meshes["box"]((6, 5, 4))
    bodies = printable_bodies(X, tets, meshes["blob"](X, tets))
    smp, tpe, whole = (sorted_triangles(body) for body in (bodies.smp, bodies.tpe, bodies.whole))
    flipped = {(a, c, b) for a, b, c in smp - whole}
    assert flipped == tpe - whole
    assert len(flipped) == bodies.interface_triangles
    assert (smp | tpe) - flipped - (smp - whole) == whole


@pytest.mark.parametrize("share", [0.0, 1.0])
def test_one_material_is_one_body(meshes, share):
    X, tets = meshes["box"]((2, 2, 2))
    bodies = bodies_from_labels(X, tets, np.full(len(tets), bool(share)))
    require_bodies(bodies)
    assert [body.name for body in bodies.printed] == [["tpe", "smp"][int(share)]]
    assert bodies.printed[0].volume == bodies.whole.volume == 8.0


def test_coordinates_are_exact_in_float32():
    X = np.random.default_rng(0).uniform(-400, 400, (1000, 3))
    assert np.abs(snapped(X) - X).max() <= 2.0**-15
    for scale in (1, 1000, 1e5):
        assert np.array_equal(snapped(scale * X).astype(np.float32), snapped(scale * X))
    assert np.array_equal(snapped(snapped(X)), snapped(X))


def test_volume_far_from_the_origin_loses_no_digits(meshes):
    X, tets = meshes["box"]((3, 3, 3), size=0.25)
    bodies = bodies_from_labels(X + np.array([900.0, -800.0, 700.0]), tets, meshes["blob"](X, tets))
    require_bodies(bodies)
    assert bodies.whole.volume == 0.75**3


def test_genus_and_shells(meshes):
    cells = [c for c in np.ndindex(5, 5, 3) if c != (1, 1, 1) and c[:2] != (3, 3)]
    X, tets = meshes["cells"](cells)
    whole = bodies_from_labels(X, tets, np.zeros(len(tets), bool)).whole
    assert (genus(whole), shells(whole)) == (1, 2)


class TestPartThatTouchesItself:
    @pytest.mark.parametrize("name", ["ring", "hollows"])
    @pytest.mark.parametrize("seed", range(4))
    def test_tips_are_drawn_back(self, meshes, name, seed):
        X, tets = meshes[name]()
        smp = np.random.default_rng(seed).random(len(tets)) < [0.5, 0.5, 0.0, 1.0][seed]
        bodies = bodies_from_labels(X, tets, well_composed(tets, smp, tet_volumes(X, tets)))
        require_bodies(bodies)
        assert bodies.tips_drawn_back == 1
        assert abs(bodies.whole.volume - tet_volumes(X, tets).sum()) < 4 * TIP_GAP

    def test_whole_labels_need_no_repair_and_the_tip_moves_one_gap(self, meshes):
        X, tets = meshes["ring"]()
        moved = bodies_from_labels(X, tets, np.ones(len(tets), bool)).whole.vertices
        distance = np.linalg.norm(moved[:, None] - X, axis=2).min(axis=1)
        assert np.sum(distance > 0) == 1
        assert distance.max() == pytest.approx(TIP_GAP, rel=0.02)

    def test_double_edge_is_refused(self, meshes):
        X, tets = meshes["cells"]([(0, 0, 0), (1, 1, 0), (0, 0, 1), (0, 1, 1), (1, 1, 1)])
        with pytest.raises(BodyError, match=r"along 1 edges, the first at \(1, 1, 0.5\) mm"):
            bodies_from_labels(X, tets, np.zeros(len(tets), bool))


class TestWhatIsRefused:
    def test_two_pieces(self, meshes):
        X, tets = meshes["cells"]([(0, 0, 0), (1, 0, 0), (4, 0, 0)])
        with pytest.raises(BodyError, match=r"2 pieces .* 1 mm\^3, is that of vertex \d+ at \(4, 0, 0\)"):
            bodies_from_labels(X, tets, np.zeros(len(tets), bool))

    def test_pieces_held_by_a_vertex(self, meshes):
        X, tets = meshes["cells"]([(0, 0, 0), (1, 1, 1)])
        with pytest.raises(BodyError, match="2 pieces that share no face"):
            bodies_from_labels(X, tets, np.zeros(len(tets), bool))

    def test_flat_tet(self, meshes):
        X, tets = meshes["box"]((2, 2, 2))
        X[13] += [1 - 1e-6, 0, 0]
        with pytest.raises(BodyError, match="flat or inverted"):
            bodies_from_labels(X, tets, np.zeros(len(tets), bool))

    def test_unrepaired_labels(self, meshes):
        X, tets = meshes["box"]((4, 4, 4))
        smp = np.random.default_rng(0).random(len(tets)) < 0.5
        assert len(pinched_vertices(tets, smp))
        with pytest.raises(BodyError):
            require_bodies(bodies_from_labels(X, tets, smp))

    @pytest.mark.parametrize(
        ("damage", "message"),
        [
            (lambda faces: faces[1:], "NotManifold; 3 edges have not two faces"),
            (lambda faces: np.concatenate([faces[:1, ::-1], faces[1:]]), "NotManifold"),
            (lambda faces: faces[:, ::-1], "volume -"),
            (lambda faces: np.concatenate([faces, faces[:1]]), "NotManifold"),
            (lambda faces: np.concatenate([faces, faces[:1], faces[:1, ::-1]]), "degenerate or paired wrongly|volume"),
        ],
    )
    def test_damaged_surfaces(self, meshes, damage, message):
        X, tets = meshes["box"]((2, 2, 2))
        body = bodies_from_labels(X, tets, np.ones(len(tets), bool)).whole
        require_solid(body)
        with pytest.raises(BodyError, match=message):
            require_solid(Body("smp", body.vertices, damage(body.faces)))

    def test_volumes_that_do_not_add_up(self, meshes):
        X, tets = meshes["box"]((2, 2, 2))
        part = bodies_from_labels(X, tets, np.ones(len(tets), bool)).whole
        larger = Body("part", 1.0001 * part.vertices, part.faces)
        with pytest.raises(BodyError, match="add up to 8"):
            require_bodies(Bodies(part, None, larger, 0, 0))

    def test_bodies_that_overlap(self, meshes):
        X, tets = meshes["box"]((2, 2, 2))
        part = bodies_from_labels(X, tets, np.ones(len(tets), bool)).whole
        double = Body("part", part.vertices * [2, 1, 1], part.faces)
        beside = Body("tpe", part.vertices + np.array([2, 0, 0]), part.faces)
        require_bodies(Bodies(part, beside, double, 0, 0))
        shifted = Body("tpe", part.vertices + np.array([1.5, 0, 0]), part.faces)
        with pytest.raises(BodyError, match=r"overlap in 2 mm\^3"):
            require_bodies(Bodies(part, shifted, double, 0, 0))


@pytest.mark.parametrize("seed", [193, 633, 665, 775])
def test_touching_bodies_are_not_taken_for_overlapping_ones(meshes, seed):
    """Labels for which the intersection or the difference of manifold3d is wrong by up to 3 mm^3."""
    rng = np.random.default_rng(seed)
    X, tets = meshes["irregular"](int(rng.integers(0, 150)), seed)
    smp = rng.random(len(tets)) < rng.random()
    require_bodies(bodies_from_labels(X, tets, printable_labels(X, tets, smp, Lines(0.42, 0.2, 0.84, 0.4)).smp))


def test_every_face_of_the_mesh_is_used_once(meshes):
    X, tets = meshes["irregular"](60, 5)
    bodies = printable_bodies(X, tets, meshes["blob"](X, tets))
    faces = face_table(tets)
    assert len(bodies.whole.faces) == len(faces.boundary)
    total = sum(len(body.faces) for body in bodies.printed)
    assert total == len(faces.boundary) + 2 * bodies.interface_triangles
