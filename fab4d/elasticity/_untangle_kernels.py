"""The inversion-safe energy of `untangle` and its gradient, tet by tet."""
# mypy: disable-error-code="no-untyped-def"

import math

import numpy as np
from numba import njit


@njit(cache=True, nogil=True)
def regularised_energy(y, tets, gradients, shares, epsilon, gradient):
    """Sum of shares * [ tr(F^T F) / chi^(2/3) + (D^2 + 1) / chi ]; adds its derivative by y (n, 3) to `gradient`.

    D = det F; chi = (D + sqrt(epsilon^2 + D^2)) / 2 is positive and tends to max(D, 0).
    """
    total = 0.0
    E, F, C = np.zeros((3, 3)), np.zeros((3, 3)), np.zeros((3, 3))
    for t in range(tets.shape[0]):
        for i in range(3):
            for k in range(3):
                E[i, k] = y[tets[t, k + 1], i] - y[tets[t, 0], i]
        square = 0.0
        for i in range(3):
            for j in range(3):
                F[i, j] = E[i, 0] * gradients[t, 0, j] + E[i, 1] * gradients[t, 1, j] + E[i, 2] * gradients[t, 2, j]
                square += F[i, j] * F[i, j]
        for i in range(3):
            a, b = (i + 1) % 3, (i + 2) % 3
            for j in range(3):
                c, d = (j + 1) % 3, (j + 2) % 3
                C[i, j] = F[a, c] * F[b, d] - F[a, d] * F[b, c]
        D = F[0, 0] * C[0, 0] + F[0, 1] * C[0, 1] + F[0, 2] * C[0, 2]
        root = math.sqrt(epsilon * epsilon + D * D)
        # For D < 0 the sum cancels; the product form does not.
        chi = 0.5 * (D + root) if D > 0 else 0.5 * epsilon * epsilon / (root - D)
        slope = chi / root
        scale = chi ** (-2.0 / 3.0)
        total += shares[t] * (square * scale + (D * D + 1.0) / chi)
        by_D = (2.0 * D - (2.0 / 3.0 * square * scale + (D * D + 1.0) / chi) * slope) / chi
        for i in range(3):
            for k in range(3):
                force = 0.0
                for j in range(3):
                    force += (2.0 * scale * F[i, j] + by_D * C[i, j]) * gradients[t, k, j]
                force *= shares[t]
                gradient[tets[t, k + 1], i] += force
                gradient[tets[t, 0], i] -= force
    return total
