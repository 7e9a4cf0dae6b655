"""Uniform refinement: the same body, the same surface, the same fields."""

import numpy as np
import pytest
from shapes.boxes import box

from fab4d.mesh.measures import face_area_vectors, tet_volumes
from fab4d.mesh.quadratic import quadratic_tets, with_midpoints
from fab4d.mesh.refinement import on_children, refined, refined_faces
from fab4d.mesh.topology import face_table


@pytest.fixture
def mesh() -> tuple[np.ndarray, np.ndarray]:
    X, tets = box((3.0, 2.0, 1.0), (2, 2, 1), "six")
    return X + 0.05 * np.sin(7 * X[:, [1, 2, 0]]), tets


def test_children_fill_their_parents(mesh: tuple[np.ndarray, np.ndarray]) -> None:
    X, tets = mesh
    fine = refined(tets, len(X))
    volumes = tet_volumes(with_midpoints(X, fine.edges), fine.tets).reshape(-1, 8)
    np.testing.assert_allclose(volumes, np.repeat(tet_volumes(X, tets)[:, None] / 8, 8, axis=1), rtol=1e-12)


def test_the_surface_of_the_children_is_the_refined_surface(mesh: tuple[np.ndarray, np.ndarray]) -> None:
    X, tets = mesh
    fine = refined(tets, len(X))
    faces = face_table(tets).boundary
    children = refined_faces(faces, fine.edges, len(X))
    x = with_midpoints(X, fine.edges)
    np.testing.assert_allclose(
        face_area_vectors(x, children).reshape(-1, 4, 3), np.repeat(face_area_vectors(X, faces)[:, None] / 4, 4, axis=1)
    )
    expected = {tuple(sorted(face)) for face in face_table(fine.tets).boundary.tolist()}
    assert {tuple(sorted(face)) for face in children.tolist()} == expected


def test_a_quadratic_field_is_carried_over_exactly(mesh: tuple[np.ndarray, np.ndarray]) -> None:
    X, tets = mesh

    def field(x: np.ndarray) -> np.ndarray:
        return np.column_stack([x[:, 0] * x[:, 1] - x[:, 2], x[:, 2] ** 2 + 3 * x[:, 1], 1 + x[:, 0] ** 2])

    elements, edges = quadratic_tets(tets, len(X))
    fine = refined(tets, len(X))
    vertices = with_midpoints(X, fine.edges)
    children, fine_edges = quadratic_tets(fine.tets, len(vertices))
    nodes = with_midpoints(vertices, fine_edges)
    carried = on_children(elements, field(with_midpoints(X, edges)), children, len(nodes))
    np.testing.assert_allclose(carried, field(nodes), atol=1e-12)
