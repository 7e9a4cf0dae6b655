"""Three orthographic views of a programmed part: picture, and where points and arrows fall on paper."""

from dataclasses import dataclass

import numpy as np

from fab4d.mesh.tetmesh import BoolArray, FloatArray, IntArray
from fab4d.report.zbuffer import DepthImage, render, shading

SMP_COLOUR = np.array([0, 150, 165.0])
TPE_COLOUR = np.array([178, 172, 160.0])
GHOST_COLOUR = np.array([238, 238, 238.0])
CLAMP_COLOUR = np.array([150, 40, 30.0])
OUTLINE_COLOUR = np.array([60, 60, 60.0])
TPE_OPACITY = 0.45


@dataclass(frozen=True, eq=False)
class Frame:
    """Axes of a view: to the right, up and towards the viewer, rows of a rotation (3, 3); and its names."""

    name: str
    right: str
    up: str
    axes: FloatArray


FRAMES = (
    Frame("Top, seen from +z", "x", "y", np.array([[1.0, 0, 0], [0, 1, 0], [0, 0, 1]])),
    Frame("Front, seen from -y", "x", "z", np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])),
    Frame("Side, seen from +x", "y", "z", np.array([[0.0, 1, 0], [0, 0, 1], [1, 0, 0]])),
)


@dataclass(frozen=True, eq=False)
class Figure:
    """What the views show: permanent shape X and median shape x (n, 3), mm; triangles of the outer surface, of the
    SMP body and of the clamp."""

    X: FloatArray
    x: FloatArray
    outer: IntArray
    smp: IntArray
    clamp: IntArray


@dataclass(frozen=True, eq=False)
class Projection:
    """From mm in space to a window of `size` (width, height) in mm of the part, whose lower left corner is `origin`."""

    frame: Frame
    origin: FloatArray
    size: FloatArray

    def __call__(self, points: FloatArray) -> FloatArray:
        """(k, 3) right, up (from the window's corner) and towards the viewer, mm."""
        return points @ self.frame.axes.T - np.append(self.origin, 0.0)

    def pixels(self, points: FloatArray, resolution: float) -> FloatArray:
        """(k, 3) pixel column, pixel row and depth at `resolution` pixels a mm."""
        p = self(points)
        return np.column_stack([p[:, 0] * resolution, (self.size[1] - p[:, 1]) * resolution, p[:, 2]])


def fitted(frame: Frame, *shapes: FloatArray) -> Projection:
    """The smallest window around all shapes (n, 3), with a margin of 1 %."""
    flat = np.concatenate(shapes) @ frame.axes[:2].T
    low, high = flat.min(axis=0), flat.max(axis=0)
    margin = 0.01 * float(np.max(high - low))
    return Projection(frame, low - margin, high - low + 2 * margin)


def picture(figure: Figure, projection: Projection, resolution: float) -> np.ndarray:
    """RGB image (h, w, 3) uint8: permanent shape as a pale ghost, median shape with translucent TPE, SMP in colour,
    clamp hatched. `resolution` in pixels a mm of the part."""
    width, height = (max(1, int(np.ceil(side * resolution))) for side in projection.size)
    x = projection.pixels(figure.x, resolution)
    ghost = render(projection.pixels(figure.X, resolution), figure.outer, width, height)
    outer, smp, clamp = (render(x, f, width, height) for f in (figure.outer, figure.smp, figure.clamp))
    image = np.full((height, width, 3), 255.0)
    _ghost(image, ghost)
    _solid(image, smp, SMP_COLOUR, _lit(figure, figure.smp, projection), 1.0)
    _solid(image, outer, TPE_COLOUR, _lit(figure, figure.outer, projection), TPE_OPACITY)
    _hatch(image, clamp, outer)
    image[_edges(outer, _typical_step(figure))] = OUTLINE_COLOUR
    return np.clip(image, 0, 255).astype(np.uint8)


def hidden_points(figure: Figure, projection: Projection, points: FloatArray, resolution: float = 4.0) -> BoolArray:
    """(k,) whether the median shape is in front of each point (k, 3) on its surface."""
    width, height = (max(1, int(np.ceil(side * resolution))) for side in projection.size)
    depth = render(projection.pixels(figure.x, resolution), figure.outer, width, height).depth
    p = projection.pixels(points, resolution)
    column = np.clip(p[:, 0].astype(np.int64), 0, width - 1)
    row = np.clip(p[:, 1].astype(np.int64), 0, height - 1)
    return depth[row, column] > p[:, 2] + _typical_step(figure)


def _typical_step(figure: Figure) -> float:
    """A depth difference that is a step and no slope, mm."""
    return 0.02 * float(np.linalg.norm(np.ptp(figure.x, axis=0)))


def _lit(figure: Figure, faces: IntArray, projection: Projection) -> FloatArray:
    light = np.array([-0.35, 0.45, 0.82])
    return shading(figure.x, faces, (light / np.linalg.norm(light)) @ projection.frame.axes)


def _solid(image: FloatArray, seen: DepthImage, colour: FloatArray, light: FloatArray, opacity: float) -> None:
    mask = seen.face >= 0
    shade = light[seen.face[mask]][:, None] * colour
    image[mask] = (1 - opacity) * image[mask] + opacity * shade


def _ghost(image: FloatArray, ghost: DepthImage) -> None:
    """Pale fill, dashed outline."""
    mask = ghost.face >= 0
    image[mask] = GHOST_COLOUR
    rows, columns = np.indices(mask.shape)
    image[_border(mask) & ((rows + columns) // 8 % 2 == 0)] = 0.6 * GHOST_COLOUR


def _hatch(image: FloatArray, clamp: DepthImage, outer: DepthImage) -> None:
    """Diagonal lines on the clamp, wider apart where it is hidden."""
    mask = clamp.face >= 0
    front = mask & (clamp.depth >= outer.depth - 1e-6 * (1 + np.abs(outer.depth)))
    rows, columns = np.indices(mask.shape)
    image[front & ((rows + columns) % 10 < 3)] = CLAMP_COLOUR
    image[mask & ~front & ((rows + columns) % 20 < 2)] = CLAMP_COLOUR


def _border(mask: BoolArray) -> BoolArray:
    """Pixels of the mask, one pixel deep, that touch what is not in it."""
    padded = np.pad(mask, 1)
    inside = padded[:-2, 1:-1] & padded[2:, 1:-1] & padded[1:-1, :-2] & padded[1:-1, 2:]
    return mask & ~inside


def _edges(seen: DepthImage, step: float) -> BoolArray:
    """Outline of what is seen, and edges where it jumps in depth by more than `step`."""
    mask = seen.face >= 0
    depth = np.where(mask, seen.depth, 0.0)
    jumps = np.zeros_like(mask)
    for axis in (0, 1):
        near, far = [slice(None)] * 2, [slice(None)] * 2
        near[axis], far[axis] = slice(None, -1), slice(1, None)
        jump = np.abs(np.diff(depth, axis=axis)) > step
        jumps[tuple(near)] |= jump & mask[tuple(near)] & mask[tuple(far)]
    return _border(mask) | jumps
