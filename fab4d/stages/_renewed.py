"""Printed labels that are relaxed and rounded anew, for a smaller error than flips leave."""

from dataclasses import replace

from fab4d.design.equilibria import Equilibria
from fab4d.design.finish import ANY_SHARE, LEAST_STABLE, least_ratio, relaxed_clear, relaxed_further, rounded_on
from fab4d.design.flips import FlipSettings
from fab4d.design.gauss_newton import Design
from fab4d.design.objective import ObjectiveWeights
from fab4d.design.reduced import EXCHANGED, ReducedSettings, Search
from fab4d.stages._bring_up import OUT_OF_REACH
from fab4d.stages._design import Trace
from fab4d.stages._fit import Polish
from fab4d.stages._flips import MANY_DOFS
from fab4d.stages._ways import Way, rms_of, way_near

# So few steps of relaxing keep a design near the labels that it comes from, and most of what it is rounded to can be
# printed.
RELAX_ITERATIONS = 4
# Labels are rounded anew with an error that counts 1 at these shares of what the printed ones leave, one after the
# other: which of them leads to better ones is chance.
SHARES = (1.0, 0.5)


def renewed(
    equilibria: Equilibria,
    design: Design,
    patch_radius: float,
    weights: ObjectiveWeights,
    settings: FlipSettings,
    polish: Polish,
    trace: Trace,
) -> Design:
    """A printed design with labels that leave a smaller error, or the same where none are found.

    patch_radius : L0        polish : what flips make of labels
    As long as the error is above that at which flips end, unless it is low or far beyond the tolerance, and with up to
    MANY_DOFS unknowns: it takes about as long as the flips before.
    """
    problem = equilibria.problem
    enough, most = max(settings.target_rms, settings.low_rms), OUT_OF_REACH * settings.tolerance
    for share in SHARES:
        rms = rms_of(equilibria, design)
        if not enough < rms <= most or 3 * problem.n_nodes > MANY_DOFS:
            break
        at = Search(equilibria, design, patch_radius, lam_SMP=weights.lam_SMP, exchanges=EXCHANGED)
        rounded = _rounded_anew(at, weights.replace(error_scale=share * rms), settings, trace)
        way = None if rounded is None else _printed(rounded, weights, settings)
        if way is None:
            continue
        trace.add("printed", replace(at, design=way.fitted))
        other = polish(equilibria, way.fitted)
        if rms_of(equilibria, other) < rms and _as_sound(equilibria, other, design, settings):
            design = other
    return design


def _as_sound(equilibria: Equilibria, other: Design, design: Design, settings: FlipSettings) -> bool:
    """Whether `other` keeps the goal's share of SMP, and is no nearer to unstable states than `design` or is clear."""
    if float(equilibria.problem.volume_fractions @ other.rho) > settings.max_smp_fraction:
        return False
    least = min(least_ratio(equilibria, design), LEAST_STABLE)
    return least_ratio(equilibria, other) >= least


def _rounded_anew(at: Search, weights: ObjectiveWeights, settings: FlipSettings, trace: Trace) -> Search | None:
    """None where no equilibria lead to 0 and 1."""
    few = ReducedSettings(
        n_points=at.equilibria.patches.count,
        patch_radii=(at.patch_radius,),
        weights=weights,
        max_smp_fraction=settings.max_smp_fraction,
        relax_iterations=RELAX_ITERATIONS,
        nearly=1.0,
    )
    relaxed = relaxed_clear(relaxed_further(at, few, trace.add), few, trace.add)
    return rounded_on(relaxed, trace.add, ANY_SHARE)


def _printed(rounded: Search, weights: ObjectiveWeights, settings: FlipSettings) -> Way | None:
    """None where no path of equilibria leads to printable labels."""
    smp = settings.printable(rounded.design.rho > 0.5)
    return way_near(rounded.equilibria, rounded.design, smp, weights, settings)
