"""Ways from a relaxed design to labels that can be printed, each in equilibrium."""

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass

import numpy as np

from fab4d.design.equilibria import Equilibria
from fab4d.design.finish import carried_over
from fab4d.design.flips import FlipSettings, compensated, error_left, mended, predicted
from fab4d.design.forward import Programming, program
from fab4d.design.gauss_newton import Ahead, Design
from fab4d.design.influence import Influence
from fab4d.design.objective import ObjectiveWeights, shape_error
from fab4d.design.paths import SMALLEST_STEP, change_density, follow_density
from fab4d.design.problem import Problem, at_nodes
from fab4d.design.reduced import refit
from fab4d.errors import EquilibriumError
from fab4d.mesh.tetmesh import BoolArray, FloatArray
from fab4d.stages._bring_up import OUT_OF_REACH
from fab4d.stages._coarse import MANY_TETS
from fab4d.stages._repair import influence_near

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
# Share of the way to labels that are hard to come to that a step may come down to.
PATIENT_STEP = 1e-3
# Of up to so many tets each counts, and where flips end is chance: they begin again from other labels there, as long
# as they do not reach the goal, for that takes seconds.
FEW_TETS = 1_000


@dataclass(frozen=True, eq=False)
class Way:
    """Labels in equilibrium at the held positions of another design, and after some steps of these positions."""

    design: Design
    fitted: Design


def ways_to_print(
    equilibria: Equilibria,
    relaxed: Mapping[str, np.ndarray],
    smp: BoolArray,
    weights: ObjectiveWeights,
    settings: FlipSettings,
) -> Iterator[Way]:
    """Labels near the printable ones smp (m,) in equilibrium: near the relaxed design, or where loading from rest ends.

    The one to begin with first; of few tets, others after it.

    On more than MANY_TETS smp itself is solved for at once: on the path of equilibria from the relaxed design to it,
    short waves on squeezed surfaces turn unstable at every small step. On fewer, other flips make up for the repair; as
    long as the design is beyond the reach of some rounds of flips, the repair alone is tried, and another way to mend
    the labels. Of a design that is out of reach of the tolerance one way is tried, and no small steps.
    """
    problem, rho = equilibria.problem, smp.astype(np.float64)
    design = carried(equilibria, relaxed, rho) if problem.n_tets > MANY_TETS else None
    if design is not None:
        yield Way(design, design)
        return
    before = carried(equilibria, relaxed, relaxed["rho"])
    if before is None:
        x, forces = relaxed["x"] / problem.length, relaxed["patch_force"] / problem.force
        design = loaded_from_rest(equilibria, rho, x, forces)
        yield Way(design, design)
        return

    relaxed_rms = float(relaxed["relaxed_rms"]) / problem.length
    hopeless = min(relaxed_rms, rms_of(equilibria, before)) > OUT_OF_REACH * settings.tolerance
    ways = _mended_ways(equilibria, before, smp, weights, settings)
    found = _followed_until(np.inf if hopeless else WITHIN_REACH * settings.target_rms, ways, equilibria)
    if not found and not hopeless:
        followed = _followed(equilibria, before, smp, weights, patient=True)
        found = [] if followed is None else [followed]
    if not found:
        design = loaded_from_rest(equilibria, rho, before.median.x, before.median.forces)
        found = [Way(design, design)]
    first = _best_of(found, equilibria)
    yield first
    if problem.n_tets <= FEW_TETS and not hopeless:
        yield from (each for each in found if each is not first)
        yield from (each for each in ways if each is not None)


def way_near(
    equilibria: Equilibria, before: Design, smp: BoolArray, weights: ObjectiveWeights, settings: FlipSettings
) -> Way | None:
    """The best way found from a near 0/1 design to printable labels like smp (m,), its repair; None where none is."""
    found = [way for way in _mended_ways(equilibria, before, smp, weights, settings) if way is not None]
    return _best_of(found, equilibria) if found else None


def _followed_until(enough: float, ways: Iterable[Way | None], equilibria: Equilibria) -> list[Way]:
    """Ways up to the first with an RMS error, L0, of `enough`, or all."""
    found = list[Way]()
    for followed in ways:
        found += [] if followed is None else [followed]
        if min((rms_of(equilibria, way.fitted) for way in found), default=np.inf) <= enough:
            break
    return found


def _best_of(found: list[Way], equilibria: Equilibria) -> Way:
    return min(found, key=lambda way: rms_of(equilibria, way.fitted))


def _mended_ways(
    equilibria: Equilibria, before: Design, smp: BoolArray, weights: ObjectiveWeights, settings: FlipSettings
) -> Iterator[Way | None]:
    """Printable labels near a near 0/1 design, one after the other, for each takes a while; None where it fails.

    smp : (m,) its repair. Others make up for what it costs, or mend the labels for little error rather than by few
    changes. Of more than FEW_TETS, what is predicted to be no better than what was found, or clearly worse than what
    was predicted of another that was followed and came true, is left out if that can be true.
    """
    problem, few = equilibria.problem, equilibria.problem.n_tets <= FEW_TETS
    most = NOT_TRUE * rms_of(equilibria, before)
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
            best = min(best, rms_of(equilibria, followed.fitted))
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
) -> Way | None:
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
        return Way(design, design)
    return Way(design, refit(equilibria, design, weights, lambda at: None, iterations=FEW_STEPS))  # noqa: ARG005


def loaded_from_rest(equilibria: Equilibria, rho: FloatArray, x: FloatArray, forces: FloatArray) -> Design:
    """The labels rho (m,) where loading to the median shape x (n or N, 3) ends, or as far as that comes."""
    return programmed(program(equilibria, rho, at_nodes(equilibria.problem, x), forces), rho)


def carried(equilibria: Equilibria, relaxed: Mapping[str, np.ndarray], rho: FloatArray) -> Design | None:
    """The density rho (m,) at the held positions of the relaxed design, from its shapes."""
    problem = equilibria.problem
    x, y = (relaxed[name] / problem.length for name in ("x", "y"))
    return carried_over(equilibria, rho, x, y, relaxed["patch_force"] / problem.force)


def programmed(done: Programming, smp: FloatArray) -> Design:
    """The labels smp (m,) where their loading ended."""
    return Design(smp, done.median, done.final)


def rms_of(equilibria: Equilibria, design: Design) -> float:
    """RMS error, L0."""
    return shape_error(equilibria.problem, design.final.y).rms
