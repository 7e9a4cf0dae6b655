"""Flips of tets that together lower an error most and pinch nothing, or mend what is pinched.

One flip after the other, each for the better, soon finds none that is allowed: most would pinch the boundary where they
are, and others are needed first that make the error larger. Simulated annealing takes these too, the more rarely the
lower the temperature (Kirkpatrick, Gelatt, Vecchi, Science 220 (1983) 671). On the way the boundary is pinched where
that brings much, for others to mend; what is found is pinched no more than at first.
"""

from collections.abc import Callable
from copy import deepcopy
from functools import partial
from operator import itemgetter
from typing import Protocol

import numpy as np

from fab4d.fabrication._annealing_kernels import Candidates, Squares, anneal
from fab4d.fabrication.features import tet_neighbours
from fab4d.fabrication.wellcomposed import link_tables
from fab4d.mesh.tetmesh import BoolArray, FloatArray, IntArray
from fab4d.solvers.threads import side_by_side

# First temperatures, one for each annealing, and the last, in squared errors of the labels to begin with. Where each
# flip changes much, only hot ones leave a valley; where each changes little, these go astray.
HOT, COLD = (3e-3, 1e-2, 3e-2), 1e-5
# What each pinched place costs on the way, in first temperatures: for less too many are left in the end, for more few
# flips are made that others have to follow.
PINCHED = 6.0
# More steps than these take minutes.
MOST_STEPS = 20_000_000


class Energy(Protocol):
    """|error + sum of changes|^2 + |positive part of beyond + sum of limit_changes|^2 + doubts + prices, of flips of
    tets (k,).

    error (p,), changes (k, p) : of a shape        beyond (l,), limit_changes (k, l) : of limits that it should keep
    doubts (k,) : what a flip costs for not being known exactly; less than 0 for one that takes such a cost away
    price, defect_price : of each flip, and of each defect of the boundary that is left
    """

    @property
    def tets(self) -> IntArray: ...
    @property
    def error(self) -> FloatArray: ...
    @property
    def changes(self) -> FloatArray: ...
    @property
    def beyond(self) -> FloatArray: ...
    @property
    def limit_changes(self) -> FloatArray: ...
    @property
    def doubts(self) -> FloatArray: ...
    @property
    def price(self) -> float: ...
    @property
    def defect_price(self) -> float: ...


# Of labels (m,), the energy of flips, the volume that may become SMP, steps of each annealing for each tet, and a seed.
Annealed = Callable[[BoolArray, Energy, float, int, int], BoolArray]


def annealer(tets: IntArray, volumes: FloatArray) -> Annealed:
    """A function that finds the labels (m,) of least energy near given ones, the boundary pinched no more than there.

    The tables of the mesh `tets` (m, 4) are built once. volumes (m,)
    """
    links, scratch = link_tables(tets)
    neighbours = tet_neighbours(tets)

    def annealed(labels: BoolArray, energy: Energy, room: float, steps: int, seed: int) -> BoolArray:
        candidates = _candidates(energy.tets, neighbours, volumes)
        squares = _squares(energy)
        start = float(energy.error @ energy.error + (np.maximum(energy.beyond, 0) ** 2).sum()) or 1.0
        most = min(steps * len(energy.tets), MOST_STEPS)

        def from_temperature(hot: float, random: np.random.Generator) -> tuple[float, BoolArray]:
            changed = squares._replace(error=squares.error.copy(), beyond=squares.beyond.copy())
            temperatures = hot * start, COLD * start
            prices = energy.price + energy.doubts, energy.defect_price, PINCHED * hot * start
            work = deepcopy(scratch)
            return anneal(labels.copy(), candidates, changed, prices, room, temperatures, most, random, links, work)

        found = side_by_side([partial(from_temperature, hot, np.random.default_rng(seed)) for hot in HOT], 0)
        _, flipped = min(found, key=itemgetter(0))
        result = labels.copy()
        result[energy.tets[flipped]] ^= True
        return result

    return annealed


def _candidates(tets: IntArray, neighbours: IntArray, volumes: FloatArray) -> Candidates:
    # The last place stands for the neighbour across the surface.
    place = np.full(len(neighbours) + 1, -1)
    place[tets] = np.arange(len(tets))
    return Candidates(tets, neighbours[tets], place[neighbours[tets]], volumes[tets])


def _squares(energy: Energy) -> Squares:
    changes = np.ascontiguousarray(energy.changes, dtype=np.float64)
    own = np.einsum("kp,kp->k", changes, changes)
    limit_changes = np.ascontiguousarray(energy.limit_changes, dtype=np.float64)
    return Squares(energy.error, changes, own, energy.beyond, limit_changes)
