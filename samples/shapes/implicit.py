"""Implicit bodies: functions of points (n, d) that are positive inside; values are distances, mm, near the surface."""

import numpy as np
from numpy.typing import ArrayLike

from fab4d.mesh.tetmesh import FloatArray
from shapes.boxes import Body


def capsule(start: ArrayLike, end: ArrayLike, radius: float, end_radius: float | None = None) -> Body:
    """A round bar from `start` to `end` whose radius changes evenly to `end_radius`."""
    a, line = np.asarray(start, np.float64), np.subtract(end, start).astype(np.float64)
    growth = 0.0 if end_radius is None else end_radius - radius

    def body(P: FloatArray) -> FloatArray:
        t = np.clip((P - a) @ line / (line @ line), 0.0, 1.0)
        return radius + growth * t - np.linalg.norm(P - a - t[:, None] * line, axis=1)

    return body


def rounded_box(low: ArrayLike, high: ArrayLike, radius: float) -> Body:
    """The box low..high with its edges rounded to `radius`."""
    middle, half = 0.5 * np.add(low, high), 0.5 * np.subtract(high, low) - radius

    def body(P: FloatArray) -> FloatArray:
        over = np.abs(P - middle) - half
        return radius - np.linalg.norm(np.maximum(over, 0.0), axis=1) - np.minimum(over.max(axis=1), 0.0)

    return body


def union(*bodies: Body) -> Body:
    """What lies in any of `bodies`."""
    return lambda P: np.max([body(P) for body in bodies], axis=0)


def filleted(fillet: float, *bodies: Body) -> Body:
    """What lies in any of `bodies`, with the creases between them filled over a width of about `fillet`, mm."""

    def body(P: FloatArray) -> FloatArray:
        value = bodies[0](P)
        for other in bodies[1:]:
            second = other(P)
            overlap = np.maximum(fillet - np.abs(value - second), 0.0)
            value = np.maximum(value, second) + overlap**2 / (4.0 * fillet)
        return value

    return body


def difference(body: Body, *removed: Body) -> Body:
    """`body` without what lies in any of `removed`."""
    return lambda P: np.min([body(P), *(-hole(P) for hole in removed)], axis=0)


def slab(outline: Body, thickness: float) -> Body:
    """The plate from z = 0 to `thickness` over a plane outline."""
    return lambda P: np.min([outline(P[:, :2]), P[:, 2], thickness - P[:, 2]], axis=0)
