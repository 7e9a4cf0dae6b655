"""The grid on which coordinates live, so that files, units and float32 all mean exactly the same part."""

import math

import numpy as np

from fab4d.mesh.tetmesh import FloatArray

FINEST_STEP = 2.0**-14
"""mm: exact in float32 up to 1 m, and far coarser than the rounding of a change of unit."""


def snapped(X: FloatArray) -> FloatArray:
    """X (n, 3) rounded to multiples of 2^-14 mm; beyond 1 m, of the finest step that float32 holds."""
    largest = float(np.abs(X[np.isfinite(X)]).max(initial=1.0))
    step = max(FINEST_STEP, 2.0 ** (math.ceil(math.log2(largest)) - 24))
    # Adding zero turns -0.0 into 0.0.
    return np.round(X / step) * step + 0.0
