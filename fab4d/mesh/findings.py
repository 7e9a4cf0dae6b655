"""Findings of the mesh checks: what, how bad, in which file, and where."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Finding:
    """One thing found: how bad (`error`, `repaired`, `warning`), or a `hint`; in which file, how often, and where.

    indices : up to five vertex or tet numbers of the user's file, from 0
    """

    code: str
    severity: str
    file: str
    message: str
    count: int = 0
    indices: tuple[int, ...] = ()


def first_few(indices: Sequence[int] | np.ndarray) -> tuple[int, ...]:
    return tuple(int(k) for k in indices[:5])


def named(what: str, indices: Sequence[int] | np.ndarray) -> str:
    """`tets 3, 8, 9 ...`: numbers of the user's file, from 0."""
    shown = ", ".join(str(k) for k in first_few(indices))
    plural = {"tet": "tets", "vertex": "vertices"}[what] if len(indices) > 1 else what
    return f"{plural} {shown}{' ...' if len(indices) > 5 else ''}"


def finding(code: str, severity: str, file: str, message: str, indices: Sequence[int] | np.ndarray = ()) -> Finding:
    """A finding whose message starts with the file, and whose count is that of all `indices`."""
    return Finding(code, severity, file, f"{file}: {message}", len(indices), first_few(indices))
