"""Other points for the search to begin with, where those spread over the body nearly meet the tolerance."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np

from fab4d.design.problem import Problem
from fab4d.design.reduced import Phase, ReducedSettings, Search, Watch, relaxed
from fab4d.design.starts import BEGINNINGS, beginnings
from fab4d.errors import EquilibriumError
from fab4d.materials.cards import MaterialCard
from fab4d.mesh.tetmesh import IntArray
from fab4d.stages._coarse import coarse_of
from fab4d.stages._design import Trace
from fab4d.stages._search import search_arrays, search_from
from fab4d.stages.monitor import Monitor

FIRST, CENTERS = "first", "centers"
NO_OTHERS = {CENTERS: np.zeros(0, np.int64)}
# Other points may win some 10 %: they are not tried where the tolerance is missed by more than this factor.
NEARLY = 1.5
# Larger meshes are coarsened for it: there each beginning takes seconds, and what is better on them is so on all.
# Nothing is compared where thin walls keep more tets than that, or the usual points have no equilibrium there.
LARGE_TETS, START_TETS = 12_000, 6_000
# Another beginning is taken where it leads to an error below the first share of the usual one's. An error below the
# second share of the tolerance ends the search.
BETTER, WELL_BELOW = 0.97, 0.85


@dataclass(frozen=True, eq=False)
class Starts:
    """What the search for other points needs.

    settings_of : of the solver, for a problem        most : sets of random points that are tried
    """

    problem: Problem
    mesh: Mapping[str, np.ndarray]
    materials: MaterialCard
    settings_of: Callable[[Problem], ReducedSettings]
    trace: Trace
    monitor: Monitor
    most: int = BEGINNINGS

    def chosen(self) -> IntArray | None:
        """The centers (K,) that were found to be better than those of the settings, or None."""
        saved = self.monitor.restore(CENTERS)
        return saved[CENTERS] if saved is not None and len(saved[CENTERS]) else None

    def best(self, at: Search, watch: Watch) -> Search:
        """The better one of the relaxed design `at` and that from other points, if it is worth looking for those.

        at : may be the one from other points already, where an interrupted run goes on
        """
        settings = self.settings_of(self.problem)
        limit = settings.weights.error_scale
        if at.phase is not Phase.ROUND or at.iteration or not limit < at.relaxed_rms <= NEARLY * limit:
            return at
        saved = self.monitor.restore(FIRST)
        if saved is None:
            self.monitor.save(FIRST, search_arrays(at))
        first = at if saved is None else search_from(self.problem, saved)
        if not np.array_equal(at.design.rho, first.design.rho):
            return self._lower(first, at, watch)
        if self.monitor.restore(CENTERS) is None:
            self.monitor.save(CENTERS, self._search(first.relaxed_rms))
        return first if self.chosen() is None else self._lower(first, self._from_chosen(settings, watch), watch)

    def _from_chosen(self, settings: ReducedSettings, watch: Watch) -> Search:
        """The relaxed design from the chosen points; where it was found on the same mesh, it is relaxed further."""
        kept = self.monitor.restore(CENTERS)
        assert kept is not None  # there are chosen points
        start = None
        if kept.keys() > {CENTERS}:
            start = replace(search_from(self.problem, kept), phase=Phase.RELAX, iteration=0, slow=0)
            watch(start)
        return relaxed(self.problem, replace(settings, centers=kept[CENTERS]), watch, start)

    def _lower(self, first: Search, other: Search, watch: Watch) -> Search:
        if other.relaxed_rms < first.relaxed_rms:
            return other
        self.monitor.save(CENTERS, NO_OTHERS)
        # Shown again, without a row of its own: it is what the rest sets out from.
        watch(replace(first, accepted=False))
        return first

    def _search(self, usual: float) -> Mapping[str, np.ndarray]:
        """The relaxed design that is lower than that of the usual points, which is at `usual`, as `search_arrays`.

        Of one that was found on a coarser mesh, only its centers (K,); NO_OTHERS if there is none.
        """
        problem, told, vertices = self.problem, self.trace, np.arange(len(self.mesh["X"]))
        large = problem.n_tets > LARGE_TETS
        if large:
            coarse = coarse_of(problem, self.mesh, self.materials, START_TETS)
            problem, vertices = coarse.level.coarse, coarse.level.vertices
            told = told.on(problem, coarse.mesh)
        if problem.n_tets > LARGE_TETS:
            return NO_OTHERS
        # Steps past unstable states are for the one that is taken.
        settings = replace(self.settings_of(problem), nearly=1.0)

        def watch(at: Search) -> None:
            told.add("other points", at)

        if large:
            try:
                usual = relaxed(problem, settings, watch).relaxed_rms
            except EquilibriumError:
                return NO_OTHERS
        found, least = NO_OTHERS, BETTER * usual
        for at in beginnings(problem, settings, watch, self.most):
            if at.relaxed_rms < least:
                centers = {CENTERS: vertices[at.equilibria.patches.centers]}
                found, least = centers if large else search_arrays(at), at.relaxed_rms
            if least <= WELL_BELOW * settings.weights.error_scale:
                break
        return found
