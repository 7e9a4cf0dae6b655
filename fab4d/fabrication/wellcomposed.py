"""Labels whose bodies are solids: at every vertex each material's boundary is one closed cycle around it.

A labelled tet mesh nearly always has edges with four boundary faces and vertices where two cones of one material touch.
Slicers drop or merge such places differently, so the labels are changed there: a local search at each defective vertex
flips the tet, the component of the star, or the sector around an edge that costs least per defect removed. Where
nothing removes a defect, an excursion starts: flips that keep or add some, each locked for some steps, until fewer
defects are left than before or, after a limited number, all of it is taken back. So the defects only fall and the
search ends. What it leaves, if anything, is removed by flips of one label only, which cannot go on for ever either:
at the worst one material is left.
"""

import numpy as np

from fab4d.fabrication._links import Links, links_of, split_fans
from fab4d.fabrication._repair_kernels import FREE, Queue, Scratch, State, all_defects, search
from fab4d.mesh.tetmesh import BoolArray, FloatArray, IntArray

LONGEST_EXCURSION = 50
"""Flips after which moves that added defects are taken back."""


def pinched_vertices(tets: IntArray, smp: BoolArray | None = None) -> IntArray:
    """Vertices (k,) at which the boundary of SMP or of TPE is not one closed cycle; without `smp`, that of the whole.

    tets : (m, 4)        smp : (m,) labels
    """
    links = links_of(tets)
    labels = np.ones(len(tets), bool) if smp is None else np.ascontiguousarray(smp, dtype=bool)
    return np.flatnonzero(all_defects(np.zeros(len(links.n_nodes), bool), labels, links, _scratch(links)))


def well_composed(tets: IntArray, smp: BoolArray, flip_cost: FloatArray) -> BoolArray:
    """Labels (m,) near `smp` without a defect at any vertex where the whole part has none.

    tets : (m, 4)        smp : (m,)        flip_cost : (m,) non-negative cost of changing each tet

    A place where the whole part itself is pinched is no matter of labels: the fans of tets that meet there are made
    well composed each for itself, and around a vertex that is still pinched then all tets become one material.
    """
    links, scratch = link_tables(tets)
    nowhere = np.zeros(len(links.n_nodes), bool)
    pinched = all_defects(nowhere, np.ones(len(tets), bool), links, scratch) > 0
    state = _state(smp, smp, flip_cost, pinched, FREE, links, scratch)
    # Where nothing is to be done the search need not even be compiled.
    if not state.defects.any() or search(state, links, scratch, _queue(links), _trail(scratch)) == 0:
        return state.smp
    return _one_way(state, links, scratch)


def link_tables(tets: IntArray) -> tuple[Links, Scratch]:
    """The tables of the mesh `tets` (m, 4), each fan of tets by itself, and work space for kernels that walk them."""
    links = links_of(split_fans(tets))
    return links, _scratch(links)


def _one_way(state: State, links: Links, scratch: Scratch) -> BoolArray:
    """The cheaper of removing what is left by growing TPE or by growing SMP alone."""
    results = []
    for only in (1, 0):
        trial = _state(state.smp, state.original, state.cost, state.pinched, only, links, scratch)
        search(trial, links, scratch, _queue(links), _trail(scratch))
        results.append(trial.smp)
    return min(results, key=lambda smp: float(state.cost[smp != state.original].sum()))


def _state(
    smp: BoolArray,
    original: BoolArray,
    cost: FloatArray,
    pinched: BoolArray,
    only: int,
    links: Links,
    scratch: Scratch,
) -> State:
    labels = np.array(smp, dtype=bool)
    defects = all_defects(pinched, labels, links, scratch)
    unlocked = np.zeros(len(labels), np.int64)
    original, cost = np.array(original, dtype=bool), np.array(cost, dtype=np.float64)
    return State(labels, original, cost, pinched, defects, unlocked, np.array([only]))


def _scratch(links: Links) -> Scratch:
    size = int(max(np.diff(links.star_start).max(), links.n_nodes.max())) + 1
    sizes = (size, size, size, len(links.n_nodes) + 1, size, size, 2 * size + 2)
    return Scratch(np.zeros(size, bool), *(np.zeros(s, np.int64) for s in sizes))


def _queue(links: Links) -> Queue:
    n = len(links.n_nodes)
    return Queue(np.zeros(n, np.int64), np.zeros(n, bool), np.zeros(2, np.int64))


def _trail(scratch: Scratch) -> IntArray:
    return np.zeros(LONGEST_EXCURSION + len(scratch.best), np.int64)
