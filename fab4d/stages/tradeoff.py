"""Study `tradeoff`: designs with several numbers of points and prices of SMP, each judged as it will be printed."""

import json
import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from fab4d.design.problem import Problem
from fab4d.design.reduced import ReducedSettings, Search, Watch, first_search, solve_reduced
from fab4d.design.tradeoff import relaxed_at, way_to
from fab4d.errors import EquilibriumError, SceneError
from fab4d.report.metrics import mass_and_cost
from fab4d.report.tradeoff import tradeoff_csv, tradeoff_plot
from fab4d.stages._design import Trace, problem_of, tau_seconds
from fab4d.stages._printed import Printed, as_printed, faults, smp_share
from fab4d.stages._search import search_arrays, search_from
from fab4d.stages._settings import search_settings
from fab4d.stages.monitor import Monitor

# Multiples of the usual price of SMP.
PRICES = (0.25, 0.5, 1.0, 2.0, 4.0, 8.0)
INDEX = "index"

Row = dict[str, Any]


def run(
    inputs: Mapping[str, Any],
    profile: Mapping[str, Any],
    monitor: Monitor,
    points: Sequence[int] | None = None,
    prices: Sequence[float] = PRICES,
) -> dict[str, Any]:
    """A row for each number of points and each price; rows that the monitor kept are not computed again.

    points : None for half, three quarters and all of the points that the goal allows
    prices : multiples of the lam_SMP that stage solve uses
    Raises SceneError for a scene without anything to trade, EquilibriumError when no number of points has a design.
    """
    study = _Study(inputs["mesh"], profile, monitor)
    _refuse(inputs, profile, study.settings)
    unmade = []
    for count in sorted(set(points or usual_points(study.settings.n_points))):
        try:
            for price in sorted(set(prices), key=lambda price: abs(np.log(price))):
                study.make(count, price)
        except EquilibriumError as error:
            unmade.append(f"{count} points: {error}")
    rows = study.kept_rows()
    if not rows:
        raise EquilibriumError("; ".join(unmade))
    tolerance = study.settings.weights.error_scale * study.problem.length
    return {
        "tradeoff_csv": tradeoff_csv(rows),
        "tradeoff_plot": tradeoff_plot(rows, tolerance),
        "tradeoff_report": {"tolerance_mm": tolerance, "tau_s": study.tau_s, "without_a_design": unmade},
    }


def usual_points(most: int) -> list[int]:
    """Half, three quarters and all of `most` points."""
    return sorted({-(-most * quarters // 4) for quarters in (2, 3, 4)})


def _refuse(inputs: Mapping[str, Any], profile: Mapping[str, Any], settings: ReducedSettings) -> None:
    if inputs["check_report"]["nothing_to_program"]:
        msg = "the temporary shape is the permanent one, moved rigidly: there is nothing to trade SMP for"
        raise SceneError(msg)
    if settings.weights.lam_SMP == 0 or profile["weights"].lam_force is not None:
        msg = "[weights]: a tradeoff multiplies lam_SMP, which must be above 0, and takes no lam_force: leave them out"
        raise SceneError(msg)


class _Study:
    """What the rows share."""

    def __init__(self, mesh: Mapping[str, np.ndarray], profile: Mapping[str, Any], monitor: Monitor) -> None:
        self.mesh, self.profile, self.monitor = mesh, profile, monitor
        self.problem: Problem = problem_of(mesh, profile["materials"], "linear")
        self.settings = search_settings(self.problem, profile)
        self.sections = {name: profile[name] for name in ("rig", "goal", "acceptance")}
        monitor.progress("compile, measure tau")
        self.tau_s = tau_seconds(self.problem)

    def kept_rows(self) -> list[Row]:
        """All rows that were ever made for these inputs, by points and price."""
        kept = [self.monitor.restore(name) for name in self._names()]
        rows = [json.loads(str(arrays["row"])) for arrays in kept if arrays is not None]
        return sorted(rows, key=lambda row: (row["points"], row["lam_SMP"]))

    def make(self, count: int, price: float) -> None:
        """Make and keep the row of a number of points and a price, if there is none."""
        name, settings = _name(count, price), self._settings(count, price)
        if name in self._names():
            return
        began, trace = time.perf_counter(), Trace(self.problem, self.mesh, self.monitor, self.tau_s)

        def watch(at: Search) -> None:
            trace.add(name, at)

        found = solve_reduced(self.problem, settings, watch, self._relaxed(settings, price, watch))
        self.monitor.progress(f"{name} as printed")
        printer, goal = self.profile["printer"], self.profile["goal"]
        printed = as_printed(self.problem, self.mesh, printer, goal, settings.weights, found)
        row = self._figures(settings, found, printed) | {"id": name, "lam_SMP": price * settings.weights.lam_SMP}
        row["tau"] = (time.perf_counter() - began) / self.tau_s
        self.monitor.save(name, search_arrays(found) | {"row": np.array(json.dumps(row))})
        self.monitor.save(INDEX, {"names": np.array([*self._names(), name], dtype=np.str_)})

    def _settings(self, count: int, price: float) -> ReducedSettings:
        """Those of stage solve, but where SMP is cheaper than usual, more of it than usual may be used."""
        limit = self.profile["goal"].max_smp_fraction
        if price < 1 and limit is None:
            return replace(self.settings, n_points=count, max_smp_fraction=1.0)
        return replace(self.settings, n_points=count)

    def _relaxed(self, settings: ReducedSettings, price: float, watch: Watch) -> Search:
        """The relaxed design, reached over the same prices whatever rows there are: a row hangs on nothing else."""
        at = None
        for way in way_to(price):
            name = f"relaxed-{_name(settings.n_points, way)}"
            kept = self.monitor.restore(name)
            if kept is None:
                start = at or first_search(self.problem, settings)
                at = relaxed_at(self.problem, settings, start, way * settings.weights.lam_SMP, watch)
                self.monitor.save(name, search_arrays(at))
            else:
                at = search_from(self.problem, kept)
        assert at is not None  # every way has a beginning
        return at

    def _figures(self, settings: ReducedSettings, found: Search, printed: Printed) -> Row:
        problem, design = self.problem, printed.design
        mass, cost = mass_and_cost(self.mesh, printed.smp, self.profile["materials"])
        tolerance = settings.weights.error_scale
        reasons = faults(problem, self.mesh["tets"], self.sections, found, printed, tolerance)
        return {
            "points": found.equilibria.patches.count,
            "smp_fraction": smp_share(problem, printed.smp),
            "cost_usd": cost,
            "mass_g": mass,
            "rms_mm": None if design is None else printed.rms * problem.length,
            "rms_rel": None if design is None else printed.rms,
            "max_force_N": None if design is None else _largest(design.median.forces) * problem.force,
            "acceptable": not reasons,
            "reasons": reasons,
        }

    def _names(self) -> list[str]:
        index = self.monitor.restore(INDEX)
        return [] if index is None else index["names"].tolist()


def _name(count: int, price: float) -> str:
    return f"{count}x{price:g}"


def _largest(forces: np.ndarray) -> float:
    return float(np.linalg.norm(forces, axis=1).max(initial=0.0))
