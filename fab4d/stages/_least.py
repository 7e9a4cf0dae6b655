"""The least SMP for the goal: other prices of SMP, tried from the first acceptable design on, judged as printed."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from fab4d.design.problem import Problem
from fab4d.design.reduced import ReducedSettings, Search
from fab4d.design.tradeoff import Trial, least, nearest, next_price, search_at
from fab4d.stages._design import Trace
from fab4d.stages._printed import as_printed, faults, smp_share
from fab4d.stages._search import search_arrays, search_from
from fab4d.stages.monitor import Monitor

# What the search for a design keeps of it before rounding: from there the other prices set out.
RELAXED = "relaxed"
PHASE = "less SMP"
# Share of the tolerance that a design with less SMP may use: the last fit still moves the error a little, and a design
# at the limit would be rejected for it.
USABLE_TOLERANCE = 0.9


@dataclass(frozen=True, eq=False)
class LeastSmp:
    """The design with the least SMP that is acceptable, also as it was before rounding, its RMS error as printed in L0,
    and all that was tried."""

    found: Search
    relaxed: Search
    printed_rms: float
    trials: list[dict[str, Any]]


@dataclass(frozen=True, eq=False)
class _Tried:
    trial: Trial
    relaxed: Search
    found: Search
    rms: float
    faults: tuple[str, ...]


@dataclass(frozen=True, eq=False)
class _Bisection:
    """Everything that the trials share."""

    problem: Problem
    mesh: Mapping[str, np.ndarray]
    profile: Mapping[str, Any]
    settings: ReducedSettings
    trace: Trace
    monitor: Monitor

    def tried(self, first: Search) -> list[_Tried]:
        """All trials, beginning with the design `first`; those of an interrupted run are taken from it."""
        saved = self.monitor.restore(RELAXED)
        relaxed = first if saved is None else search_from(self.problem, saved)
        tried = [self.judged(relaxed, first, self.settings.weights.error_scale)]
        while (price := next_price([done.trial for done in tried])) is not None:
            name = f"trial-{len(tried)}"
            kept = self.monitor.restore(name)
            tried.append(self.made(tried, price) if kept is None else self.recalled(kept))
            if kept is None:
                self.monitor.save(name, _arrays(tried[-1], self.trace))
        return tried

    def made(self, tried: Sequence[_Tried], price: float) -> _Tried:
        start = tried[nearest([done.trial.lam_SMP for done in tried], price)].relaxed
        relaxed, found = search_at(self.problem, self.settings, start, price, lambda at: self.trace.add(PHASE, at))
        return self.judged(relaxed, found, USABLE_TOLERANCE * self.settings.weights.error_scale)

    def judged(self, relaxed: Search, found: Search, largest_rms: float) -> _Tried:
        printer, goal, weights = self.profile["printer"], self.profile["goal"], self.settings.weights
        printed = as_printed(self.problem, self.mesh, printer, goal, weights, found, largest_rms)
        reasons = faults(self.problem, self.mesh["tets"], self.profile, found, printed, largest_rms)
        trial = Trial(relaxed.lam_SMP, smp_share(self.problem, printed.smp), not reasons)
        return _Tried(trial, relaxed, found, printed.rms, tuple(reasons))

    def recalled(self, kept: Mapping[str, np.ndarray]) -> _Tried:
        self.trace.go_on(kept["trace"].tobytes())
        lam_SMP, smp_fraction, acceptable, rms = kept["trial"].tolist()
        relaxed, found = (search_from(self.problem, _part(kept, part)) for part in _STATES)
        trial = Trial(lam_SMP, smp_fraction, bool(acceptable))
        return _Tried(trial, relaxed, found, rms, tuple(kept["faults"].tolist()))


def least_smp(
    problem: Problem,
    mesh: Mapping[str, np.ndarray],
    profile: Mapping[str, Any],
    settings: ReducedSettings,
    first: Search,
    trace: Trace,
    monitor: Monitor,
) -> LeastSmp:
    """Bisect the price of SMP, beginning at that of the design `first`; every trial is kept for a run that goes on.

    Without an acceptable design to begin with, it is `first`.
    """
    tried = _Bisection(problem, mesh, profile, settings, trace, monitor).tried(first)
    best = tried[least([done.trial for done in tried])] if tried[0].trial.acceptable else tried[0]
    return LeastSmp(best.found, best.relaxed, best.rms, [_row(problem, done) for done in tried])


def _row(problem: Problem, done: _Tried) -> dict[str, Any]:
    rms_mm = done.rms * problem.length if np.isfinite(done.rms) else None
    return asdict(done.trial) | {"rms_mm": rms_mm, "reasons": list(done.faults)}


_STATES = ("relaxed", "found")


def _arrays(done: _Tried, trace: Trace) -> dict[str, np.ndarray]:
    """A trial with both its states, each under its own prefix."""
    states = {part: search_arrays(getattr(done, part)) for part in _STATES}
    return {f"{part}_{name}": value for part, state in states.items() for name, value in state.items()} | {
        "trial": np.array([done.trial.lam_SMP, done.trial.smp_fraction, done.trial.acceptable, done.rms]),
        "faults": np.array(done.faults, dtype=np.str_),
        "trace": np.frombuffer(trace.csv(), np.uint8),
    }


def _part(kept: Mapping[str, np.ndarray], part: str) -> dict[str, np.ndarray]:
    return {name.removeprefix(f"{part}_"): value for name, value in kept.items() if name.startswith(f"{part}_")}
