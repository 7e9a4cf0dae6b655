"""A box whose contents move as one between two shapes: a place to hold the part."""

from dataclasses import dataclass

import numpy as np

from fab4d.mesh.measures import bounding_box_diagonal, face_area_vectors
from fab4d.mesh.rigid import best_rigid_motion
from fab4d.mesh.tetmesh import BoolArray, FloatArray, IntArray
from fab4d.mesh.topology import TET_EDGES, component_labels

_SEEDS = 48
_SIZES = (0.02, 0.03, 0.05, 0.08, 0.12, 0.18, 0.25, 0.35)  # of the diagonal: half the side of a cube
_DEPTHS = (0.02, 0.05, 0.1, 0.15, 0.2, 0.3, 0.4)  # of a side of the part: of a slice at its end
_MOST = 0.5  # of the surface: a part held at more has little left to move


@dataclass(frozen=True, eq=False)
class RigidBox:
    """Box low, high (3,), mm, in the shape X; share of the surface in it; how far it is from moving as one, mm."""

    low: FloatArray
    high: FloatArray
    share: float
    residual: float


def most_rigid_box(
    X: FloatArray, x: FloatArray, tets: IntArray, faces: IntArray, allowed: float, least: float
) -> RigidBox | None:
    """The box with the most surface whose contents hang together and move as one to within `allowed` mm, or None.

    X, x : (n, 3), mm      tets : (m, 4)      faces : (b, 3) boundary      least : share of the surface in it, at least
    Tried are cubes around vertices spread over the surface, and slices off the ends of the part.
    """
    areas = np.linalg.norm(face_area_vectors(X, faces), axis=1)
    surface = np.unique(faces)
    boxes = _candidates(X, surface)
    caught = [np.all((low <= X) & (high >= X), axis=1) for low, high in boxes]
    shares = np.array([float(areas[inside[faces].all(axis=1)].sum() / areas.sum()) for inside in caught])
    for k in np.argsort(-shares, kind="stable"):
        if shares[k] < least:
            break
        if shares[k] > _MOST or not _hangs_together(caught[k], tets):
            continue
        residual = _residual(X, x, surface[caught[k][surface]])
        if residual <= allowed:
            inside = X[caught[k]]
            return RigidBox(inside.min(axis=0), inside.max(axis=0), float(shares[k]), residual)
    return None


def _candidates(X: FloatArray, surface: IntArray) -> list[tuple[FloatArray, FloatArray]]:
    L0, low, high = bounding_box_diagonal(X), X.min(axis=0), X.max(axis=0)
    boxes = [(X[s] - size * L0, X[s] + size * L0) for s in _spread(X, surface) for size in _SIZES]
    for axis in range(3):
        for depth in _DEPTHS:
            for end in (0, 1):
                a, b = low.copy(), high.copy()
                if end:
                    a[axis] = high[axis] - depth * (high[axis] - low[axis])
                else:
                    b[axis] = low[axis] + depth * (high[axis] - low[axis])
                boxes.append((a, b))
    return boxes


def _spread(X: FloatArray, surface: IntArray) -> IntArray:
    """Vertices far from each other, and the one nearest the middle of the part."""
    middle = surface[np.argmin(np.linalg.norm(X[surface] - X[surface].mean(axis=0), axis=1))]
    chosen = [int(middle)]
    distance = np.full(len(surface), np.inf)
    while len(chosen) < min(_SEEDS, len(surface)):
        distance = np.minimum(distance, np.linalg.norm(X[surface] - X[chosen[-1]], axis=1))
        chosen.append(int(surface[np.argmax(distance)]))
    return np.array(chosen)


def _hangs_together(caught: BoolArray, tets: IntArray) -> bool:
    """Whether the caught vertices (n,) are joined by edges among themselves."""
    edges = tets[:, TET_EDGES].reshape(-1, 2)
    label = component_labels(len(caught), edges[caught[edges].all(axis=1)])
    return bool(np.all(label[caught] == label[caught][0]))


def _residual(X: FloatArray, x: FloatArray, vertices: IntArray) -> float:
    """Largest distance (mm) from moving as one; inf where the vertices are on one line, and so could turn."""
    points = X[vertices] - X[vertices].mean(axis=0)
    if len(points) < 3 or np.linalg.svd(points, compute_uv=False)[1] < 1e-3 * np.abs(points).max():
        return np.inf
    R, t = best_rigid_motion(X[vertices], x[vertices])
    return float(np.linalg.norm(X[vertices] @ R.T + t - x[vertices], axis=1).max())
