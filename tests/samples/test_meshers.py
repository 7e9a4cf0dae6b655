"""Box divisions, isosurface stuffing and thickened plates: volumes, conformity, quality."""

from itertools import product

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from shapes.boxes import box, filled, without_edge_contacts
from shapes.implicit import capsule, difference, rounded_box, union
from shapes.plates import outline_triangles, thickened
from shapes.stuffing import stencil, stuffed

from fab4d.mesh.measures import face_area_vectors, tet_volumes
from fab4d.mesh.topology import face_table


def assert_closed(tets: np.ndarray) -> None:
    boundary = face_table(tets).boundary
    edges = np.sort(boundary[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    assert np.all(np.unique(edges, axis=0, return_counts=True)[1] % 2 == 0)


@pytest.mark.parametrize(("division", "per_cell"), [("five", 5), ("six", 6)])
def test_box_is_filled_and_its_surface_is_that_of_a_box(division: str, per_cell: int) -> None:
    X, tets = box((4.0, 6.0, 10.0), (3, 4, 5), division)
    boundary = face_table(tets).boundary
    assert len(tets) == per_cell * 60
    assert tet_volumes(X, tets).min() > 0
    assert tet_volumes(X, tets).sum() == pytest.approx(240.0, rel=1e-12)
    assert np.linalg.norm(face_area_vectors(X, boundary), axis=1).sum() == pytest.approx(248.0, rel=1e-12)


@pytest.mark.parametrize("signs", [s for s in product((-1, 0, 1), repeat=4) if {-1, 1} <= set(s)])
def test_stencils_of_both_sides_fill_the_tet(signs: tuple[int, ...]) -> None:
    corners = np.array([[0, 0, 0], [2, 0, 0], [1, -1, 1], [1, 1, 1]], np.float64)

    def volume(side: tuple[int, ...]) -> float:
        share = 0.37 if side == signs else 0.63
        pieces = [
            [corners[c] if isinstance(c, int) else (1 - share) * corners[c[0]] + share * corners[c[1]] for c in tet]
            for tet in stencil(side)
        ]
        X = np.array(pieces).reshape(-1, 3)
        return float(np.abs(tet_volumes(X, np.arange(len(X)).reshape(-1, 4))).sum())

    whole = abs(tet_volumes(corners, np.array([[0, 1, 2, 3]]))[0])
    assert volume(signs) + volume(tuple(-s for s in signs)) == pytest.approx(whole, rel=1e-12)


@settings(deadline=None, max_examples=8)
@given(st.tuples(*[st.floats(6.0, 14.0)] * 3), st.tuples(*[st.floats(-2.0, 2.0)] * 3))
def test_stuffed_ellipsoid(axes: tuple[float, ...], centre: tuple[float, ...]) -> None:
    c, a = np.array(centre), np.array(axes)

    def body(P: np.ndarray) -> np.ndarray:
        return 1.0 - np.linalg.norm((P - c) / a, axis=1)

    X, tets = stuffed(body, c - a, c + a, 3.0)
    assert_closed(tets)
    assert tet_volumes(X, tets).min() > 0
    assert 0.92 < tet_volumes(X, tets).sum() / (4 / 3 * np.pi * a.prod()) < 1.0
    assert np.abs(body(X[np.unique(face_table(tets).boundary)])).max() < 1e-9


def test_stuffed_bodies_with_tunnels_conform() -> None:
    body = difference(rounded_box((0, 0, 0), (30, 24, 12), 3), capsule((15, 12, -5), (15, 12, 20), 6))
    X, tets = stuffed(body, (0, 0, 0), (30, 24, 12), 4.0)
    assert_closed(tets)
    boundary = face_table(tets).boundary
    edges = np.unique(np.sort(boundary[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1), axis=0)
    assert len(np.unique(boundary)) - len(edges) + len(boundary) == 0  # Euler characteristic of a torus
    assert tet_volumes(X, tets).min() > 0


def test_plate_with_a_hole() -> None:
    outline = difference(capsule((-5, 0), (5, 0), 20), capsule((0, 0), (0.1, 0), 6))
    X, tets = thickened(*outline_triangles(outline, (-25, -20), (25, 20), 2.0), 3.0, 2)
    area = np.pi * 20**2 + 40 * 10 - np.pi * 6**2
    assert_closed(tets)
    assert tet_volumes(X, tets).min() > 0
    assert tet_volumes(X, tets).sum() == pytest.approx(3.0 * area, rel=0.01)


def test_filled_cells_leave_no_edge_contacts() -> None:
    touching = np.array([[[True, False], [False, True]]])
    assert without_edge_contacts(touching).sum() == 3
    body = union(capsule((0, 0, 0), (17, 23, 9), 4), capsule((0, 20, 0), (20, 0, 3), 3))
    X, tets = filled(body, (-5, -5, -5), (25, 28, 14), 2.0)
    assert_closed(tets)
    np.testing.assert_allclose(tet_volumes(X, tets).sum() / 8.0, len(tets) / 5, rtol=1e-12)
