"""The internal units are mm, N and MPa; everything else is converted where it enters or leaves."""

from types import MappingProxyType
from typing import Final

from fab4d.errors import SceneError

MM_PER_UNIT: Final = MappingProxyType({"mm": 1.0, "cm": 10.0, "m": 1000.0, "in": 25.4})
N_PER_KGF: Final = 9.80665


def mm_per(unit: str) -> float:
    """Millimetres per length unit `unit`. Raises SceneError for an unknown unit."""
    if unit not in MM_PER_UNIT:
        known = ", ".join(MM_PER_UNIT)
        msg = f'unknown length unit "{unit}": use one of {known}'
        raise SceneError(msg)
    return MM_PER_UNIT[unit]
