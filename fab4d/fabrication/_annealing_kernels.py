"""Compiled simulated annealing of labels. `annealing.py` explains it."""

from typing import Any, NamedTuple

import numpy as np
from numba import njit

from fab4d.fabrication._links import Links
from fab4d.fabrication._repair_kernels import Scratch, all_defects, vertex_defects
from fab4d.mesh.tetmesh import BoolArray, FloatArray, IntArray

# Functions that only compiled ones call need no entry from Python: with so many arrays it takes long to compile.
_NO_ENTRY: dict[str, Any] = {"no_cpython_wrapper": True, "no_cfunc_wrapper": True}
_inner = njit(cache=True, nogil=True, **_NO_ENTRY)
_sums = njit(cache=True, nogil=True, fastmath={"reassoc", "contract", "nsz"}, **_NO_ENTRY)
# Steps at one temperature.
SAME_TEMPERATURE = 256


class Candidates(NamedTuple):
    """Tets (k,) that may flip, their neighbours across faces (k, 4), -1 at the surface, and volumes (k,)."""

    tets: IntArray
    neighbours: IntArray
    volumes: FloatArray


class Squares(NamedTuple):
    """`annealing.Energy` as the kernel changes it: error (p,) and beyond (l,) at the present labels.

    gram (k, k) : scalar products of the changes; of size 0 where they are too many to be kept
    slope (k,) : scalar products of the changes with the error, where there is a gram
    """

    error: FloatArray
    changes: FloatArray
    gram: FloatArray
    slope: FloatArray
    beyond: FloatArray
    limit_changes: FloatArray


@_sums
def _rise(k: int, sign: float, squares: Squares) -> float:
    """By how much the squares of the error grow with a flip, or with one taken back (sign -1)."""
    if squares.gram.size:
        return 2 * sign * squares.slope[k] + squares.gram[k, k]
    slope = own = 0.0
    for i in range(len(squares.error)):
        slope += squares.changes[k, i] * squares.error[i]
        own += squares.changes[k, i] * squares.changes[k, i]
    return 2 * sign * slope + own


@_sums
def _rise_of_limits(k: int, sign: float, squares: Squares) -> float:
    rise = 0.0
    for i in range(len(squares.beyond)):
        before = max(squares.beyond[i], 0.0)
        after = max(squares.beyond[i] + sign * squares.limit_changes[k, i], 0.0)
        rise += after * after - before * before
    return rise


@_inner
def _take(k: int, sign: float, squares: Squares) -> None:
    if squares.gram.size:
        for j in range(len(squares.slope)):
            squares.slope[j] += sign * squares.gram[k, j]
    else:
        for i in range(len(squares.error)):
            squares.error[i] += sign * squares.changes[k, i]
    for i in range(len(squares.beyond)):
        squares.beyond[i] += sign * squares.limit_changes[k, i]


@_inner
def _at_interface(k: int, smp: BoolArray, candidates: Candidates) -> bool:
    found = False
    for other in candidates.neighbours[k]:
        found = found or (other >= 0 and smp[other] != smp[candidates.tets[k]])
    return found


@_inner
def _defects_left(tet: int, nowhere: BoolArray, smp: BoolArray, links: Links, scratch: Scratch) -> int:
    """At the corners of a tet, once it is flipped."""
    smp[tet] = not smp[tet]
    left = 0
    for vertex in links.vertices[tet]:
        left += vertex_defects(vertex, nowhere, smp, links, scratch)
    smp[tet] = not smp[tet]
    return left


@njit(cache=True, nogil=True)
def anneal(
    smp: BoolArray,
    candidates: Candidates,
    squares: Squares,
    prices: tuple,
    room: float,
    temperatures: tuple,
    steps: int,
    random: np.random.Generator,
    links: Links,
    scratch: Scratch,
) -> tuple[float, BoolArray]:
    """The least energy found, less that of no flips, and which candidates (k,) to flip for it.

    smp (m,), squares : are changed on the way
    prices : of each candidate (k,) and of each defect        room : volume that may become SMP
    temperatures : first and last
    """
    nowhere = np.zeros(len(links.n_nodes), np.bool_)
    defects = all_defects(nowhere, smp, links, scratch)
    flipped = np.zeros(len(candidates.tets), np.bool_)
    best = flipped.copy()
    energy = least = 0.0
    (price_of, defect_price), (first, last) = prices, temperatures
    temperature = first
    for step in range(steps):
        if step % SAME_TEMPERATURE == 0:
            temperature = first * (last / first) ** (step / steps)
        k = int(random.integers(0, len(flipped)))
        tet, sign, before = candidates.tets[k], -1.0 if flipped[k] else 1.0, 0
        for vertex in links.vertices[tet]:
            before += defects[vertex]
        # At best the flip removes all defects at its corners.
        allowed = before * defect_price - temperature * np.log(1.0 - random.random())
        rise = _rise(k, sign, squares) + sign * price_of[k]
        if rise > allowed or not _at_interface(k, smp, candidates) or (not smp[tet] and candidates.volumes[k] > room):
            continue
        if len(squares.beyond):
            rise += _rise_of_limits(k, sign, squares)
        if rise > allowed:
            continue
        left = _defects_left(tet, nowhere, smp, links, scratch)
        rise += (left - before) * defect_price
        if left > before or rise > allowed - before * defect_price:
            continue
        _take(k, sign, squares)
        room += candidates.volumes[k] if smp[tet] else -candidates.volumes[k]
        smp[tet], flipped[k] = not smp[tet], not flipped[k]
        for vertex in links.vertices[tet]:
            defects[vertex] = vertex_defects(vertex, nowhere, smp, links, scratch)
        energy += rise
        if energy < least:
            least = energy
            best[:] = flipped
    return least, best
