"""Compiled simulated annealing of labels. `annealing.py` explains it."""

from typing import NamedTuple

import numpy as np
from numba import njit

from fab4d.fabrication._links import Links
from fab4d.fabrication._repair_kernels import ONLY_INSIDE, Scratch, all_defects, vertex_defects
from fab4d.mesh.tetmesh import BoolArray, FloatArray, IntArray

_inner = njit(cache=True, nogil=True, **ONLY_INSIDE)
_sums = njit(cache=True, nogil=True, fastmath={"reassoc", "contract", "nsz"}, **ONLY_INSIDE)
# Steps at one temperature.
SAME_TEMPERATURE = 256


class Candidates(NamedTuple):
    """Tets (k,) that may flip, their neighbours across faces (k, 4), -1 at the surface, and volumes (k,).

    beside (k, 4) : which candidates the neighbours are, -1 for none
    """

    tets: IntArray
    neighbours: IntArray
    beside: IntArray
    volumes: FloatArray


class Squares(NamedTuple):
    """`annealing.Energy` as the kernel changes it: error (p,) and beyond (l,) at the present labels.

    own (k,) : scalar products of each change with itself
    """

    error: FloatArray
    changes: FloatArray
    own: FloatArray
    beyond: FloatArray
    limit_changes: FloatArray


@_sums
def _product(a: FloatArray, b: FloatArray) -> float:
    product = 0.0
    for i in range(len(a)):
        product += a[i] * b[i]
    return product


@_inner
def _rise(move: IntArray, flipped: BoolArray, squares: Squares, price_of: FloatArray) -> float:
    """By how much the squares of the error and the prices grow with flips of one or two candidates."""
    rise = 0.0
    for k in move:
        rise += squares.own[k] + _sign(k, flipped) * (2 * _product(squares.changes[k], squares.error) + price_of[k])
    if len(move) == 2:
        product = _product(squares.changes[move[0]], squares.changes[move[1]])
        rise += 2 * _sign(move[0], flipped) * _sign(move[1], flipped) * product
    return rise


@_sums
def _rise_of_limits(move: IntArray, flipped: BoolArray, squares: Squares) -> float:
    rise = 0.0
    for i in range(len(squares.beyond)):
        before = after = squares.beyond[i]
        for k in move:
            after += _sign(k, flipped) * squares.limit_changes[k, i]
        rise += max(after, 0.0) ** 2 - max(before, 0.0) ** 2
    return rise


@_inner
def _sign(k: int, flipped: BoolArray) -> float:
    """-1 where a flip takes one back."""
    return -1.0 if flipped[k] else 1.0


@_inner
def _take(k: int, sign: float, squares: Squares) -> None:
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
def _flip(move: IntArray, smp: BoolArray, candidates: Candidates) -> bool:
    """Whether each tet is at the interface once those before it are flipped; if not, none is."""
    for i in range(len(move)):
        if not _at_interface(move[i], smp, candidates):
            _flip_back(move[:i], smp, candidates)
            return False
        tet = candidates.tets[move[i]]
        smp[tet] = not smp[tet]
    return True


@_inner
def _flip_back(move: IntArray, smp: BoolArray, candidates: Candidates) -> None:
    for k in move:
        smp[candidates.tets[k]] = not smp[candidates.tets[k]]


@_inner
def _volume(move: IntArray, smp: BoolArray, candidates: Candidates) -> float:
    """That becomes SMP."""
    volume = 0.0
    for k in move:
        volume += -candidates.volumes[k] if smp[candidates.tets[k]] else candidates.volumes[k]
    return volume


@_inner
def _corners(move: IntArray, candidates: Candidates, links: Links, corners: IntArray) -> int:
    """Those of the tets, each once, into corners (8,); returns how many."""
    count = 0
    for k in move:
        for vertex in links.vertices[candidates.tets[k]]:
            known = False
            for i in range(count):
                known = known or corners[i] == vertex
            if not known:
                corners[count] = vertex
                count += 1
    return count


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

    A step flips a tet, or two with a common face: the other may mend what the one would pinch. Places are pinched on
    the way for a price, but what is found has no more of them than the labels to begin with.

    smp (m,), squares : are changed on the way
    prices : of each candidate (k,), of each defect that is left, and of each besides on the way
    room : volume that may become SMP        temperatures : first and last
    """
    nowhere = np.zeros(len(links.n_nodes), np.bool_)
    defects = all_defects(nowhere, smp, links, scratch)
    flipped = np.zeros(len(candidates.tets), np.bool_)
    best, both, eight = flipped.copy(), np.zeros(2, np.int64), np.zeros(8, np.int64)
    energy = least = 0.0
    more_defects = 0
    (price_of, defect_price, on_the_way), (first, last) = prices, temperatures
    temperature, worth = first, defect_price + on_the_way
    for step in range(steps):
        if step % SAME_TEMPERATURE == 0:
            temperature = first * (last / first) ** (step / steps)
        # A tenth of the time that `integers` takes.
        both[0] = int(len(flipped) * random.random())
        both[1] = candidates.beside[both[0], int(4 * random.random())] if step % 2 else -1
        move = both[: 1 if both[1] < 0 else 2]
        corners = eight[: _corners(move, candidates, links, eight)]
        before = left = 0
        for vertex in corners:
            before += defects[vertex]
        # At best the flips remove all defects at their corners.
        allowed = before * worth - temperature * np.log(1.0 - random.random())
        rise = _rise(move, flipped, squares, price_of)
        volume = _volume(move, smp, candidates)
        if rise > allowed or volume > max(room, 0.0):
            continue
        if len(squares.beyond):
            rise += _rise_of_limits(move, flipped, squares)
        if rise > allowed or not _flip(move, smp, candidates):
            continue
        for vertex in corners:
            left += vertex_defects(vertex, nowhere, smp, links, scratch)
        if rise > allowed - left * worth:
            _flip_back(move, smp, candidates)
            continue
        for vertex in corners:
            defects[vertex] = vertex_defects(vertex, nowhere, smp, links, scratch)
        for k in move:
            _take(k, _sign(k, flipped), squares)
            flipped[k] = not flipped[k]
        room -= volume
        more_defects += left - before
        energy += rise + (left - before) * defect_price
        if energy < least and more_defects <= 0:
            least = energy
            best[:] = flipped
    return least, best
