"""The clamp: what it holds, what it must bear, and the corner that tells which way round the part goes."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from fab4d.mesh.measures import face_area_vectors
from fab4d.mesh.tetmesh import FloatArray, IntArray

# Unequal parts, so that two corners of a box never tie.
MARK_DIRECTION = np.array([-1.0, -0.71, -0.53])


@dataclass(frozen=True, eq=False)
class Clamp:
    """The clamped region in the frame of the printed part.

    lower, upper : (3,) its bounding box, mm        area : of the surface inside it, mm^2
    force : (3,) of the clamp on the part, N        moment : (3,) about `center`, N mm        center : (3,) mm
    """

    lower: FloatArray
    upper: FloatArray
    area: float
    n_vertices: int
    center: FloatArray
    force: FloatArray
    moment: FloatArray


def clamp_of(state: Mapping[str, np.ndarray], faces: IntArray) -> Clamp | None:
    """The clamp of a verified state with boundary faces (b, 3); None when nothing is clamped."""
    held = np.flatnonzero(state["clamp"])
    if len(held) == 0:
        return None
    X = state["nodes"]
    return Clamp(
        lower=X[held].min(axis=0),
        upper=X[held].max(axis=0),
        area=float(np.linalg.norm(face_area_vectors(X, clamped_faces(state, faces)), axis=1).sum()),
        n_vertices=int(np.sum(held <= state["elements"][:, :4].max())),
        center=state["x"][held].mean(axis=0),
        force=state["clamp_reaction"],
        moment=state["clamp_moment"],
    )


def clamped_faces(state: Mapping[str, np.ndarray], faces: IntArray) -> IntArray:
    """The boundary faces (c, 3) of which all corners are clamped."""
    return faces[state["clamp"][faces].all(axis=1)]


def corner_mark(X: FloatArray, clamp: np.ndarray, faces: IntArray) -> int:
    """The boundary vertex to mark: the lowest in x, then y, then z, of the clamp, or of the whole part without one.

    X : (n, 3), mm      clamp : (n,) bool       faces : (b, 3)
    """
    surface = np.unique(faces)
    clamped = surface[clamp[surface]]
    candidates = clamped if len(clamped) else surface
    return int(candidates[np.argmax((X[candidates] - X[candidates].mean(axis=0)) @ MARK_DIRECTION)])
