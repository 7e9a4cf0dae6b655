"""Compiled local search that makes the labels of a tet mesh well composed. `wellcomposed.py` explains it."""

from typing import Any, NamedTuple

import numpy as np
from numba import njit

from fab4d.fabrication._links import Links
from fab4d.mesh.tetmesh import BoolArray, FloatArray, IntArray

# Loops instead of sums, copies and assignments of slices: numba's code for these takes long to compile.
# Functions that only compiled ones call need no entry from Python: with so many arrays it takes long to compile. Nor do
# they count references to these arrays, which takes longer than what many of them do, most of all where two threads
# count the same (numba issue 2345): so they may make no arrays and return none.
ONLY_INSIDE: dict[str, Any] = {"no_cpython_wrapper": True, "no_cfunc_wrapper": True, "_nrt": False}
_inner = njit(cache=True, **ONLY_INSIDE)
FREE, LOCK_STEPS, LIMITLESS = -1, 12, 1 << 40
EACH_TET, WHOLE_STAR = -2, -1


class State(NamedTuple):
    """What the search changes. `only` (1,): FREE, or the one label whose tets may flip."""

    smp: BoolArray
    original: BoolArray
    cost: FloatArray
    pinched: BoolArray
    defects: IntArray
    locked_until: IntArray
    only: IntArray


class Scratch(NamedTuple):
    """Work space, as long as the largest star."""

    bits: BoolArray
    degree: IntArray
    parent: IntArray
    group: IntArray
    stamp: IntArray
    """(n + 1,) the last entry counts."""
    members: IntArray
    best: IntArray
    nodes: IntArray


class Queue(NamedTuple):
    """A double-ended queue of vertices in a ring; `ends` (2,): bottom and number of entries."""

    ring: IntArray
    waiting: BoolArray
    ends: IntArray


@_inner
def _root(parent: IntArray, i: int) -> int:
    while parent[i] != i:
        parent[i] = parent[parent[i]]
        i = parent[i]
    return i


@_inner
def _boundary_excess(v: int, value: bool, links: Links, scratch: Scratch) -> int:
    """How far the boundary of one material is from a single cycle in the link of v; fills scratch.degree."""
    degree, parent, bits = scratch.degree, scratch.parent, scratch.bits
    for i in range(links.n_nodes[v]):
        degree[i] = 0
        parent[i] = i
    touched = joined = excess = 0
    for e in range(links.edge_start[v], links.edge_start[v + 1]):
        a, b = links.edge_tets[e]
        if (bits[a] == value) != (b >= 0 and bits[b] == value):
            i, j = links.edge_ends[e]
            touched += (degree[i] == 0) + (degree[j] == 0)
            degree[i] += 1
            degree[j] += 1
            i, j = _root(parent, i), _root(parent, j)
            joined += i != j
            parent[i] = j
    for i in range(links.n_nodes[v]):
        excess += max(0, degree[i] // 2 - 1)
    return excess + max(0, touched - joined - 1)


@_inner
def _load_bits(v: int, smp: BoolArray, links: Links, scratch: Scratch) -> None:
    start = links.star_start[v]
    for k in range(links.star_start[v + 1] - start):
        scratch.bits[k] = smp[links.star[start + k]]


@_inner
def vertex_defects(v: int, pinched: BoolArray, smp: BoolArray, links: Links, scratch: Scratch) -> int:
    """Surplus cycles and four-face edges of both materials at v; inside the part both have the same boundary.

    Where the part itself is pinched, the defects are the tets to flip until one material is left.
    """
    _load_bits(v, smp, links, scratch)
    if pinched[v]:
        size, n_smp = links.star_start[v + 1] - links.star_start[v], 0
        for k in range(size):
            n_smp += scratch.bits[k]
        return min(n_smp, size - n_smp)
    defects = _boundary_excess(v, True, links, scratch)
    if links.on_surface[v]:
        defects += _boundary_excess(v, False, links, scratch)
    return defects


@njit(cache=True)
def all_defects(pinched: BoolArray, smp: BoolArray, links: Links, scratch: Scratch) -> IntArray:
    """`vertex_defects` of every vertex (n,)."""
    defects = np.zeros(len(links.n_nodes), np.int64)
    for v in range(len(defects)):
        defects[v] = vertex_defects(v, pinched, smp, links, scratch)
    return defects


@_inner
def _group_tets(v: int, node: int, links: Links, scratch: Scratch) -> None:
    """scratch.group: component of each tet of the star (equal labels, joined by faces); of node >= 0 at that edge only.

    With node EACH_TET every tet is a group by itself.
    """
    size = links.star_start[v + 1] - links.star_start[v]
    parent, group, bits = scratch.parent, scratch.group, scratch.bits
    for k in range(size):
        parent[k] = k
        group[k] = -1 if node >= 0 else 0
    for e in range(links.edge_start[v], links.edge_start[v + 1]):
        if node < 0 or links.edge_ends[e, 0] == node or links.edge_ends[e, 1] == node:
            a, b = links.edge_tets[e]
            group[a] = 0
            if b >= 0:
                group[b] = 0
                if bits[a] == bits[b] and node != EACH_TET:
                    parent[_root(parent, a)] = _root(parent, b)
    for k in range(size):
        if group[k] == 0:
            group[k] = _root(parent, k)


@_inner
def _gather(v: int, group: int, links: Links, scratch: Scratch) -> int:
    """The tets of one group into scratch.members; returns how many."""
    start, count = links.star_start[v], 0
    for k in range(links.star_start[v + 1] - start):
        if scratch.group[k] == group:
            scratch.members[count] = links.star[start + k]
            count += 1
    return count


@_inner
def _flip(tets: IntArray, state: State) -> None:
    for t in tets:
        state.smp[t] = not state.smp[t]


@_inner
def _fresh_stamp(scratch: Scratch) -> int:
    scratch.stamp[-1] += 1
    return scratch.stamp[-1]


@_inner
def _change(v: int, tets: IntArray, limit: int, state: State, links: Links, scratch: Scratch) -> int:
    """Change of the number of defects when `tets`, all at v, flip; any number above `limit` if it exceeds that."""
    stamp, change = _fresh_stamp(scratch), 0
    for t in tets:
        for u in links.vertices[t]:
            if scratch.stamp[u] != stamp:
                scratch.stamp[u] = stamp
                change -= state.defects[u]
    # So far it stands for no defect left, and only grows from here.
    _flip(tets, state)
    change += vertex_defects(v, state.pinched, state.smp, links, scratch)
    scratch.stamp[v] = 0
    for t in tets:
        for u in links.vertices[t]:
            if scratch.stamp[u] == stamp and change <= limit:
                scratch.stamp[u] = 0
                change += vertex_defects(u, state.pinched, state.smp, links, scratch)
    _flip(tets, state)
    return change


@_inner
def _allowed(tets: IntArray, step: int, state: State) -> bool:
    only = state.only[0]
    for t in tets:
        if only == FREE:
            if state.locked_until[t] > step:
                return False
        elif state.smp[t] != (only == 1):
            return False
    return True


@_inner
def _price(tets: IntArray, state: State) -> float:
    """What a flip of `tets` costs: little where it brings the original label back."""
    price = 0.0
    for t in tets:
        price += state.cost[t] * (1.0 if state.smp[t] == state.original[t] else 0.1)
    return price


@_inner
def _limit(price: float, best: tuple) -> int:
    """The largest change of defects with which a move of that price is better than `best`."""
    if best[0] > 0:
        return best[0] - (1 if price < best[1] else 2)
    return -1 - int(min(price / best[1], 1e6)) if best[1] > 0 else -LIMITLESS


@_inner
def _try(v: int, count: int, step: int, best: tuple, state: State, links: Links, scratch: Scratch) -> tuple:
    """`best` (rank, price, count), or the move scratch.members[:count] if it is better (kept in scratch.best)."""
    tets = scratch.members[:count]
    if not _allowed(tets, step, state):
        return best
    price = _price(tets, state)
    limit = _limit(price, best)
    change = _change(v, tets, limit, state, links, scratch)
    if change > limit:
        return best
    rank, price = (0, price / -change) if change < 0 else (1 + change, price)
    for k in range(count):
        scratch.best[k] = tets[k]
    return rank, price, count


@_inner
def _kinds_of_moves(v: int, state: State, links: Links, scratch: Scratch) -> int:
    """EACH_TET, WHOLE_STAR and the four-face edges at v into scratch.nodes; returns how many."""
    scratch.nodes[0], scratch.nodes[1], count = EACH_TET, WHOLE_STAR, 2
    _load_bits(v, state.smp, links, scratch)
    # Inside the part both materials have the same boundary.
    for value in (True, False):
        if not value and not links.on_surface[v]:
            break
        _boundary_excess(v, value, links, scratch)
        for node in range(links.n_nodes[v]):
            if scratch.degree[node] > 2 and not _holds(scratch.nodes, count, node):
                scratch.nodes[count] = node
                count += 1
    return count


@_inner
def _holds(values: IntArray, count: int, value: int) -> bool:
    found = False
    for k in range(count):
        found = found or values[k] == value
    return found


@_inner
def _best_move(v: int, step: int, worst: int, state: State, links: Links, scratch: Scratch) -> int:
    """The cheapest flip at v of rank below `worst` into scratch.best; returns its number of tets, 0 if there is none.

    Moves: one tet of the star, one component of the star, one sector around a four-face edge.
    """
    best = (worst, 0.0, 0)
    size = links.star_start[v + 1] - links.star_start[v]
    for i in range(_kinds_of_moves(v, state, links, scratch)):
        _load_bits(v, state.smp, links, scratch)
        _group_tets(v, scratch.nodes[i], links, scratch)
        for k in range(size):
            if scratch.group[k] == k:
                best = _try(v, _gather(v, k, links, scratch), step, best, state, links, scratch)
    return best[2]


@_inner
def _push(v: int, on_top: bool, queue: Queue) -> None:
    if queue.waiting[v]:
        return
    queue.waiting[v] = True
    if not on_top:
        queue.ends[0] = (queue.ends[0] - 1) % len(queue.ring)
    queue.ends[1] += 1
    slot = queue.ends[0] + (queue.ends[1] - 1 if on_top else 0)
    queue.ring[slot % len(queue.ring)] = v


@_inner
def _pop(queue: Queue) -> int:
    queue.ends[1] -= 1
    v = queue.ring[(queue.ends[0] + queue.ends[1]) % len(queue.ring)]
    queue.waiting[v] = False
    return v


@_inner
def _apply(tets: IntArray, step: int, state: State, links: Links, scratch: Scratch, queue: Queue) -> int:
    """Flip `tets`, lock them, and let the defective vertices around wait; returns the change of defects."""
    _flip(tets, state)
    stamp, change = _fresh_stamp(scratch), 0
    for t in tets:
        state.locked_until[t] = step + LOCK_STEPS
        for u in links.vertices[t]:
            if scratch.stamp[u] != stamp:
                scratch.stamp[u] = stamp
                change -= state.defects[u]
                state.defects[u] = vertex_defects(u, state.pinched, state.smp, links, scratch)
                change += state.defects[u]
                if state.defects[u] > 0:
                    _push(u, True, queue)
    return change


@_inner
def _descend(step: int, state: State, links: Links, scratch: Scratch, queue: Queue) -> int:
    """Take improving moves (one-way: any move) at the waiting vertices and at what these touch; returns the step."""
    worst = 1 if state.only[0] == FREE else LIMITLESS
    while queue.ends[1] > 0:
        step += 1
        v = _pop(queue)
        if state.defects[v] > 0:
            count = _best_move(v, step, worst, state, links, scratch)
            if count > 0:
                _apply(scratch.best[:count], step, state, links, scratch, queue)
    return step


@_inner
def _excursion(v: int, step: int, state: State, links: Links, scratch: Scratch, queue: Queue, trail: IntArray) -> bool:
    """Moves that also add defects, at v and at what they spoil: kept once fewer are left, taken back after a while."""
    balance, flipped = 0, 0
    _push(v, True, queue)
    while queue.ends[1] > 0 and flipped + len(scratch.best) <= len(trail):
        step += 1
        u = _pop(queue)
        if state.defects[u] == 0:
            continue
        count = _best_move(u, step, LIMITLESS, state, links, scratch)
        for k in range(count):
            trail[flipped + k] = scratch.best[k]
        flipped += count
        balance += _apply(scratch.best[:count], step, state, links, scratch, queue)
        if balance < 0:
            return True
    for k in range(flipped):
        _apply(trail[k : k + 1], 0, state, links, scratch, queue)
    while queue.ends[1] > 0:
        _pop(queue)
    return False


@njit(cache=True)
def search(state: State, links: Links, scratch: Scratch, queue: Queue, trail: IntArray) -> int:
    """Flip tets until no vertex is defective or none can be helped; returns the defects left.

    trail : work space, as long as the longest excursion
    """
    for v in range(len(state.defects)):
        if state.defects[v] > 0:
            _push(v, True, queue)
    step = _descend(0, state, links, scratch, queue)
    helped = state.only[0] == FREE
    while helped:
        helped = False
        for v in range(len(state.defects)):
            while state.defects[v] > 0:
                step += LOCK_STEPS + len(trail)
                if not _excursion(v, step, state, links, scratch, queue, trail):
                    break
                helped = True
                step = _descend(step + len(trail), state, links, scratch, queue)
    left = 0
    for defects in state.defects:
        left += defects
    return left
