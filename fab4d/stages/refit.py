"""Stage `refit`: the held positions that are best for the labels that will be printed."""

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from fab4d.design.equilibria import Equilibria
from fab4d.design.exchange import held_apart
from fab4d.design.finish import carried_in, carried_over, kept_clear
from fab4d.design.flips import FlipSettings, compensated, error_left, mended, predicted
from fab4d.design.forward import Programming, program, same_shape
from fab4d.design.gauss_newton import Ahead, Design, build_model
from fab4d.design.influence import Influence
from fab4d.design.objective import ObjectiveWeights, shape_error, smoothness_matrix
from fab4d.design.patches import Patches, outward_normals, patches_from_faces
from fab4d.design.paths import SMALLEST_STEP, change_density, follow_density
from fab4d.design.polish import polish_labels
from fab4d.design.problem import Problem, at_nodes
from fab4d.design.reduced import Search, polished, refit
from fab4d.errors import EquilibriumError
from fab4d.fabrication.annealing import annealer
from fab4d.fabrication.labels import smp_clusters
from fab4d.io.scene import Goal, PrinterCard
from fab4d.mesh.measures import tet_volumes
from fab4d.mesh.tetmesh import BoolArray, FloatArray
from fab4d.stages._bring_up import OUT_OF_REACH
from fab4d.stages._coarse import MANY_TETS
from fab4d.stages._design import Trace, objective_weights, patch_arrays, patches_of, problem_of, tau_seconds
from fab4d.stages._element import Elements, element_of, elements_for
from fab4d.stages._repair import influence_near
from fab4d.stages.monitor import Monitor
from fab4d.stages.threshold import labels_for

# How often the held positions are fitted again after the loading has found another equilibrium than the fit.
MOST_FITS = 3
# Labels are flipped until the error is at most this multiple of that of the relaxed design, and meets the tolerance if
# that design comes within the same multiple of it.
ALLOWED_LOSS = 1.15
# A round of flips takes minutes on more than MANY_TETS: there held positions are first fitted to where loading ends,
# clear of unstable states unless they miss the tolerance there, and flips end at this share of the tolerance, or after
# a few. So they do where the relaxed design is out of reach of the tolerance, and in quadratic elements that are too
# many to round in: there the first is the tolerance itself.
GOOD_ENOUGH, FEW_ROUNDS = 0.5, 5
# At this share of the tolerance flips end with the first round that gains little; with more than MANY_DOFS unknowns,
# where each round takes about a minute, at the tolerance.
LOW_ERROR, MANY_DOFS = 0.15, 40_000
# Some rounds of flips bring a design from up to this multiple of the error at which they end there.
WITHIN_REACH = 1.25
# Printed labels are compared after so many steps of the held positions: before them the error tells little.
FEW_STEPS = 3
# Errors that are predicted for printed labels differ from what comes of them by up to this factor more for one than for
# another.
CLEARLY_WORSE = 1.1
# What is predicted beyond this multiple of the error before is as likely a failure of the prediction.
NOT_TRUE = 3.0
# Where the best labels, fitted, err by more than this multiple of the least error predicted, others may be better than
# predicted: of a thin limb, flips that each do little together take what holds it.
FAR_FROM_TRUE = 2.0
# Squeezed surfaces count for less than in the search: what that kept from the limit of their stability, labels that are
# 0 or 1 take up, and positions that made up for it would miss the temporary shape by more.
LEAST_STRETCH, LAM_SQUEEZE = 0.5, 1000.0
# Share of the way to labels that are hard to come to that a step may come down to.
PATIENT_STEP = 1e-3
# Of up to so many tets each counts, and where flips end is chance: they begin again from other labels there, as long
# as they do not reach the goal, for that takes seconds.
FEW_TETS = 1_000
# A design that misses the tolerance by far is rejected whatever elements tell of it, and quadratic ones, where it is
# hard to hold, take minutes for that.
NOT_QUADRATIC = {"what": "quadratic elements", "why": "the design misses the tolerance by far in linear ones"}
Polish = Callable[[Equilibria, Design], Design]


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
    mesh, relaxed, rounded = inputs["mesh"], inputs["relaxed"], inputs["rounded"]
    rounding = problem = problem_of(mesh, profile["materials"], elements.rounding)
    if elements.last_fit != elements.rounding:
        problem = problem_of(mesh, profile["materials"], elements.last_fit)
    equilibria = Equilibria(rounding, patches_of(rounding, relaxed))
    tau_s = tau_seconds(problem)
    trace = Trace(problem, mesh, monitor, tau_s)
    weights = objective_weights(problem, profile["goal"], profile["weights"], profile["rig"], profile["materials"])
    free = weights = weights.replace(least_stretch=LEAST_STRETCH, lam_squeeze=LAM_SQUEEZE)
    flips_last = rounding.n_tets > MANY_TETS
    if flips_last:
        weights = kept_clear(weights)
    settings = _flip_settings(inputs, profile, rounding, weights)
    begin = _printed_designs(equilibria, relaxed, rounded["smp"], weights, settings)
    polish = _polish(weights, replace(settings, rounds=0) if flips_last else settings, trace)
    design = _best_flipped(equilibria, begin, polish, settings, trace)
    fit = _Fit(equilibria, design)
    if equilibria.patches.count:
        radius = float(relaxed["patch_radius"]) / problem.length
        if problem is not rounding:
            carried = _in_elements_of(problem, Search(equilibria, design))
            trace.add("carried over", carried)
            polish = _polish(weights, replace(settings, target_rms=weights.error_scale, rounds=FEW_ROUNDS), trace)
            equilibria, design = carried.equilibria, polish(carried.equilibria, carried.design)
        fit = _reachable_fit(equilibria, design, weights, radius, polish, trace)
        if flips_last and _rms(fit.equilibria, fit.design) > weights.error_scale:
            weights = free
            fit = _other_fit(fit, weights, radius, _polish(weights, replace(settings, rounds=0), trace), trace)
        if flips_last and _rms(fit.equilibria, fit.design) > settings.target_rms:
            fit = _other_fit(fit, weights, radius, _polish(weights, settings, trace), trace)
    equilibria, smp = fit.equilibria, fit.design.rho > 0.5
    design = polished(equilibria, fit.design)
    trace.add("refit", Search(equilibria, design))
    L0 = problem.length
    printed = {"x": design.median.x * L0, "y": design.final.y * L0} | patch_arrays(problem, equilibria.patches, design)
    reasons = limit_reasons(problem, equilibria.patches, design, profile) + _not_reached(problem, fit, weights)
    volumes = tet_volumes(mesh["X"], mesh["tets"])
    report = {
        "tau_s": tau_s,
        "fits": fit.fits,
        "flipped_fraction": float(problem.volume_fractions[smp != rounded["smp"]].sum()),
        "reasons": reasons,
        "left_out": elements.left_out,
    }
    found = {
        "labels": {"smp": smp, "cluster": smp_clusters(mesh["tets"], volumes, smp)},
        "printed": printed,
        "loaded": None if fit.loading is None else _loaded_arrays(fit.loading, problem),
        "refit_report": report,
        "refit_trace": trace.csv(),
    }
    return found, _rms(equilibria, design) <= weights.error_scale


@dataclass(frozen=True, eq=False)
class _Printed:
    """Labels in equilibrium at the held positions of another design, and after some steps of these positions."""

    design: Design
    fitted: Design


def _best_flipped(
    equilibria: Equilibria, begin: Iterable[_Printed], polish: Polish, settings: FlipSettings, trace: Trace
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
        if _rms(equilibria, ends[-1]) <= settings.target_rms:
            break
    return min(ends, key=partial(_rms, equilibria))


def _printed_designs(
    equilibria: Equilibria,
    relaxed: Mapping[str, np.ndarray],
    smp: BoolArray,
    weights: ObjectiveWeights,
    settings: FlipSettings,
) -> Iterator[_Printed]:
    """Labels near the printable ones smp (m,) in equilibrium: near the relaxed design, or where loading from rest ends.

    The one to begin with first; of few tets, others after it.

    On more than MANY_TETS smp itself is solved for at once: on the path of equilibria from the relaxed design to it,
    short waves on squeezed surfaces turn unstable at every small step. On fewer, other flips make up for the repair; as
    long as the design is beyond the reach of some rounds of flips, the repair alone is tried, and another way to mend
    the labels. Of a design that is out of reach of the tolerance one way is tried, and no small steps.
    """
    problem, rho = equilibria.problem, smp.astype(np.float64)
    design = _carried(equilibria, relaxed, rho) if problem.n_tets > MANY_TETS else None
    if design is not None:
        yield _Printed(design, design)
        return
    before, found = _carried(equilibria, relaxed, relaxed["rho"]), list[_Printed]()
    if before is None:
        x, forces = relaxed["x"] / problem.length, relaxed["patch_force"] / problem.force
        design = _loaded_from_rest(equilibria, rho, x, forces)
        yield _Printed(design, design)
        return

    def rms_of(printed: _Printed) -> float:
        return _rms(equilibria, printed.fitted)

    relaxed_rms = float(relaxed["relaxed_rms"]) / problem.length
    hopeless = min(relaxed_rms, _rms(equilibria, before)) > OUT_OF_REACH * settings.tolerance
    ways = _ways(equilibria, before, smp, weights, settings)
    for followed in ways:
        found += [] if followed is None else [followed]
        if hopeless or min(map(rms_of, found), default=np.inf) <= WITHIN_REACH * settings.target_rms:
            break
    if not found and not hopeless:
        followed = _followed(equilibria, before, smp, weights, patient=True)
        found = [] if followed is None else [followed]
    if not found:
        design = _loaded_from_rest(equilibria, rho, before.median.x, before.median.forces)
        found = [_Printed(design, design)]
    first = min(found, key=rms_of)
    yield first
    if problem.n_tets <= FEW_TETS and not hopeless:
        yield from (each for each in found if each is not first)
        yield from (each for each in ways if each is not None)


def _ways(
    equilibria: Equilibria, before: Design, smp: BoolArray, weights: ObjectiveWeights, settings: FlipSettings
) -> Iterator[_Printed | None]:
    """Printable labels near a near 0/1 design, one after the other, for each takes a while; None where it fails.

    smp : (m,) its repair. Others make up for what it costs, or mend the labels for little error rather than by few
    changes. Of more than FEW_TETS, what is predicted to be no better than what was found, or clearly worse than what
    was predicted of another that was followed and came true, is left out if that can be true.
    """
    problem, few = equilibria.problem, equilibria.problem.n_tets <= FEW_TETS
    most = NOT_TRUE * _rms(equilibria, before)
    flips, tried, rounded = influence_near(equilibria, before, smp, weights), list[BoolArray](), before.rho > 0.5
    best = promised = np.inf
    for labels in _repairs(problem, flips, rounded, smp, settings):
        left = 0.0 if flips is None else error_left(flips, rounded, labels)
        came_true = best <= FAR_FROM_TRUE * promised
        worse = left <= most and (left >= best or (came_true and left > CLEARLY_WORSE * promised))
        if (worse and not few) or any((labels == other).all() for other in tried):
            continue
        tried.append(labels)
        ahead = None if flips is None else predicted(flips, rounded, labels)
        followed = _followed(equilibria, before, labels, weights, ahead)
        if followed is not None:
            best = min(best, _rms(equilibria, followed.fitted))
            promised = min(promised, left)
        yield followed


def _repairs(
    problem: Problem, flips: Influence | None, rounded: BoolArray, smp: BoolArray, settings: FlipSettings
) -> Iterator[BoolArray]:
    """Printable labels near `rounded` (m,): smp (m,) and, where it is known what flips do, others."""
    if flips is not None:
        yield compensated(problem, flips, rounded, smp, settings)
        yield mended(problem, flips, rounded, settings)
    yield smp


def _followed(
    equilibria: Equilibria,
    before: Design,
    smp: BoolArray,
    weights: ObjectiveWeights,
    ahead: Ahead | None = None,
    patient: bool = False,
) -> _Printed | None:
    """The labels smp (m,); None where no path of equilibria leads to them.

    ahead : what the change does; the held positions follow, else they stay
    patient : whether small steps are made too and the path may lead past unstable states, which takes minutes
    """
    rho = smp.astype(np.float64)
    try:
        if ahead is not None:
            design = follow_density(equilibria, before, rho, weights, ahead)
        else:
            smallest = PATIENT_STEP if patient else SMALLEST_STEP
            design = change_density(equilibria, before, rho, smallest, stay=not patient)
    except EquilibriumError:
        return None
    if not equilibria.patches.count:
        return _Printed(design, design)
    return _Printed(design, refit(equilibria, design, weights, lambda at: None, iterations=FEW_STEPS))  # noqa: ARG005


def _rms(equilibria: Equilibria, design: Design) -> float:
    return shape_error(equilibria.problem, design.final.y).rms


def _programmed(done: Programming, smp: FloatArray) -> Design:
    return Design(smp, done.median, done.final)


def _loaded_arrays(reached: Programming, problem: Problem) -> dict[str, np.ndarray]:
    """The `loaded` artifact: the end of the simulated loading, in mm and N."""
    median, L0 = reached.median, problem.length
    return {
        "x": median.x * L0,
        "y": reached.final.y * L0,
        "patch_force": median.forces * problem.force,
        "load_steps": np.array(reached.load_steps),
    }


@dataclass(frozen=True, eq=False)
class _Fit:
    """A fitted design, the fits made, and its loading, None where none went all the way.

    equilibria : with the points of the design
    missed : RMS error, L0, of the best fit from which loading ended elsewhere
    """

    equilibria: Equilibria
    design: Design
    fits: int = 0
    loading: Programming | None = None
    missed: float = np.inf


def _reachable_fit(
    equilibria: Equilibria, design: Design, weights: ObjectiveWeights, radius: float, polish: Polish, trace: Trace
) -> _Fit:
    """Simulate the loading to a fitted design: the state in which that ends is what the rig gets.

    radius : of a patch, L0
    Where it is another equilibrium than the fit's, and misses the tolerance, a point moves to where the two differ
    most, or else positions and labels are fitted again from where loading ended, unless the fit misses the tolerance by
    far. The state nearest to the temporary shape among those that loading ended in; the last fit where no loading went
    all the way.
    """
    ends, missed = list[tuple[float, _Fit]](), np.inf
    for fits in range(1, MOST_FITS + 1):
        done = program(equilibria, design.rho, design.median.x, design.median.forces)
        end = _programmed(done, design.rho)
        fitted_rms, rms = _rms(equilibria, design), _rms(equilibria, end)
        there, whole = same_shape(done, design.median.x), done.loaded == done.unloaded == 1.0
        if whole:
            ends.append((rms, _Fit(equilibria, end, loading=done)))
        if not there:
            missed = min(missed, fitted_rms)
            trace.add("reached", Search(equilibria, end))
        hopeless = fitted_rms > OUT_OF_REACH * weights.error_scale
        if there or hopeless or (whole and rms <= weights.error_scale):
            break
        if fits < MOST_FITS:
            equilibria, design = _begun_again(equilibria, design, end, whole, weights, radius)
            design = polish(equilibria, design)
    nearest = min(ends, key=lambda each: each[0])[1] if ends else _Fit(equilibria, design)
    return replace(nearest, fits=fits, missed=missed)


def _other_fit(fit: _Fit, weights: ObjectiveWeights, radius: float, polish: Polish, trace: Trace) -> _Fit:
    """A fit by other weights or with flips, or the one before where loading ends no nearer to the temporary shape."""
    design = polish(fit.equilibria, fit.design)
    if design is fit.design:
        return fit
    after = _reachable_fit(fit.equilibria, design, weights, radius, polish, trace)
    best = min(after, fit, key=lambda each: (each.loading is None, _rms(each.equilibria, each.design)))
    return replace(best, fits=fit.fits + after.fits, missed=min(fit.missed, after.missed))


def _begun_again(
    equilibria: Equilibria, design: Design, end: Design, whole: bool, weights: ObjectiveWeights, radius: float
) -> tuple[Equilibria, Design]:
    """What the next fit begins with where loading ended elsewhere, after it went all the way or not."""
    meets = _rms(equilibria, design) <= weights.error_scale
    if not whole or not meets:
        return equilibria, end
    weights = weights.of_fixed_density()
    model = build_model(equilibria, weights, smoothness_matrix(equilibria.problem), design)
    return held_apart(equilibria, weights, model, design, end.median.x, radius) or (equilibria, end)


def _not_reached(problem: Problem, fit: _Fit, weights: ObjectiveWeights) -> list[str]:
    """Why the design misses the tolerance where a fit meets it."""
    rms = _rms(fit.equilibria, fit.design)
    if fit.loading is None or rms <= weights.error_scale or fit.missed > weights.error_scale:
        return []
    return [
        f"its points hold two shapes: one is {fit.missed * problem.length:.3g} mm RMS off the temporary shape, but "
        "loading from the permanent shape ends in the other; allow more points ([goal] max_forces)"
    ]


def _flip_settings(
    inputs: Mapping[str, Any], profile: Mapping[str, Any], problem: Problem, weights: ObjectiveWeights
) -> FlipSettings:
    relaxed_rms = float(inputs["relaxed"]["relaxed_rms"]) / problem.length
    down_to = flipped_down_to(relaxed_rms, weights.error_scale, problem.n_tets)
    settings = flip_settings(inputs["mesh"], profile["printer"], profile["goal"], down_to)
    low = LOW_ERROR if 3 * problem.n_nodes <= MANY_DOFS else 1.0
    settings = replace(settings, tolerance=weights.error_scale, low_rms=low * weights.error_scale)
    few = problem.n_tets > MANY_TETS or relaxed_rms > OUT_OF_REACH * weights.error_scale
    return replace(settings, rounds=FEW_ROUNDS) if few else settings


def _polish(weights: ObjectiveWeights, settings: FlipSettings, trace: Trace) -> Polish:
    """A function that fits held positions, and flips labels as long as that brings the temporary shape nearer."""

    def polish(equilibria: Equilibria, design: Design) -> Design:
        fitted = refit(equilibria, design, weights, lambda at: trace.add("refit", at))
        return polish_labels(equilibria, fitted, weights, settings, lambda at: trace.add("flips", at))

    return polish


def flipped_down_to(relaxed_rms: float, tolerance: float, n_tets: int) -> float:
    """The RMS error at which labels need no more flips, in the unit of the other two."""
    allowed = ALLOWED_LOSS * relaxed_rms
    if n_tets > MANY_TETS:
        allowed = max(allowed, GOOD_ENOUGH * tolerance)
    return min(allowed, tolerance) if relaxed_rms <= ALLOWED_LOSS * tolerance else allowed


def flip_settings(mesh: Mapping[str, np.ndarray], printer: PrinterCard, goal: Goal, target_rms: float) -> FlipSettings:
    """Flips that keep the labels printable and within the goal's share of SMP, down to the RMS error target_rms, L0."""
    X, tets = mesh["X"], mesh["tets"]
    volumes = np.abs(tet_volumes(X, tets))
    return FlipSettings(
        printable=lambda smp: labels_for(X, tets, smp.astype(np.float64), volumes, printer).smp,
        annealed=annealer(tets, volumes / volumes.sum()),
        target_rms=target_rms,
        max_smp_fraction=1.0 if goal.max_smp_fraction is None else goal.max_smp_fraction,
    )


def _in_elements_of(problem: Problem, at: Search) -> Search:
    """A design in other elements of the same mesh: near it, or where loading from rest ends."""
    carried = carried_in(problem, at)
    if carried is not None:
        return carried
    patches, median = at.equilibria.patches, at.design.median
    equilibria = Equilibria(problem, patches_from_faces(problem, patches.centers, patches.faces, patches.offsets))
    design = _loaded_from_rest(equilibria, at.design.rho, median.x, median.forces)
    return replace(at, equilibria=equilibria, design=design)


def _loaded_from_rest(equilibria: Equilibria, rho: FloatArray, x: FloatArray, forces: FloatArray) -> Design:
    """The labels rho (m,) where loading to the median shape x (n or N, 3) ends, or as far as that comes."""
    return _programmed(program(equilibria, rho, at_nodes(equilibria.problem, x), forces), rho)


def _carried(equilibria: Equilibria, relaxed: Mapping[str, np.ndarray], rho: FloatArray) -> Design | None:
    """The density rho (m,) at the held positions of the relaxed design, from its shapes."""
    problem = equilibria.problem
    x, y = (relaxed[name] / problem.length for name in ("x", "y"))
    return carried_over(equilibria, rho, x, y, relaxed["patch_force"] / problem.force)


def limit_reasons(problem: Problem, patches: Patches, design: Design, profile: Mapping[str, Any]) -> list[str]:
    """What of the rig's limits the design does not keep."""
    rig, forces = profile["rig"], design.median.forces * problem.force
    sizes = np.linalg.norm(forces, axis=1)
    reasons = []
    if len(sizes) and sizes.max() > rig.max_force * (1 + 1e-3):
        point = int(sizes.argmax())
        reasons.append(f"point {point + 1} needs {sizes[point]:.4g} N, the rig gives {rig.max_force:g} N")
    if rig.pull_only and patches.count:
        outward = (forces * outward_normals(patches, design.median.x)).sum(axis=1)
        if (outward < 0).any():
            pushed = ", ".join(str(k + 1) for k in np.flatnonzero(outward < 0))
            reasons.append(f"the rig only pulls, but points {pushed} are pushed")
    return reasons
