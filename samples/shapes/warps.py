"""Smooth maps of a body to its temporary shape: plane cross-sections move with a centre line and stay plane."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from fab4d.mesh.tetmesh import FloatArray

STEPS = 2000
Profile = Callable[[FloatArray], FloatArray]


def ramp(s: FloatArray, start: float, end: float) -> FloatArray:
    """0 before `start`, 1 after `end`, once differentiable between."""
    t = np.clip((s - start) / (end - start), 0.0, 1.0)
    return t * t * (3.0 - 2.0 * t)


def bump(start: float, end: float, share: float = 0.25) -> Profile:
    """1 between `start` and `end`, smoothly falling to 0 at both within `share` of the length."""
    width = share * (end - start)
    return lambda s: ramp(s, start, start + width) * (1.0 - ramp(s, end - width, end))


@dataclass(frozen=True)
class Turn:
    """A turn of the cross-sections by `degrees` about a fixed body axis, spread along the centre line as `profile`."""

    axis: tuple[float, float, float]
    """In the frame of the rod: (1, 0, 0) twists, (0, 1, 0) and (0, 0, 1) bend."""
    degrees: float
    profile: Profile


@dataclass(frozen=True, eq=False)
class Rod:
    """A straight centre line with a frame: `frame` (3, 3) has the line's direction and the two section axes as rows."""

    origin: FloatArray
    frame: FloatArray
    length: float


def rod(origin: ArrayLike, end: ArrayLike, side: ArrayLike) -> Rod:
    """The rod from `origin` to `end`, mm, whose first section axis is nearest to `side`."""
    start, line = np.asarray(origin, np.float64), np.subtract(end, origin).astype(np.float64)
    length = float(np.linalg.norm(line))
    first = line / length
    second = np.asarray(side, np.float64) - first * (first @ np.asarray(side, np.float64))
    second /= np.linalg.norm(second)
    return Rod(start, np.array([first, second, np.cross(first, second)]), length)


def section_coordinates(X: FloatArray, line: Rod) -> FloatArray:
    """Position along the rod and on its two section axes, (n, 3), mm."""
    return (X - line.origin) @ line.frame.T


def _middles(step: float) -> FloatArray:
    """Positions along a rod of the middles of its steps."""
    return np.asarray(step * (np.arange(STEPS) + 0.5), np.float64)


def curvature(s: FloatArray, length: float, turns: tuple[Turn, ...]) -> FloatArray:
    """Rotation of the sections per length about the three body axes, (len(s), 3), rad/mm, for equally spaced s."""
    total = np.zeros((len(s), 3))
    for turn in turns:
        weight = turn.profile(s)
        axis = np.asarray(turn.axis) / np.linalg.norm(turn.axis)
        total += np.outer(weight / (weight.sum() * length / len(s)), axis) * np.radians(turn.degrees)
    return total


def warped(X: FloatArray, line: Rod, turns: tuple[Turn, ...], stretch: float = 1.0) -> FloatArray:
    """Positions (n, 3), mm, after the sections of `line` have turned; sections before the origin stay where they are.

    stretch : length of the deformed centre line over its length.
    The curvature is constant in each of STEPS steps; within a step the line is followed by the midpoint rule.
    """
    step = line.length / STEPS
    kappa = curvature(_middles(step), line.length, turns)
    frames, points = _march(kappa, step, stretch)
    local = section_coordinates(X, line)
    s = np.clip(local[:, 0], 0.0, line.length)
    index = np.minimum((s / step).astype(np.int64), STEPS - 1)
    rest = (s - index * step)[:, None]
    middle = frames[index] * Rotation.from_rotvec(0.5 * rest * kappa[index])
    frame = frames[index] * Rotation.from_rotvec(rest * kappa[index])
    centre = points[index] + middle.apply([1.0, 0.0, 0.0]) * rest * stretch
    off_line = np.column_stack([local[:, 0] - s, local[:, 1:]])
    return line.origin + (centre + frame.apply(off_line)) @ line.frame


def domed(X: FloatArray, start: float, end: float, mid: float, degrees: float) -> FloatArray:
    """Positions (n, 3), mm, after every radius of a plate around the z axis has bent down by `degrees`.

    The bend lies between the radii `start` and `end`; `mid` is the height of the neutral surface.
    """
    radius = np.hypot(X[:, 0], X[:, 1])
    meridian = np.column_stack([radius, np.zeros_like(radius), X[:, 2]])
    line = rod((start, 0, mid), (end, 0, mid), (0, 0, 1))
    bent = warped(meridian, line, (Turn((0, 0, 1), -degrees, lambda s: ramp(s, 0, 0.3 * line.length)),))
    scale = np.where(radius > start, bent[:, 0] / np.maximum(radius, start), 1.0)
    return np.column_stack([scale * X[:, 0], scale * X[:, 1], bent[:, 2]])


def moved_together(X: FloatArray, *positions: FloatArray) -> FloatArray:
    """X plus the displacements of several warps, each of which leaves the others' region where it is."""
    return X + sum(x - X for x in positions)


def _march(kappa: FloatArray, step: float, stretch: float) -> tuple[Rotation, FloatArray]:
    """Frames and centre-line points at the beginning of each step."""
    whole, half = Rotation.from_rotvec(kappa * step), Rotation.from_rotvec(0.5 * kappa * step)
    frames = [Rotation.identity()]
    for turn in whole[:-1]:
        frames.append(frames[-1] * turn)
    stacked = Rotation.concatenate(frames)
    moves = (stacked * half).apply([1.0, 0.0, 0.0]) * step * stretch
    return stacked, np.vstack([np.zeros(3), np.cumsum(moves[:-1], axis=0)])


def twisted_plate(X: FloatArray, line: Rod, degrees: float, profile: Profile, width: float) -> FloatArray:
    """Positions (n, 3), mm, of a thin plate turned by `degrees` about its centre line without an axial force.

    The second axis of `line` runs across the plate (`width`, mm), the third through its thickness. The mid-surface
    becomes a helicoid, to which lines through the thickness stay normal (Kirchhoff); its centre line shortens so that
    the fibres are, on the mean square, as long as before.
    """
    step = line.length / STEPS
    turn = Turn((1, 0, 0), degrees, profile)
    rates = curvature(_middles(step), line.length, (turn,))[:, 0]
    lengths = np.sqrt(1.0 - rates**2 * width**2 / 12.0)
    s, a, b = section_coordinates(X, line).T
    on_line = np.clip(s, 0.0, line.length)
    nodes, middles = step * np.arange(STEPS + 1), _middles(step)
    phi = np.interp(on_line, nodes, np.r_[0.0, np.cumsum(rates * step)])
    along = np.interp(on_line, nodes, np.r_[0.0, np.cumsum(lengths * step)]) + s - on_line
    length = np.where(s <= 0.0, 1.0, np.interp(on_line, middles, lengths))
    lift = np.where(s <= 0.0, 0.0, np.interp(on_line, middles, rates)) * a
    across, normal = (
        np.column_stack([0 * s, x, y]) for x, y in ((np.cos(phi), np.sin(phi)), (-np.sin(phi), np.cos(phi)))
    )
    tilted = (length[:, None] * normal - np.outer(lift, [1.0, 0.0, 0.0])) / np.hypot(length, lift)[:, None]
    return line.origin + (np.outer(along, [1.0, 0.0, 0.0]) + a[:, None] * across + b[:, None] * tilted) @ line.frame
