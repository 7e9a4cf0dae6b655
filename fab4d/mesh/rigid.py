"""The rigid motion that brings one set of points closest to another."""

import numpy as np

from fab4d.mesh.tetmesh import FloatArray


def best_rigid_motion(
    points: FloatArray, targets: FloatArray, weights: FloatArray | None = None
) -> tuple[FloatArray, FloatArray]:
    """Rotation R (3, 3), det R = +1, and translation t (3,) minimising sum_i w_i |R p_i + t - q_i|^2.

    points, targets : (n, 3), mm        weights : (n,) non-negative, or None for equal ones
    Source: Kabsch, Acta Cryst. A32 (1976) 922.
    """
    w = np.full(len(points), 1.0 / len(points)) if weights is None else weights / weights.sum()
    p_mean, q_mean = w @ points, w @ targets
    U, _, Vt = np.linalg.svd((points - p_mean).T @ (w[:, None] * (targets - q_mean)))
    R = (U @ np.diag([1.0, 1.0, np.sign(np.linalg.det(U @ Vt))]) @ Vt).T
    return R, q_mean - R @ p_mean
