"""A programmed bar with a known shape: bent to an arc by an analytic map, held at three pads, clamped at its foot.

The median shape is bent by 60 degrees, the final one by 50; the wanted one is the final one bent by one degree more.
"""

from itertools import permutations

import numpy as np

from fab4d.mesh.measures import face_area_vectors, vertex_areas
from fab4d.mesh.quadratic import quadratic_tets, with_midpoints
from fab4d.mesh.topology import face_table

CELLS = (3, 3, 12)
STEP = 2.5
LENGTH = CELLS[2] * STEP
MEDIAN, FINAL, WANTED = (np.radians(a) for a in (60.0, 50.0, 51.0))


def box() -> tuple[np.ndarray, np.ndarray]:
    """Vertices of a box grid and six positive tets a cell."""
    n = np.array(CELLS) + 1
    index = np.arange(n.prod()).reshape(n)
    X = STEP * np.stack(np.meshgrid(*(np.arange(k) for k in n), indexing="ij"), axis=-1).reshape(-1, 3)
    tets = []
    for cell in np.ndindex(*CELLS):
        for order in permutations(range(3)):
            path = [np.array(cell)]
            for axis in order:
                path.append(path[-1] + np.eye(3, dtype=int)[axis])
            tets.append([index[tuple(p)] for p in path])
    tets = np.array(tets)
    E = X[tets[:, 1:]] - X[tets[:, :1]]
    flipped = np.linalg.det(E) < 0
    tets[flipped] = tets[flipped][:, [0, 2, 1, 3]]
    return X, tets


def bent(X: np.ndarray, angle: float) -> np.ndarray:
    """The bar along z bent about y to an arc of `angle` whose middle line keeps its length; the foot stays."""
    middle = CELLS[0] * STEP / 2
    radius, turn = LENGTH / angle, X[:, 2] / LENGTH * angle
    arm = radius - (X[:, 0] - middle)
    return np.column_stack([middle + radius - arm * np.cos(turn), X[:, 1], arm * np.sin(turn)])


def pads(X: np.ndarray, faces: np.ndarray) -> list[tuple[int, np.ndarray]]:
    """Centre vertex and faces of three pads: the tip, and both sides half way up."""
    width = CELLS[0] * STEP
    centroids = X[faces].mean(axis=1)
    wanted = [(width / 2, width / 2, LENGTH), (0.0, width / 2, LENGTH / 2), (width, width / 2, 0.6 * LENGTH)]
    found = []
    for place in np.array(wanted):
        normal = face_area_vectors(X, faces)
        near = np.linalg.norm(centroids - place, axis=1) < 1.6 * STEP
        axis = int(np.argmax(np.abs(normal[near][np.argmin(np.linalg.norm(centroids[near] - place, axis=1))])))
        flat = near & (np.abs(centroids[:, axis] - place[axis]) < 1e-9)
        corners = np.unique(faces[flat])
        found.append((int(corners[np.argmin(np.linalg.norm(X[corners] - place, axis=1))]), faces[flat]))
    return found


def smp_tets(X: np.ndarray, tets: np.ndarray) -> np.ndarray:
    """A slab inside, between a sixth and two thirds of the width."""
    centroids = X[tets].mean(axis=1)
    return (centroids[:, 0] > STEP) & (centroids[:, 0] < 2 * STEP) & (centroids[:, 1] > STEP)


def mesh_artifact() -> dict[str, np.ndarray]:
    X, tets = box()
    return {
        "X": X,
        "X_temp": bent(X, WANTED),
        "tets": tets,
        "clamp": X[:, 2] == 0.0,
        "vertex_map": np.arange(len(X)) + 5,
        "tet_map": np.arange(len(tets)),
    }


def state_artifact(quadratic: bool = False, forces: np.ndarray | None = None) -> dict[str, np.ndarray]:
    """The verified state of pipeline/README.md; the clamp's reaction balances the pads' forces and moments."""
    X, tets = box()
    faces = face_table(tets).boundary
    nodes, elements, midpoints = X, tets, np.zeros((0, 2), int)
    if quadratic:
        elements, midpoints = quadratic_tets(tets, len(X))
        nodes = with_midpoints(X, midpoints)
    x, y = bent(nodes, MEDIAN), bent(nodes, FINAL)
    chosen = pads(X, faces)
    pad_force = np.array([[30.0, 0.0, -40.0], [0.0, 0.0, -98.0665], [-5.0, 12.0, 0.0]]) if forces is None else forces
    force, held = np.zeros((len(nodes), 3)), np.full(len(nodes), -1)
    means = []
    for k, (_, pad) in enumerate(chosen):
        weights = vertex_areas(X, pad)
        weights = weights / weights.sum()
        means.append(weights @ x[: len(X)])
        force[: len(X)] += np.outer(weights, pad_force[k])
        held[np.unique(pad)] = k
    clamp = nodes[:, 2] == 0.0
    center = x[clamp].mean(axis=0)
    return {
        "nodes": nodes,
        "elements": elements,
        "x": x,
        "y": y,
        "force": force,
        "held": held,
        "clamp": clamp,
        "clamp_reaction": -pad_force.sum(axis=0),
        "clamp_moment": -np.cross(np.array(means) - center, pad_force).sum(axis=0),
        "patch_center": np.array([c for c, _ in chosen]),
        "patch_faces": np.concatenate([f for _, f in chosen]),
        "patch_offsets": np.r_[0, np.cumsum([len(f) for _, f in chosen])],
        "patch_held": np.array(means),
        "patch_force": pad_force,
    }


def labels_artifact() -> dict[str, np.ndarray]:
    X, tets = box()
    smp = smp_tets(X, tets)
    return {"smp": smp, "cluster": smp.astype(int)}
