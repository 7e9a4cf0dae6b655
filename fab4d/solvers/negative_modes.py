"""Newton steps away from saddle points, from the factor of the indefinite tangent itself.

Along a direction of negative curvature Newton's step climbs to the stationary point; its reverse leaves it at the same
rate, where a tangent made positive definite is far too stiff and creeps. Source: Dauphin et al., "Identifying and
attacking the saddle point problem", NIPS 27 (2014) 2933, with the modes found by Lanczos on the inverse.
"""

import numpy as np

from fab4d.mesh.tetmesh import FloatArray
from fab4d.solvers.block_lanczos import end_modes
from fab4d.solvers.linear import Factor

# With more negative modes the state is far from any stable one, and a positive definite tangent does better.
MOST_MODES = 4
BLOCK, MOST_BLOCKS = 8, 8
MODE_TOLERANCE = 1e-2


def descending(factor: Factor, step: FloatArray, n: int, count: int) -> FloatArray | None:
    """Newton's step (N,) with its part along the negative modes reversed; None where they are not found.

    factor : of the tangent A, which may be bordered by constraints: n is the number of unknowns before these
    count : of the negative eigenvalues of A beyond those of the constraints
    """
    if not 0 < count <= MOST_MODES or n <= BLOCK:
        return None

    def compliance(loads: FloatArray) -> FloatArray:
        return factor.solve_many(np.concatenate([loads, np.zeros((len(step) - n, loads.shape[1]))]))

    # Like the step, none of them moves unknowns that are fixed.
    rough = np.random.default_rng(0).standard_normal((n, BLOCK - 1)) * (step[:n, None] != 0.0)
    start = np.column_stack([step[:n], compliance(rough)[:n]])
    start /= np.linalg.norm(start, axis=0)
    modes = end_modes(
        lambda loads: compliance(loads)[:n], lambda each: each, start, count, 0, MODE_TOLERANCE, MOST_BLOCKS
    )
    if not modes.converged.all():
        return None
    turned = compliance(modes.vectors)
    for value, mode, answer in zip(modes.values, modes.vectors.T, turned.T, strict=True):
        if value < 0:
            step = step - 2 * (mode @ step[:n]) / value * answer
    return step
