"""Study `tradeoff`: designs with several numbers of points and prices of SMP, each judged as it will be printed."""

import json
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from fab4d.design.problem import Problem
from fab4d.design.reduced import ReducedSettings, Search, first_design
from fab4d.design.tradeoff import nearest, search_at
from fab4d.errors import EquilibriumError, SceneError
from fab4d.report.metrics import mass_and_cost
from fab4d.report.tradeoff import tradeoff_csv, tradeoff_plot
from fab4d.stages._design import Trace, problem_of, tau_seconds
from fab4d.stages._printed import Printed, as_printed, faults, smp_share
from fab4d.stages._search import search_arrays, search_from
from fab4d.stages.monitor import Monitor
from fab4d.stages.solve import search_settings

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
            study.chain(count, sorted(set(prices), key=lambda price: abs(np.log(price))))
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


@dataclass(frozen=True, eq=False)
class _Made:
    """A row with the price of its relaxed design, from which its neighbours set out."""

    price: float
    relaxed: Search


class _Study:
    """What the rows share."""

    def __init__(self, mesh: Mapping[str, np.ndarray], profile: Mapping[str, Any], monitor: Monitor) -> None:
        self.mesh, self.profile, self.monitor = mesh, profile, monitor
        self.problem: Problem = problem_of(mesh, profile["materials"], "linear")
        # The curve goes beyond the share of SMP at which a single search turns back.
        limit = profile["goal"].max_smp_fraction
        usual = search_settings(self.problem, profile)
        self.settings = replace(usual, max_smp_fraction=1.0 if limit is None else limit)
        self.sections = {name: profile[name] for name in ("rig", "goal", "acceptance")}
        monitor.progress("compile, measure tau")
        self.tau_s = tau_seconds(self.problem)

    def kept_rows(self) -> list[Row]:
        """All rows that were ever made for these inputs, by points and price."""
        rows = [json.loads(str(self._kept(name)["row"])) for name in self._names()]
        return sorted(rows, key=lambda row: (row["points"], row["lam_SMP"]))

    def chain(self, count: int, prices: Sequence[float]) -> None:
        """The rows of one number of points; the first is searched from the start, the others from their neighbours."""
        settings, made = replace(self.settings, n_points=count), []
        for price in prices:
            name = f"{count}x{price:g}"
            if name in self._names():
                made.append(_Made(price, self._recalled(self._kept(name))))
            else:
                made.append(_Made(price, self._row(name, settings, price, made)))

    def _row(self, name: str, settings: ReducedSettings, price: float, made: Sequence[_Made]) -> Search:
        """Make and keep the row; returns its relaxed design."""
        began, trace = time.perf_counter(), Trace(self.problem, self.mesh, self.monitor, self.tau_s)
        lam_SMP = price * settings.weights.lam_SMP
        start = (
            made[nearest([other.price for other in made], price)].relaxed
            if made
            else Search(*first_design(self.problem, settings))
        )
        relaxed, found = search_at(self.problem, settings, start, lam_SMP, lambda at: trace.add(name, at))
        self.monitor.progress(f"{name} as printed")
        printed = as_printed(
            self.problem, self.mesh, self.profile["printer"], self.profile["goal"], settings.weights, found
        )
        row = self._figures(settings, found, printed) | {"id": name, "lam_SMP": lam_SMP}
        row["tau"] = (time.perf_counter() - began) / self.tau_s
        self._keep(name, row, relaxed, found)
        return relaxed

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

    def _keep(self, name: str, row: Row, relaxed: Search, found: Search) -> None:
        """The design under the names that stage solve reads, the relaxed one beside it."""
        beside = {f"relaxed_{key}": value for key, value in search_arrays(relaxed).items()}
        self.monitor.save(name, search_arrays(found) | beside | {"row": np.array(json.dumps(row))})
        self.monitor.save(INDEX, {"names": np.array([*self._names(), name], dtype=np.str_)})

    def _names(self) -> list[str]:
        index = self.monitor.restore(INDEX)
        return [] if index is None else index["names"].tolist()

    def _kept(self, name: str) -> dict[str, np.ndarray]:
        kept = self.monitor.restore(name)
        assert kept is not None  # it is in the index
        return kept

    def _recalled(self, kept: Mapping[str, np.ndarray]) -> Search:
        relaxed = {key.removeprefix("relaxed_"): value for key, value in kept.items() if key.startswith("relaxed_")}
        return search_from(self.problem, self.profile["rig"], relaxed)


def _largest(forces: np.ndarray) -> float:
    return float(np.linalg.norm(forces, axis=1).max(initial=0.0))
