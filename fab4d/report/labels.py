"""Where to write numbers so that they cover neither each other nor an arrow."""

import numpy as np

from fab4d.mesh.tetmesh import FloatArray

RINGS = (1.2, 1.7, 2.3, 3.0, 4.0, 5.0, 6.5, 8.0, 10.0, 12.5, 15.0)
"""Distances from the anchor that are tried, in label radii."""


def place_labels(
    anchors: FloatArray, away: FloatArray, segments: FloatArray, radius: float, size: tuple[float, float]
) -> FloatArray:
    """Centres (k, 2) of round labels near their anchors, inside the window (0, 0)..size.

    anchors : (k, 2)        away : (k, 2) direction to try first        segments : (s, 2, 2) lines not to cover
    Labels are placed in turn at the first free place; where there is none, at the one with the most room.
    """
    placed = np.zeros((0, 2))
    for anchor, direction in zip(anchors, away, strict=True):
        tries = _clamped(anchor + radius * _offsets(direction), radius, size)
        room = np.minimum(_room(tries, placed, 2 * radius), _segment_room(tries, segments, radius))
        free = np.flatnonzero(room >= 1.0)
        placed = np.vstack([placed, tries[free[0] if len(free) else int(np.argmax(room))]])
    return placed


def _offsets(direction: FloatArray) -> FloatArray:
    """Offsets (rings * 24, 2): rings from near to far, on each ring angles by growing distance from `direction`."""
    start = np.arctan2(direction[1], direction[0]) if np.any(direction) else np.pi / 4
    turns = np.concatenate([[0], *[[k, -k] for k in range(1, 12)], [12]]) * (np.pi / 12)
    angles = start + turns
    circle = np.column_stack([np.cos(angles), np.sin(angles)])
    return np.concatenate([ring * circle for ring in RINGS])


def _clamped(centers: FloatArray, radius: float, size: tuple[float, float]) -> FloatArray:
    return np.clip(centers, radius, np.maximum(np.array(size) - radius, radius))


def _room(tries: FloatArray, points: FloatArray, needed: float) -> FloatArray:
    """Distance (t,) to the nearest of the points, as a multiple of what is needed."""
    if len(points) == 0:
        return np.full(len(tries), np.inf)
    return np.linalg.norm(tries[:, None] - points, axis=2).min(axis=1) / needed


def _segment_room(tries: FloatArray, segments: FloatArray, needed: float) -> FloatArray:
    """Distance (t,) to the nearest of the segments, as a multiple of what is needed."""
    if len(segments) == 0:
        return np.full(len(tries), np.inf)
    start, along = segments[:, 0], segments[:, 1] - segments[:, 0]
    length2 = np.maximum(np.sum(along**2, axis=1), 1e-300)
    t = np.clip(np.sum((tries[:, None] - start) * along, axis=2) / length2, 0.0, 1.0)
    nearest = start + t[..., None] * along
    return np.linalg.norm(tries[:, None] - nearest, axis=2).min(axis=1) / needed
