"""Compiled penalties on tets that are stretched or squeezed beyond bounds; see projection.py for what they are for."""
# mypy: disable-error-code="no-untyped-def"

import numpy as np
from numba import njit

from fab4d.elasticity._kernels import _displacement_gradient, _invariants, _singular_frame


@njit(cache=True, inline="always")
def _squeezed(H, C, dN, smallest_det, n):
    """Excess 1 - det F / smallest_det, and its derivative by the nodes as n (nn, 3), kept where within."""
    jm1, _ = _invariants(H, C)
    excess = 1.0 - (1.0 + jm1) / smallest_det
    if excess > 0.0:
        for a in range(dN.shape[0]):
            for i in range(3):
                n[a, i] = (dN[a, i] + C[i, 0] * dN[a, 0] + C[i, 1] * dN[a, 1] + C[i, 2] * dN[a, 2]) / -smallest_det
    return excess


@njit(cache=True, inline="always")
def _stretched(U, V, sigma, k, dN, largest_stretch, n):
    """Excess sigma_k / largest_stretch - 1, and its derivative by the nodes as n (nn, 3), kept where within."""
    excess = sigma[k] / largest_stretch - 1.0
    if excess > 0.0:
        for a in range(dN.shape[0]):
            along = (V[0, k] * dN[a, 0] + V[1, k] * dN[a, 1] + V[2, k] * dN[a, 2]) / largest_stretch
            for i in range(3):
                n[a, i] = U[i, k] * along
    return excess


@njit(cache=True, inline="always")
def _may_stretch(H, largest_stretch):
    """The Frobenius norm bounds the largest stretch from above."""
    square = 0.0
    for i in range(3):
        for j in range(3):
            square += (H[i, j] + (1.0 if i == j else 0.0)) ** 2
    return square > largest_stretch * largest_stretch


@njit(cache=True, nogil=True)
def bound_gradient(elements, dN, weights, u, largest_stretch, smallest_det, g):
    """Sum of weights / 2 * excess^2 over det F and the three principal stretches; adds its derivative to g (N, 3).

    elements (m, 4), dN (m, 1, 4, 3), weights (m, 1), u (N, 3) as in _kernels.py; all tets must have det F > 0.
    """
    H, C, A = np.zeros((3, 3)), np.zeros((3, 3)), np.zeros((3, 3))
    U, V, sigma, n = np.zeros((3, 3)), np.zeros((3, 3)), np.zeros(3), np.zeros((4, 3))
    total = 0.0
    for m in range(elements.shape[0]):
        _displacement_gradient(u, elements[m], dN[m, 0], H)
        excess = _squeezed(H, C, dN[m, 0], smallest_det, n)
        if excess > 0.0:
            total += 0.5 * weights[m, 0] * excess * excess
            g[elements[m]] += weights[m, 0] * excess * n
        if _may_stretch(H, largest_stretch):
            _singular_frame(H, A, U, V, sigma)
            for k in range(3):
                excess = _stretched(U, V, sigma, k, dN[m, 0], largest_stretch, n)
                if excess > 0.0:
                    total += 0.5 * weights[m, 0] * excess * excess
                    g[elements[m]] += weights[m, 0] * excess * n
    return total


@njit(cache=True, nogil=True)
def _scatter_outer(n, w, nodes, rank, indptr, data):
    """Adds w n n^T to the lower triangle in the CSC form of pattern.SymmetricPattern."""
    pair = 0
    for a0 in range(nodes.shape[0]):
        for b0 in range(a0 + 1):
            a, b = a0, b0
            if nodes[a] < nodes[b]:
                a, b = b0, a0
            column = 3 * nodes[b]
            for k in range(3):
                if rank[pair] < 0:
                    base, start = indptr[column + k] - k, k
                else:
                    base, start = indptr[column + k] + 3 - k + 3 * rank[pair], 0
                for i in range(start, 3):
                    data[base + i] += w * n[a, i] * n[b, k]
            pair += 1


@njit(cache=True, nogil=True)
def _rotating_modes(U, V, sigma, squeeze, smallest_det, largest_stretch, dN, w, nodes, n, rank, indptr, data):
    """Adds the curvature of the excesses where the singular frame turns: skew and symmetric modes of each pair.

    squeeze : the excess of det F, or 0. Negative eigenvalues are left out.
    Source: Smith, de Goes, Kim, "Analytic Eigensystems for Isotropic Distortion Energies", ACM TOG 38 (2019) 3.
    """
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        fi = max(sigma[i] / largest_stretch - 1.0, 0.0) / largest_stretch
        fj = max(sigma[j] / largest_stretch - 1.0, 0.0) / largest_stretch
        gap = sigma[i] - sigma[j]
        if abs(gap) > 1e-9:
            symmetric = (fi - fj) / gap
        else:
            symmetric = 1.0 / (largest_stretch * largest_stretch) if fi > 0.0 else 0.0
        pressed = squeeze * sigma[k] / smallest_det
        for sign, value in ((1.0, symmetric + pressed), (-1.0, (fi + fj) / (sigma[i] + sigma[j]) - pressed)):
            if value > 0.0:
                for a in range(dN.shape[0]):
                    vi = V[0, i] * dN[a, 0] + V[1, i] * dN[a, 1] + V[2, i] * dN[a, 2]
                    vj = V[0, j] * dN[a, 0] + V[1, j] * dN[a, 1] + V[2, j] * dN[a, 2]
                    for c in range(3):
                        n[a, c] = U[c, i] * vj + sign * U[c, j] * vi
                _scatter_outer(n, 0.5 * w * value, nodes, rank, indptr, data)


@njit(cache=True, nogil=True)
def bound_tangent(elements, dN, weights, u, largest_stretch, smallest_det, rank, indptr, data):
    """Adds the Hessian of `bound_gradient` without its negative parts, positive semidefinite, to `data`."""
    H, C, A = np.zeros((3, 3)), np.zeros((3, 3)), np.zeros((3, 3))
    U, V, sigma, n = np.zeros((3, 3)), np.zeros((3, 3)), np.zeros(3), np.zeros((4, 3))
    for m in range(elements.shape[0]):
        _displacement_gradient(u, elements[m], dN[m, 0], H)
        squeeze = _squeezed(H, C, dN[m, 0], smallest_det, n)
        if squeeze > 0.0:
            _scatter_outer(n, weights[m, 0], elements[m], rank[m], indptr, data)
        if squeeze <= 0.0 and not _may_stretch(H, largest_stretch):
            continue
        _singular_frame(H, A, U, V, sigma)
        for k in range(3):
            if _stretched(U, V, sigma, k, dN[m, 0], largest_stretch, n) > 0.0:
                _scatter_outer(n, weights[m, 0], elements[m], rank[m], indptr, data)
        _rotating_modes(
            U, V, sigma, max(squeeze, 0.0), smallest_det, largest_stretch,
            dN[m, 0], weights[m, 0], elements[m], n, rank[m], indptr, data,
        )  # fmt: skip
