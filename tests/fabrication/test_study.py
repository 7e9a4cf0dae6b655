"""Random labelled meshes through the whole way to STL files: no defective body.

A mesh is a box of cubes or irregular, up to 5,000 tets, of a size between one line and many; labels are smooth, smooth
with noise, or tossed coins. `pytest -m slow tests/fabrication/test_study.py` takes a thousand of them.
"""

import numpy as np
import pytest
from scipy.spatial import Delaunay

from fab4d.fabrication.bodies import Body, bodies_from_labels, require_bodies, require_solid
from fab4d.fabrication.labels import Lines, printable_labels
from fab4d.io.stl import stl_arrays, stl_bytes
from fab4d.mesh.measures import tet_volumes
from fab4d.mesh.quality import non_manifold_edges

LINES = Lines(0.42, 0.2, 0.84, 0.4)
FLATTEST = 1e-4
"""Least volume over the cube of the longest edge that the mesh doctor lets pass, about."""


def random_mesh(meshes, rng):
    size = float(np.exp(rng.uniform(np.log(0.3), np.log(8.0))))
    if rng.random() < 0.5:
        return meshes["box"](tuple(int(n) for n in rng.integers(1, 10, 3)), size)
    X, tets = meshes["irregular"](int(rng.integers(0, 500)), int(rng.integers(1 << 30)))
    return without_flat_tets(0.4 * size * X, tets)


def without_flat_tets(X, tets):
    """The mesh without interior points that make flat tets: those are moved until none is left."""
    for _ in range(50):
        edges = np.linalg.norm(X[tets[:, :, None]] - X[tets[:, None]], axis=3).max(axis=(1, 2))
        flat = np.abs(tet_volumes(X, tets)) < FLATTEST * edges**3
        if not flat.any():
            break
        keep = np.ones(len(X), bool)
        keep[tets[flat].max(axis=1)] = False
        keep[:8] = True
        X = X[keep]
        tets = Delaunay(X).simplices.astype(np.int64)
        negative = tet_volumes(X, tets) < 0
        tets[negative] = tets[negative][:, [0, 1, 3, 2]]
    return X, tets


def random_labels(X, tets, rng):
    centres = (X[tets].mean(axis=1) - X.min(axis=0)) / np.ptp(X, axis=0)
    kind = rng.integers(3)
    if kind == 0:
        return rng.random(len(tets)) < rng.uniform(0.1, 0.9)
    waves = rng.normal(size=(4, 3)) * rng.uniform(1, 8)
    smooth = np.cos(centres @ waves.T + rng.uniform(0, 7, 4)).sum(axis=1) > rng.uniform(-1, 1)
    return smooth ^ (rng.random(len(tets)) < 0.06 * (kind == 2))


def defects(meshes, seed):
    """What is wrong with the bodies of mesh `seed`, in words; nothing where all is right."""
    rng = np.random.default_rng(seed)
    X, tets = random_mesh(meshes, rng)
    result = printable_labels(X, tets, random_labels(X, tets, rng), LINES)
    found = [f"{len(result.defects_left)} pinched vertices"] if len(result.defects_left) else []
    bodies = bodies_from_labels(X, tets, result.smp)
    require_bodies(bodies)
    for body in bodies.printed:
        read = Body(body.name, *stl_arrays(stl_bytes(body.vertices, body.faces, body.name), body.name))
        require_solid(read)
        if read.volume != pytest.approx(body.volume, rel=1e-12) or len(read.faces) != len(body.faces):
            found.append(f"{body.name} is another one in its STL file")
        if len(non_manifold_edges(read.faces)):
            found.append(f"{body.name} has edges without two faces")
    total = sum(body.volume for body in bodies.printed)
    if total != pytest.approx(bodies.whole.volume, rel=1e-12):
        found.append("the bodies do not add up")
    return [f"mesh {seed}: {words}" for words in found]


@pytest.mark.parametrize("first", range(0, 30, 10))
def test_random_meshes_have_no_defective_body(meshes, first):
    assert [words for seed in range(first, first + 10) for words in defects(meshes, seed)] == []


@pytest.mark.slow
@pytest.mark.parametrize("first", range(0, 1000, 50))
def test_a_thousand_random_meshes_have_no_defective_body(meshes, first):
    assert [words for seed in range(first, first + 50) for words in defects(meshes, seed)] == []
