"""Every sample by its name. Lengths are mm."""

from collections.abc import Callable

from shapes.boxes import box
from shapes.scene import Sample
from shapes.warps import Turn, bump, ramp, rod, twisted_plate, warped


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


COMMITTED: dict[str, Callable[[], Sample]] = {"strip": strip, "twist-bar": twist_bar}
ON_DEMAND: dict[str, Callable[[], Sample]] = {}
SAMPLES = COMMITTED | ON_DEMAND
