"""A few distances that show with a caliper whether printing, programming and unloading went right."""

from dataclasses import dataclass
from itertools import product

import numpy as np

from fab4d.mesh.measures import bounding_box_diagonal
from fab4d.mesh.tetmesh import FloatArray, IntArray

DIRECTIONS = np.array([d for d in product((-1.0, 0.0, 1.0), repeat=3) if any(d)])
SHORTEST = 0.15
"""Shortest distance worth a caliper, as a part of the diagonal."""
APART = 0.1
"""Least distance of two candidates, as a part of the diagonal: neighbours say the same."""
NEWS = 0.02
"""How much the three distances of a pair must differ from those of the pairs before it, as a part of the diagonal."""


@dataclass(frozen=True, eq=False)
class CaliperChecks:
    """Distances between pairs of surface points.

    vertices : (k, 2)       positions : (k, 2, 3) on the permanent shape, mm
    permanent, median, final : (k,) mm
    """

    vertices: IntArray
    positions: FloatArray
    permanent: FloatArray
    median: FloatArray
    final: FloatArray

    @property
    def count(self) -> int:
        return len(self.vertices)


def caliper_checks(
    X: FloatArray, x: FloatArray, y: FloatArray, faces: IntArray, preferred: IntArray, n_pairs: int = 4
) -> CaliperChecks:
    """The pairs whose distances change most, far enough apart in all three shapes, each vertex in at most two pairs.

    X, x, y : (n, 3) permanent, median, final, mm       faces : (b, 3)
    preferred : vertices to choose from besides the corners of the part, such as the centres of the pads
    """
    L0 = bounding_box_diagonal(X)
    candidates = _apart(X, np.concatenate([preferred, extreme_vertices(X, faces)]), APART * L0)
    i, j = np.triu_indices(len(candidates), 1)
    pairs = np.column_stack([candidates[i], candidates[j]])
    d = [_distances(shape, pairs) for shape in (X, x, y)]
    usable = np.min(d, axis=0) > SHORTEST * L0
    score = np.where(usable, np.abs(d[2] - d[0]) + np.abs(d[2] - d[1]), -1.0)
    chosen = _spread(pairs, np.column_stack(d), score, n_pairs, NEWS * L0)
    return CaliperChecks(pairs[chosen], X[pairs[chosen]], d[0][chosen], d[1][chosen], d[2][chosen])


def extreme_vertices(X: FloatArray, faces: IntArray) -> IntArray:
    """The boundary vertices farthest along the 26 directions to the neighbours of a cube."""
    surface = np.unique(faces)
    return np.unique(surface[np.argmax(X[surface] @ DIRECTIONS.T, axis=0)])


def _apart(X: FloatArray, vertices: IntArray, least: float) -> IntArray:
    """The vertices, taken in turn, that are at least `least` mm from all taken before; ascending."""
    kept: list[int] = []
    for v in vertices:
        if not kept or np.linalg.norm(X[kept] - X[v], axis=1).min() >= least:
            kept.append(int(v))
    return np.sort(np.array(kept, np.int64))


def _distances(shape: FloatArray, pairs: IntArray) -> FloatArray:
    return np.linalg.norm(shape[pairs[:, 0]] - shape[pairs[:, 1]], axis=1)


def _spread(pairs: IntArray, d: FloatArray, score: FloatArray, n_pairs: int, news: float) -> IntArray:
    """The best scores, taken in turn, that use no vertex more than twice: first those whose distances d (p, 3) tell
    something new, so that a symmetric part is not measured twice in the same way, then any."""
    chosen: list[int] = []
    usable = np.argsort(-score, kind="stable")[: np.sum(score >= 0.0)]
    for least in (news, 0.0):
        for k in usable:
            is_new = not chosen or np.abs(d[chosen] - d[k]).max(axis=1).min() >= least
            if is_new and k not in chosen and len(chosen) < n_pairs and not _worn(pairs[chosen], pairs[k]):
                chosen.append(int(k))
    return np.array(chosen, np.int64)


def _worn(used: IntArray, pair: IntArray) -> bool:
    return max(int(np.sum(used == v)) for v in pair) >= 2
