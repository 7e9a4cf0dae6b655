"""Patches: what they hold, how their force is spread, and where they are put."""

import numpy as np
import pytest
from bars import CARD, CLAMPED, SIZE, bar, corner
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial.distance import cdist
from shapes.boxes import box

from fab4d.design.patches import (
    Patches,
    build_patches,
    outward_normals,
    pad_vertices,
    patches_from_faces,
    spread_centers,
)
from fab4d.design.problem import Problem, build_problem
from fab4d.mesh.measures import face_area_vectors

RADIUS_MM = 7.0


@pytest.fixture(scope="module", params=["linear", "quadratic"])
def problem(request: pytest.FixtureRequest) -> Problem:
    return bar((8, 3, 2), element=request.param)


@pytest.fixture(scope="module")
def patches(problem: Problem) -> Patches:
    """On an edge of the tip, on a side, on the top beside the clamp, and one that overlaps with the first."""
    places = ((1.0, 0.5, 1.0), (0.6, 1.0, 0.5), (0.3, 0.5, 1.0), (0.9, 0.5, 1.0))
    return build_patches(problem, np.array([corner(problem, p) for p in places]), RADIUS_MM / problem.length)


def faces_of(patches: Patches, k: int) -> np.ndarray:
    return patches.faces[patches.offsets[k] : patches.offsets[k + 1]]


def test_the_weights_of_a_patch_sum_to_one(patches: Patches) -> None:
    sums = np.bincount(patches.rows, patches.weights, minlength=patches.count)
    np.testing.assert_allclose(sums, 1.0, atol=1e-14)
    assert patches.weights.min() > 0


def test_the_mean_position_of_an_affine_deformation_is_exact(problem: Problem, patches: Patches) -> None:
    A, b = np.random.default_rng(0).standard_normal((3, 3)), np.array([0.3, -2.0, 0.1])
    X = problem.body.X
    for k, mean in enumerate(patches.mean(X @ A.T + b)):
        areas = np.linalg.norm(face_area_vectors(X, faces_of(patches, k)), axis=1)
        center = areas @ X[faces_of(patches, k)].mean(axis=1) / areas.sum()
        np.testing.assert_allclose(mean, A @ center + b, atol=1e-13)


def test_the_mean_position_of_a_quadratic_deformation_is_exact_for_quadratic_tets() -> None:
    """Weights are integrals of the shape functions: what the element can represent is averaged exactly."""
    problem = bar((8, 3, 2), element="quadratic")
    patches = build_patches(problem, np.array([corner(problem, (0.6, 0.5, 1.0))]), RADIUS_MM / problem.length)
    X = problem.body.X
    top = X[patches.faces]
    areas = np.linalg.norm(face_area_vectors(X, patches.faces), axis=1)
    # The integral of a quadratic function over a triangle is its mean at the mid-edge points.
    middles = 0.5 * (top + np.roll(top, 1, axis=1))
    expected = areas @ (middles[:, :, 0] ** 2).mean(axis=1) / areas.sum()
    assert patches.mean(X**2)[0, 0] == pytest.approx(expected, rel=1e-12)


def test_a_spread_force_has_its_resultant_and_no_moment_about_the_mean_position(
    problem: Problem, patches: Patches
) -> None:
    rng = np.random.default_rng(1)
    x = problem.X_temp + 0.01 * rng.standard_normal(problem.X_temp.shape)
    for k, force in enumerate(rng.standard_normal((patches.count, 3))):
        forces = np.zeros((patches.count, 3))
        forces[k] = force
        nodal = patches.spread(forces, problem.n_nodes)
        np.testing.assert_allclose(nodal.sum(axis=0), force, atol=1e-14)
        np.testing.assert_allclose(np.cross(x - patches.mean(x)[k], nodal).sum(axis=0), 0.0, atol=1e-14)
        assert set(np.flatnonzero(np.any(nodal != 0, axis=1))) == set(patches.nodes[patches.rows == k])


def test_spreading_does_the_work_of_the_mean_position(problem: Problem, patches: Patches) -> None:
    rng = np.random.default_rng(2)
    x, forces = rng.standard_normal(problem.body.X.shape), rng.standard_normal((patches.count, 3))
    nodal = patches.spread(forces, problem.n_nodes)
    assert float((nodal * x).sum()) == pytest.approx(float((forces * patches.mean(x)).sum()), rel=1e-12)


def test_normals_point_out_of_the_part(problem: Problem, patches: Patches) -> None:
    normals, X = outward_normals(patches, problem.body.X), problem.body.X
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1.0)
    R = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    np.testing.assert_allclose(outward_normals(patches, X @ R.T), normals @ R.T, atol=1e-12)
    means = patches.mean(X)
    assert ((means - X.mean(axis=0)) * normals).sum(axis=1).min() > 0


def test_patches_leave_the_clamp_alone(problem: Problem, patches: Patches) -> None:
    assert not problem.clamp[patches.faces].any()
    assert not problem.clamp[patches.nodes].any()
    near = faces_of(patches, 2)
    assert problem.body.X[near].reshape(-1, 3)[:, 0].min() * problem.length > CLAMPED


def test_a_patch_is_what_is_near_connected_and_on_the_same_side(problem: Problem, patches: Patches) -> None:
    X, radius = problem.body.X, RADIUS_MM / problem.length
    for k, center in enumerate(patches.centers):
        faces = faces_of(patches, k)
        at_center = (faces == center).any(axis=1)
        assert at_center.any()
        assert np.linalg.norm(X[faces].mean(axis=1) - X[center], axis=1)[~at_center].max() <= radius
        direction = face_area_vectors(X, faces[at_center]).sum(axis=0)
        assert (face_area_vectors(X, faces[~at_center]) @ direction > 0).all()
        touching = np.isin(faces[:, None], faces).any()
        assert touching
        assert n_pieces(faces) == 1


def n_pieces(faces: np.ndarray) -> int:
    """Components of faces joined by vertices."""
    vertices, index = np.unique(faces, return_inverse=True)
    rows = np.repeat(np.arange(len(faces)), 3)
    graph = coo_array((np.ones(len(rows)), (rows, len(faces) + index.ravel())), shape=(len(faces) + len(vertices),) * 2)
    return int(connected_components(graph, directed=False)[0])


def test_a_patch_on_a_thin_plate_does_not_reach_through_it() -> None:
    problem = bar((8, 3, 2))
    top = corner(problem, (0.6, 0.5, 1.0))
    patches = build_patches(problem, np.array([top]), 1.5 * SIZE[2] / problem.length)
    assert problem.body.X[patches.faces].reshape(-1, 3)[:, 2].min() * problem.length == pytest.approx(SIZE[2])


def test_patches_share_what_both_reach() -> None:
    """The nearer one gets it, whichever comes first; a part under both is of one size for both."""
    X, tets = box(SIZE, (20, 5, 4), "six")
    # No vertex is as far from two centres.
    X = X + 1e-3 * X**2 + 0.02 * X[:, [1, 2, 0]]
    problem = build_problem(X, X, tets, X[:, 0] <= CLAMPED, CARD)
    radius = RADIUS_MM / problem.length
    centers = np.array([corner(problem, (share, 0.5, 1.0)) for share in (0.55, 0.7, 0.9)])
    gaps = np.linalg.norm(np.diff(problem.body.X[centers], axis=0), axis=1)
    assert (gaps < 1.5 * radius).all()
    patches, turned = (build_patches(problem, each, radius) for each in (centers, centers[::-1]))
    for k in range(3):
        np.testing.assert_array_equal(faces_of(patches, k), faces_of(turned, 2 - k))
    X = problem.body.X
    areas = np.linalg.norm(face_area_vectors(X, patches.faces), axis=1)
    assert np.add.reduceat(areas, patches.offsets[:-1]).min() > 0.3 * np.pi * radius**2
    for k, center in enumerate(centers):
        nodes = patches.nodes[patches.rows == k]
        others = np.delete(centers, k)
        nearest = cdist(X[nodes], X[others]).min(axis=1)
        assert (np.linalg.norm(X[nodes] - X[center], axis=1) <= nearest + 1e-12).all()


def test_faces_make_the_same_patches_again(problem: Problem, patches: Patches) -> None:
    again = patches_from_faces(problem, patches.centers, patches.faces, patches.offsets)
    np.testing.assert_array_equal(
        again.operator(problem.n_nodes).toarray(), patches.operator(problem.n_nodes).toarray()
    )


def test_no_patches_are_possible(problem: Problem) -> None:
    none = build_patches(problem, np.zeros(0, np.int64), 0.1)
    assert none.count == 0
    assert none.mean(problem.body.X).shape == (0, 3)
    assert not none.spread(np.zeros((0, 3)), problem.n_nodes).any()


def test_spread_centers_are_far_from_each_other_and_from_the_clamp(problem: Problem) -> None:
    centers = spread_centers(problem, 6)
    X = problem.body.X
    assert len(set(centers)) == 6
    assert np.isin(centers, problem.faces).all()
    assert not problem.clamp[centers].any()
    taken = X[problem.clamp]
    candidates = X[pad_vertices(problem)]
    for center in centers:
        farthest = cdist(candidates, taken).min(axis=1).max()
        assert cdist(X[[center]], taken).min() == pytest.approx(farthest, rel=1e-12)
        taken = np.vstack([taken, X[center]])


def test_spread_centers_take_no_more_than_there_are(problem: Problem) -> None:
    few = pad_vertices(problem)[:3]
    assert sorted(spread_centers(problem, 8, few)) == sorted(few)


def test_pad_vertices_have_a_face_free_of_the_clamp(problem: Problem) -> None:
    pads = pad_vertices(problem)
    assert not problem.clamp[pads].any()
    patches = build_patches(problem, pads, 0.0)
    assert (np.diff(patches.offsets) > 0).all()
