"""Angles, sides, manifoldness: closed forms and small meshes whose answer is plain."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from fab4d.mesh.quality import (
    coincident_vertices,
    crowded_tets,
    largest_stretches,
    min_dihedral_angles,
    non_manifold_edges,
    non_manifold_vertices,
    overlapping_tets,
    side_curvature,
    smallest_surface_stretches,
    vertex_components,
)
from fab4d.mesh.topology import face_table

TET = np.array([[0, 1, 2, 3]])
UNIT = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
REGULAR = np.array([[1.0, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]])


def test_dihedral_angles_of_known_tets() -> None:
    assert min_dihedral_angles(REGULAR, TET)[0] == pytest.approx(np.degrees(np.arccos(1 / 3)))
    assert min_dihedral_angles(UNIT, TET)[0] == pytest.approx(np.degrees(np.arctan(np.sqrt(2))))
    flat = UNIT * [1, 1, 1e-3]
    assert min_dihedral_angles(flat, TET)[0] == pytest.approx(np.degrees(np.arctan(np.sqrt(2) * 1e-3)), rel=1e-6)
    assert min_dihedral_angles(UNIT * [1, 0, 0], TET)[0] == 0


def test_neighbours_on_one_side_of_their_face_overlap() -> None:
    beside = np.array([[0, 1, 2, 3], [1, 4, 2, 3]])
    assert not overlapping_tets(beside).any()
    assert overlapping_tets(np.array([[0, 1, 2, 3], [1, 2, 4, 3]])).all()
    assert len(crowded_tets(beside)) == 0
    np.testing.assert_array_equal(
        crowded_tets(np.array([[0, 1, 2, 3], [1, 4, 2, 3], [5, 1, 2, 3], [6, 7, 8, 9]])), [0, 1, 2]
    )


@pytest.mark.parametrize(
    ("second", "edges", "vertices"),
    [
        ([4, 5, 6, 7], [], []),
        ([3, 5, 6, 7], [], [3]),
        ([2, 3, 6, 7], [[2, 3]], []),
        ([1, 2, 3, 7], [], []),
    ],
)
def test_two_tets_that_share_nothing_a_vertex_an_edge_or_a_face(
    second: list[int], edges: list[list[int]], vertices: list[int]
) -> None:
    faces = face_table(np.array([[0, 1, 2, 3], second])).boundary
    assert non_manifold_edges(faces).tolist() == edges
    assert non_manifold_vertices(faces).tolist() == vertices


def test_components_and_coincident_vertices() -> None:
    tets = np.array([[0, 1, 2, 3], [3, 4, 5, 6], [7, 8, 9, 10]])
    component = vertex_components(11, tets)
    assert len(set(component[:7])) == 1
    assert len(set(component[7:])) == 1
    assert component[0] != component[7]
    assert coincident_vertices(np.array([[0.0, 0, 0], [1, 0, 0], [1, 0, 1e-12]]), 1e-9).tolist() == [[1, 2]]


def test_side_curvature_is_the_sag_of_a_mid_node() -> None:
    ends = np.array([[0, 1], [1, 2], [0, 2], [0, 3], [1, 3], [2, 3]])
    points = np.vstack([UNIT, UNIT[ends].mean(axis=1)])
    tets = np.arange(10)[None]
    assert side_curvature(points, tets)[0] == 0
    points[8] += [0, 0.25, 0]
    assert side_curvature(points, tets)[0] == pytest.approx(0.25)


def test_largest_stretch_ignores_rotation() -> None:
    Q = np.linalg.qr(np.random.default_rng(0).normal(size=(3, 3)))[0]
    assert largest_stretches((Q @ np.diag([0.5, 1.7, 1.2]))[None])[0] == pytest.approx(1.7)


@pytest.mark.parametrize("seed", range(20))
def test_a_plane_stretch_of_a_surface_is_that_of_its_deformation(seed: int) -> None:
    """Triangles of one plane, stretched in it by two known factors, then moved rigidly."""
    random = np.random.default_rng(seed)
    Q, R = Rotation.random(2, random).as_matrix()
    flat = np.column_stack([random.normal(size=(9, 2)), np.zeros(9)])
    factors = random.uniform(0.05, 3.0, 2)
    x = (flat * [*factors, 1.0]) @ R.T + random.normal(size=3)
    faces = np.arange(9).reshape(3, 3)
    found = smallest_surface_stretches(flat @ Q, x, faces)
    np.testing.assert_allclose(found, factors.min(), rtol=1e-7)
