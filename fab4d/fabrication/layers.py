"""What lines of a given width leave empty: cross-sections of the bodies at the heights of layers.

A line is a stripe with round ends, so it fills what is left of a cross-section after a morphological opening with a
disc of its width: sharp corners and walls that are thinner stay empty. Both slicers that were tried lay down about
this much less than the body.
"""

from dataclasses import dataclass

import manifold3d
import numpy as np

from fab4d.fabrication.bodies import Bodies, Body, as_manifold
from fab4d.mesh.tetmesh import FloatArray

MOST_LEVELS, FEW_LEVELS = 48, 12
"""Layers that are looked at, evenly spaced where the part has more; and where a first look is enough."""
_SEGMENTS = 16
_MITER = 2.0  # of a join that is not used


@dataclass(frozen=True)
class Unfilled:
    """Of one body: share of its volume that stays empty, and the share that only its interface is to blame for."""

    share: float
    share_inside: float
    where: tuple[float, float, float] | None
    """Middle of the largest empty area in the worst layer, mm."""


def unfilled(
    bodies: Bodies, line_width: float, layer_height: float, most_levels: int = MOST_LEVELS
) -> dict[str, Unfilled]:
    """What stays empty of each body, by its name, when it is built along z with lines of `line_width` (mm)."""
    levels = _levels(bodies.whole.vertices[:, 2], layer_height, most_levels)
    outside = [_gaps(section, line_width) for section in _sections(bodies.whole, levels)]
    found = {}
    for body in bodies.printed:
        sections = _sections(body, levels)
        gaps = [_gaps(section, line_width) for section in sections]
        inside = sum((gap - part).area() for gap, part in zip(gaps, outside, strict=True))
        area = sum(section.area() for section in sections)
        empty = [gap.area() for gap in gaps]
        worst = int(np.argmax(empty))
        where = _middle(gaps[worst], levels[worst]) if empty[worst] > 0 else None
        # A body between two levels has no section at all.
        found[body.name] = Unfilled(sum(empty) / area, inside / area, where) if area > 0 else Unfilled(1.0, 1.0, None)
    return found


def _sections(body: Body, levels: list[float]) -> list[manifold3d.CrossSection]:
    solid = as_manifold(body)
    return [solid.slice(z) for z in levels]


def _levels(z: FloatArray, layer_height: float, most: int) -> list[float]:
    """Middles of layers, mm."""
    low, high = float(z.min()), float(z.max())
    count = max(1, round((high - low) / layer_height))
    chosen = np.unique(np.linspace(0, count - 1, min(count, most)).astype(np.int64))
    return [low + (high - low) * (k + 0.5) / count for k in chosen.tolist()]


def _gaps(section: manifold3d.CrossSection, width: float) -> manifold3d.CrossSection:
    """What a disc of diameter `width` inside the section does not reach."""
    join = manifold3d.JoinType.Round
    reached = section.offset(-0.5 * width, join, _MITER, _SEGMENTS).offset(0.5 * width, join, _MITER, _SEGMENTS)
    return section - reached


def _middle(gaps: manifold3d.CrossSection, z: float) -> tuple[float, float, float]:
    x0, y0, x1, y1 = max(gaps.decompose(), key=lambda gap: gap.area()).bounds()
    return 0.5 * (x0 + x1), 0.5 * (y0 + y1), z
