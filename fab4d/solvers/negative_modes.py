"""Newton steps away from saddle points, from the factor of the indefinite tangent itself.

Along a direction of negative curvature Newton's step climbs to the stationary point; its reverse leaves it at the same
rate, where a tangent made positive definite is far too stiff and creeps. Source: Dauphin et al., "Identifying and
attacking the saddle point problem", NIPS 27 (2014) 2933, with the modes found by Lanczos on the inverse.
"""

import numpy as np
from scipy.sparse.linalg import ArpackError, ArpackNoConvergence, LinearOperator, eigsh

from fab4d.mesh.tetmesh import FloatArray
from fab4d.solvers.linear import Factor

# With more negative modes the state is far from any stable one, and a positive definite tangent does better.
MOST_MODES = 4
KRYLOV_SIZE, MOST_RESTARTS = 14, 4
MODE_TOLERANCE = 1e-2


def descending(factor: Factor, step: FloatArray, n: int, count: int) -> FloatArray | None:
    """Newton's step (N,) with its part along the negative modes reversed; None where they are not found.

    factor : of the tangent A, which may be bordered by constraints: n is the number of unknowns before these
    count : of the negative eigenvalues of A beyond those of the constraints
    """
    if not 0 < count <= MOST_MODES or n <= KRYLOV_SIZE:
        return None

    def compliance(load: FloatArray) -> FloatArray:
        return factor.solve(np.concatenate([load.ravel(), np.zeros(len(step) - n)]))

    inverse = LinearOperator((n, n), matvec=lambda load: compliance(load)[:n], dtype=np.float64)
    try:
        # From the step, which leaves fixed unknowns where they are.
        values, modes = eigsh(
            inverse, count, which="SA", tol=MODE_TOLERANCE, v0=step[:n], ncv=KRYLOV_SIZE, maxiter=MOST_RESTARTS
        )
    except (ArpackNoConvergence, ArpackError):
        return None
    for value, mode in zip(values, modes.T, strict=True):
        if value < 0:
            step = step - 2 * (mode @ step[:n]) / value * compliance(mode)
    return step
