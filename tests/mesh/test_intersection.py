"""Surfaces that pass through themselves, and surfaces that only come close."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from fab4d.mesh.intersection import self_intersections

# A cube from 0 to 1, outward.
CORNERS = np.array([[i, j, k] for i in (0, 1) for j in (0, 1) for k in (0, 1)], float)
SIDES = [[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]]
FACES = np.array([[side[0], *side[k : k + 2]] for side in SIDES for k in (1, 2)])


def two_cubes(offset: list[float], turn: Rotation | None = None) -> tuple[np.ndarray, np.ndarray]:
    other = CORNERS if turn is None else turn.apply(CORNERS - 0.5) + 0.5
    return np.vstack([CORNERS, other + offset]), np.vstack([FACES, FACES + 8])


def test_a_cube_does_not_cross_itself() -> None:
    assert len(self_intersections(CORNERS, FACES)) == 0


@pytest.mark.parametrize("offset", [[1.0, 0, 0], [1.0, 1.0, 0], [1.0, 1.0, 1.0], [1.0, 0.3, 0.2], [1.001, 0, 0]])
def test_cubes_that_touch_or_stand_apart_do_not_cross(offset: list[float]) -> None:
    assert len(self_intersections(*two_cubes(offset))) == 0


@pytest.mark.parametrize(
    "offset", [[0.5, 0.2, 0.1], [0.999, 0, 0], [0.5, 0.5, 0.5], [0.5, 0, 0], [0.999, 0.999, 0.999]]
)
def test_cubes_that_overlap_cross_also_where_edges_meet_edges(offset: list[float]) -> None:
    pairs = self_intersections(*two_cubes(offset))
    assert len(pairs) >= 3
    assert np.all((pairs[:, 0] < 12) & (pairs[:, 1] >= 12))


@pytest.mark.parametrize("seed", range(5))
def test_the_pairs_are_those_whose_triangles_have_points_in_common(seed: int) -> None:
    """Against the separating axes of all pairs (Akenine-Moeller et al., Real-Time Rendering, 22.8)."""
    rng = np.random.default_rng(seed)
    x, faces = two_cubes(rng.uniform(-0.6, 0.6, 3).tolist(), Rotation.random(rng=rng))
    expected = {(f, g) for f in range(12) for g in range(12, 24) if _meet(x[faces[f]], x[faces[g]])}
    assert {(int(f), int(g)) for f, g in self_intersections(x, faces)} == expected
    assert expected


def _meet(a: np.ndarray, b: np.ndarray) -> bool:
    edges_a, edges_b = np.roll(a, -1, 0) - a, np.roll(b, -1, 0) - b
    axes = [np.cross(*edges_a[:2]), np.cross(*edges_b[:2]), *(np.cross(e, f) for e in edges_a for f in edges_b)]
    return not any((a @ axis).max() < (b @ axis).min() or (b @ axis).max() < (a @ axis).min() for axis in axes)


def test_a_vertex_pulled_through_the_other_side_crosses() -> None:
    """The faces around the vertex share it with the faces that they do not cross."""
    x, faces = CORNERS.copy(), FACES
    x[7] = [-0.4, 0.35, 0.3]
    pairs = self_intersections(x, faces)
    assert len(pairs) >= 2
    assert np.all([7 in faces[pair].ravel() for pair in pairs])


def test_no_more_pairs_are_listed_than_asked_for() -> None:
    assert len(self_intersections(*two_cubes([0.5, 0.2, 0.1]), most=2)) == 2
