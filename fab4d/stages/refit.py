"""Stage `refit`: the held positions that are best for the labels that will be printed."""

from collections.abc import Iterable, Mapping
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from fab4d.design.equilibria import Equilibria
from fab4d.design.finish import carried_in, kept_clear
from fab4d.design.flips import FlipSettings
from fab4d.design.forward import Programming
from fab4d.design.gauss_newton import Design
from fab4d.design.objective import ObjectiveWeights
from fab4d.design.patches import patches_from_faces
from fab4d.design.polish import polish_labels
from fab4d.design.problem import Problem
from fab4d.design.reduced import Search, polished, refit
from fab4d.fabrication.labels import smp_clusters
from fab4d.mesh.measures import tet_volumes
from fab4d.mesh.tetmesh import BoolArray
from fab4d.stages._bring_up import OUT_OF_REACH
from fab4d.stages._coarse import MANY_TETS
from fab4d.stages._design import Trace, objective_weights, patch_arrays, patches_of, problem_of, tau_seconds
from fab4d.stages._element import Elements, element_of, elements_for
from fab4d.stages._fit import Fit, Polish, not_reached, other_fit, reachable_fit
from fab4d.stages._flips import FEW_ROUNDS, fit_flips
from fab4d.stages._limits import limit_reasons
from fab4d.stages._renewed import renewed
from fab4d.stages._ways import Way, loaded_from_rest, rms_of, ways_to_print
from fab4d.stages.monitor import Monitor

# Squeezed surfaces count for less than in the search: what that kept from the limit of their stability, labels that are
# 0 or 1 take up, and positions that made up for it would miss the temporary shape by more.
LEAST_STRETCH, LAM_SQUEEZE = 0.5, 1000.0
# A design that misses the tolerance by far is rejected whatever elements tell of it, and quadratic ones, where it is
# hard to hold, take minutes for that.
NOT_QUADRATIC = {"what": "quadratic elements", "why": "the design misses the tolerance by far in linear ones"}


def run(inputs: Mapping[str, Any], profile: Mapping[str, Any], monitor: Monitor) -> dict[str, Any]:
    """Follow the relaxed design to the printed labels and fit the held positions, in a state that loading reaches."""
    wanted = profile["solver"].element
    elements = elements_for(inputs["mesh"], wanted)
    if wanted == "auto" and elements.last_fit == "quadratic" and _missed_by_far(inputs, profile):
        linear = Elements("linear", "linear", [NOT_QUADRATIC])
        found, met = _fitted_in(linear, inputs, profile, monitor)
        if not met:
            return found
    return _fitted_in(elements, inputs, profile, monitor)[0]


def _missed_by_far(inputs: Mapping[str, Any], profile: Mapping[str, Any]) -> bool:
    """Whether the design was found in linear elements, and misses the tolerance by far there."""
    mesh, relaxed = inputs["mesh"], inputs["relaxed"]
    if element_of(mesh, relaxed["x"]) != "linear":
        return False
    problem = problem_of(mesh, profile["materials"], "linear")
    weights = objective_weights(problem, profile["goal"], profile["weights"], profile["rig"], profile["materials"])
    return float(relaxed["relaxed_rms"]) / problem.length > OUT_OF_REACH * weights.error_scale


def _fitted_in(
    elements: Elements, inputs: Mapping[str, Any], profile: Mapping[str, Any], monitor: Monitor
) -> tuple[dict[str, Any], bool]:
    """What the stage writes, with the last fit in these elements, and whether that meets the tolerance."""
    mesh, smp = inputs["mesh"], inputs["rounded"]["smp"]
    rounding = problem = problem_of(mesh, profile["materials"], elements.rounding)
    if elements.last_fit != elements.rounding:
        problem = problem_of(mesh, profile["materials"], elements.last_fit)
    tau_s = tau_seconds(problem)
    trace = Trace(problem, mesh, monitor, tau_s)
    weights = objective_weights(problem, profile["goal"], profile["weights"], profile["rig"], profile["materials"])
    weights = weights.replace(least_stretch=LEAST_STRETCH, lam_squeeze=LAM_SQUEEZE)
    relaxed_rms = float(inputs["relaxed"]["relaxed_rms"]) / problem.length
    settings = fit_flips(rounding, mesh, profile["printer"], profile["goal"], relaxed_rms, weights.error_scale)
    fit = _fitted(rounding, problem, inputs["relaxed"], smp, weights, settings, trace)
    fit = replace(fit, design=polished(fit.equilibria, fit.design))
    trace.add("refit", Search(fit.equilibria, fit.design))
    report = {
        "tau_s": tau_s,
        "fits": fit.fits,
        "flipped_fraction": float(problem.volume_fractions[(fit.design.rho > 0.5) != smp].sum()),
        "reasons": limit_reasons(problem, fit.equilibria.patches, fit.design, profile) + not_reached(fit, weights),
        "left_out": elements.left_out,
    }
    found = _fit_arrays(problem, mesh, fit) | {"refit_report": report, "refit_trace": trace.csv()}
    return found, fit.rms <= weights.error_scale


def _fitted(
    rounding: Problem,
    problem: Problem,
    relaxed: Mapping[str, np.ndarray],
    smp: BoolArray,
    weights: ObjectiveWeights,
    settings: FlipSettings,
    trace: Trace,
) -> Fit:
    """Labels near the printable ones smp (m,), and the held positions that go best with them.

    rounding, problem : the part in the elements in which labels are flipped, and in those of the last fit
    """
    flips_last, free = rounding.n_tets > MANY_TETS, weights
    if flips_last:
        weights = kept_clear(weights)
    equilibria = Equilibria(rounding, patches_of(rounding, relaxed))
    begin = ways_to_print(equilibria, relaxed, smp, weights, settings)
    polish = _polish(weights, replace(settings, rounds=0) if flips_last else settings, trace)
    design = _best_flipped(equilibria, begin, polish, settings, trace)
    if not equilibria.patches.count:
        return Fit(equilibria, design)
    radius = float(relaxed["patch_radius"]) / problem.length
    if not flips_last:
        design = renewed(equilibria, design, radius, weights, settings, polish, trace)
    if problem is not rounding:
        carried = _in_elements_of(problem, Search(equilibria, design))
        trace.add("carried over", carried)
        polish = _polish(weights, replace(settings, target_rms=weights.error_scale, rounds=FEW_ROUNDS), trace)
        equilibria, design = carried.equilibria, polish(carried.equilibria, carried.design)
    fit = reachable_fit(equilibria, design, weights, radius, polish, trace)
    if flips_last and fit.rms > weights.error_scale:
        weights = free
        fit = other_fit(fit, weights, radius, _polish(weights, replace(settings, rounds=0), trace), trace)
    if flips_last and fit.rms > settings.target_rms:
        fit = other_fit(fit, weights, radius, _polish(weights, settings, trace), trace)
    return fit


def _best_flipped(
    equilibria: Equilibria, begin: Iterable[Way], polish: Polish, settings: FlipSettings, trace: Trace
) -> Design:
    """The best of the designs that flips make of those to `begin` with, the first that comes to the goal.

    Without points there are no held positions to follow flips, and the first is as good as any.
    """
    ends = list[Design]()
    for printed in begin:
        trace.add("printed", Search(equilibria, printed.design))
        trace.add("refit", Search(equilibria, printed.fitted))
        if not equilibria.patches.count:
            return printed.fitted
        ends.append(polish(equilibria, printed.fitted))
        if rms_of(equilibria, ends[-1]) <= settings.target_rms:
            break
    return min(ends, key=partial(rms_of, equilibria))


def _fit_arrays(problem: Problem, mesh: Mapping[str, np.ndarray], fit: Fit) -> dict[str, Any]:
    """The artifacts `labels`, `printed` and `loaded`, in mm and N; no `loaded` where no loading went all the way."""
    design, L0, smp = fit.design, problem.length, fit.design.rho > 0.5
    shapes = {"x": design.median.x * L0, "y": design.final.y * L0}
    clusters = smp_clusters(mesh["tets"], tet_volumes(mesh["X"], mesh["tets"]), smp)
    return {
        "labels": {"smp": smp, "cluster": clusters},
        "printed": shapes | patch_arrays(problem, fit.equilibria.patches, design),
        "loaded": None if fit.loading is None else _loaded_arrays(fit.loading, problem),
    }


def _loaded_arrays(reached: Programming, problem: Problem) -> dict[str, np.ndarray]:
    """The `loaded` artifact: the end of the simulated loading, in mm and N."""
    median, L0 = reached.median, problem.length
    return {
        "x": median.x * L0,
        "y": reached.final.y * L0,
        "patch_force": median.forces * problem.force,
        "load_steps": np.array(reached.load_steps),
    }


def _polish(weights: ObjectiveWeights, settings: FlipSettings, trace: Trace) -> Polish:
    """A function that fits held positions, and flips labels as long as that brings the temporary shape nearer."""

    def polish(equilibria: Equilibria, design: Design) -> Design:
        fitted = refit(equilibria, design, weights, lambda at: trace.add("refit", at))
        return polish_labels(equilibria, fitted, weights, settings, lambda at: trace.add("flips", at))

    return polish


def _in_elements_of(problem: Problem, at: Search) -> Search:
    """A design in other elements of the same mesh: near it, or where loading from rest ends."""
    carried = carried_in(problem, at)
    if carried is not None:
        return carried
    patches, median = at.equilibria.patches, at.design.median
    equilibria = Equilibria(problem, patches_from_faces(problem, patches.centers, patches.faces, patches.offsets))
    design = loaded_from_rest(equilibria, at.design.rho, median.x, median.forces)
    return replace(at, equilibria=equilibria, design=design)
