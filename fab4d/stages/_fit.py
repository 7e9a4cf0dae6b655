"""Held positions fitted to labels, in a state that loading from the permanent shape reaches."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from fab4d.design.equilibria import Equilibria
from fab4d.design.exchange import held_apart
from fab4d.design.forward import Programming, program, same_shape
from fab4d.design.gauss_newton import Design, build_model
from fab4d.design.objective import ObjectiveWeights, smoothness_matrix
from fab4d.design.reduced import Search
from fab4d.stages._bring_up import OUT_OF_REACH
from fab4d.stages._design import Trace
from fab4d.stages._ways import programmed, rms_of

# How often the held positions are fitted again after the loading has found another equilibrium than the fit.
MOST_FITS = 3
Polish = Callable[[Equilibria, Design], Design]


@dataclass(frozen=True, eq=False)
class Fit:
    """A fitted design, the fits made, and its loading, None where none went all the way.

    equilibria : with the points of the design
    missed : RMS error, L0, of the best fit from which loading ended elsewhere
    """

    equilibria: Equilibria
    design: Design
    fits: int = 0
    loading: Programming | None = None
    missed: float = np.inf

    @property
    def rms(self) -> float:
        """RMS error of the design, L0."""
        return rms_of(self.equilibria, self.design)


def reachable_fit(
    equilibria: Equilibria, design: Design, weights: ObjectiveWeights, radius: float, polish: Polish, trace: Trace
) -> Fit:
    """Simulate the loading to a fitted design: the state in which that ends is what the rig gets.

    radius : of a patch, L0
    Where it is another equilibrium than the fit's, and misses the tolerance, a point moves to where the two differ
    most, or else positions and labels are fitted again from where loading ended, unless the fit misses the tolerance by
    far. The state nearest to the temporary shape among those that loading ended in; the last fit where no loading went
    all the way.
    """
    ends, missed = list[Fit](), np.inf
    for fits in range(1, MOST_FITS + 1):
        done = program(equilibria, design.rho, design.median.x, design.median.forces)
        end = programmed(done, design.rho)
        fitted_rms, rms = rms_of(equilibria, design), rms_of(equilibria, end)
        there, whole = same_shape(done, design.median.x), done.loaded == done.unloaded == 1.0
        if whole:
            ends.append(Fit(equilibria, end, loading=done))
        if not there:
            missed = min(missed, fitted_rms)
            trace.add("reached", Search(equilibria, end))
        hopeless = fitted_rms > OUT_OF_REACH * weights.error_scale
        if there or hopeless or (whole and rms <= weights.error_scale):
            break
        if fits < MOST_FITS:
            equilibria, design = _begun_again(equilibria, design, end, whole, weights, radius)
            design = polish(equilibria, design)
    nearest = min(ends, key=lambda each: each.rms, default=Fit(equilibria, design))
    return replace(nearest, fits=fits, missed=missed)


def other_fit(fit: Fit, weights: ObjectiveWeights, radius: float, polish: Polish, trace: Trace) -> Fit:
    """A fit by other weights or with flips, or the one before where loading ends no nearer to the temporary shape."""
    design = polish(fit.equilibria, fit.design)
    if design is fit.design:
        return fit
    after = reachable_fit(fit.equilibria, design, weights, radius, polish, trace)
    best = min(after, fit, key=lambda each: (each.loading is None, each.rms))
    return replace(best, fits=fit.fits + after.fits, missed=min(fit.missed, after.missed))


def _begun_again(
    equilibria: Equilibria, design: Design, end: Design, whole: bool, weights: ObjectiveWeights, radius: float
) -> tuple[Equilibria, Design]:
    """What the next fit begins with where loading ended elsewhere, after it went all the way or not."""
    meets = rms_of(equilibria, design) <= weights.error_scale
    if not whole or not meets:
        return equilibria, end
    weights = weights.of_fixed_density()
    model = build_model(equilibria, weights, smoothness_matrix(equilibria.problem), design)
    return held_apart(equilibria, weights, model, design, end.median.x, radius) or (equilibria, end)


def not_reached(fit: Fit, weights: ObjectiveWeights) -> list[str]:
    """Why the design misses the tolerance where a fit meets it."""
    if fit.loading is None or fit.rms <= weights.error_scale or fit.missed > weights.error_scale:
        return []
    missed_mm = fit.missed * fit.equilibria.problem.length
    return [
        f"its points hold two shapes: one is {missed_mm:.3g} mm RMS off the temporary shape, but "
        "loading from the permanent shape ends in the other; allow more points ([goal] max_forces)"
    ]
