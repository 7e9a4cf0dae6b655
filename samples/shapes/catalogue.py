"""Every sample by its name. Lengths are mm."""

from collections.abc import Callable

import numpy as np

from shapes import face, fish
from shapes import gripper as grip
from shapes import tower as lattice
from shapes.boxes import box
from shapes.on_demand import ON_DEMAND
from shapes.plates import outline_triangles, thickened
from shapes.scene import Sample
from shapes.stuffing import stuffed
from shapes.warps import Turn, bump, moved_together, ramp, rod, twisted_plate, warped


def strip() -> Sample:
    """A small bar bent by 75 degrees."""
    X, tets = box((84.0, 12.0, 8.0), (12, 2, 2), "five")
    X_temp = warped(X, rod((7, 6, 4), (84, 6, 4), (0, 1, 0)), (Turn((0, 1, 0), -75, bump(0, 84 - 7)),))
    return Sample("A small bar bent by 75 degrees.", X, X_temp, tets, ((-1, -1, -1), (8, 13, 9)), 4, 5e-3)


def twist_bar() -> Sample:
    """A flat bar whose free end is turned by 180 degrees."""
    width, length = 55.0, 155.0
    X, tets = box((width, length, 5.0), (11, 31, 1), "five")
    line = rod((width / 2, 5, 2.5), (width / 2, length, 2.5), (1, 0, 0))
    X_temp = twisted_plate(X, line, 180, lambda y: ramp(y, 0, 20), width)
    title = "A flat bar twisted by 180 degrees."
    return Sample(title, X, X_temp, tets, ((-1, -1, -1), (width + 1, 6, 6)), 8, 4e-3)


def tower() -> Sample:
    """A lattice tower bent by 80 degrees, more where it is slender."""
    X, tets = lattice.lattice_tower()
    start = lattice.layer_heights()[lattice.FOOT]
    profile = lambda s: ramp(s, 0, 25) / lattice.width(s + start)  # noqa: E731
    X_temp = warped(X, rod((0, 0, start), (0, 0, lattice.HEIGHT), (1, 0, 0)), (Turn((0, 0, 1), 80, profile),))
    half = 0.5 * float(lattice.width(np.zeros(1))[0]) + 1.0
    clamp = ((-half, -half, -1.0), (half, half, round(start + 0.5, 2)))
    return Sample("A lattice tower bent by 80 degrees.", X, X_temp, tets, clamp, 8, 5e-3)


def gripper() -> Sample:
    """Three legs that close over the hub by 100 degrees."""
    X, tets = grip.three_legs()
    root = grip.APOTHEM + 8.0
    legs = []
    for angle in grip.DIRECTIONS:
        x, y = np.cos(angle), np.sin(angle)
        tip, mid = grip.APOTHEM + grip.REACH, grip.THICKNESS / 2
        line = rod((root * x, root * y, mid), (tip * x, tip * y, mid), (0, 0, 1))
        legs.append(warped(X, line, (Turn((0, 0, 1), 100, bump(0, line.length)),)))
    clamp = ((-15.5, -15.5, -1.0), (15.5, 15.5, grip.THICKNESS + 1.0))
    return Sample("Three legs closing by 100 degrees.", X, moved_together(X, *legs), tets, clamp, 9, 4e-3, 0.20)


def fin() -> Sample:
    """A fish-like body in an S-bend, held at the head."""
    X, tets = stuffed(fish.fish, fish.LOW, fish.HIGH, 5.4)
    line = rod((50, 0, 0), (fish.LENGTH, 0, 0), (0, 1, 0))
    turns = (Turn((0, 0, 1), 50, bump(0, 75, 0.4)), Turn((0, 0, 1), -75, bump(55, 130, 0.4)))
    clamp = ((-1, -15, -25), (49, 15, 25))
    return Sample("A fish-like body in an S-bend.", X, warped(X, line, turns), tets, clamp, 8, 2e-3)


def smiley() -> Sample:
    """A thin face that opens its mouth and bows."""
    X, tets = thickened(*outline_triangles(face.face, (-55, -55), (55, 55), 3.4), face.THICKNESS, 2)
    mid = face.THICKNESS / 2
    line = rod((0, 34, mid), (0, -face.RADIUS, mid), (0, 0, 1))
    X_temp = warped(face.mouth_opened(X), line, (Turn((0, 0, 1), 60, bump(0, line.length)),))
    return Sample("A thin face that opens its mouth and bows.", X, X_temp, tets, ((-56, 34, -1), (56, 56, 6)), 10, 4e-3)


def snake() -> Sample:
    """A long box curled to half a circle; 24 x 10 x 10 cells of six tets."""
    X, tets = box((192.0, 24.0, 24.0), (24, 10, 10), "six")
    line = rod((8, 12, 12), (192, 12, 12), (0, 1, 0))
    X_temp = warped(X, line, (Turn((0, 0, 1), 180, bump(0, line.length, 0.2)),))
    return Sample("A long box curled by 180 degrees.", X, X_temp, tets, ((-1, -1, -1), (9, 25, 25)), 8, 1e-2)


COMMITTED: dict[str, Callable[[], Sample]] = {
    "strip": strip,
    "twist-bar": twist_bar,
    "tower": tower,
    "gripper": gripper,
    "fin": fin,
    "smiley": smiley,
    "snake": snake,
}

SAMPLES = COMMITTED | ON_DEMAND
