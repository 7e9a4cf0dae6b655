"""Compiled element loops of the neo-Hookean solid; the formulas in plain NumPy are in neo_hooke.py.

All of them take elements (m, nn), shape-function gradients dN (m, nq, nn, 3) in 1/mm, weights (m, nq) in mm^3, moduli
mu, kappa (m,) in MPa and nodal displacements u (N, 3) in mm from the shape that dN belongs to. An element of zero mu is
skipped. Everything is evaluated with H = F - I, because the glassy phase works at strains where det F - 1 would lose
its digits.
"""
# mypy: disable-error-code="no-untyped-def"

import math

import numpy as np
from numba import njit

_INVERTED = -1.0
_JACOBI_SWEEPS = 30


@njit(cache=True, inline="always")
def _displacement_gradient(u, nodes, dN, H):
    for i in range(3):
        for j in range(3):
            H[i, j] = 0.0
    for a in range(nodes.shape[0]):
        node = nodes[a]
        for i in range(3):
            for j in range(3):
                H[i, j] += u[node, i] * dN[a, j]


@njit(cache=True, inline="always")
def _invariants(H, C):
    """Writes C = J F^-T - I = tr(H) I - H^T + cof H; returns J - 1 and e = I1/3 - 1."""
    trace = H[0, 0] + H[1, 1] + H[2, 2]
    C[0, 0] = H[1, 1] * H[2, 2] - H[1, 2] * H[2, 1]
    C[0, 1] = H[1, 2] * H[2, 0] - H[1, 0] * H[2, 2]
    C[0, 2] = H[1, 0] * H[2, 1] - H[1, 1] * H[2, 0]
    C[1, 0] = H[0, 2] * H[2, 1] - H[0, 1] * H[2, 2]
    C[1, 1] = H[0, 0] * H[2, 2] - H[0, 2] * H[2, 0]
    C[1, 2] = H[0, 1] * H[2, 0] - H[0, 0] * H[2, 1]
    C[2, 0] = H[0, 1] * H[1, 2] - H[0, 2] * H[1, 1]
    C[2, 1] = H[0, 2] * H[1, 0] - H[0, 0] * H[1, 2]
    C[2, 2] = H[0, 0] * H[1, 1] - H[0, 1] * H[1, 0]
    det = H[0, 0] * C[0, 0] + H[0, 1] * C[0, 1] + H[0, 2] * C[0, 2]
    jm1 = trace + C[0, 0] + C[1, 1] + C[2, 2] + det
    square = 0.0
    for i in range(3):
        C[i, i] += trace
        for j in range(3):
            square += H[i, j] * H[i, j]
            C[i, j] -= H[j, i]
    return jm1, (2.0 * trace + square) / 3.0


@njit(cache=True, inline="always")
def _density(jm1, e, mu, kappa):
    t = -2.0 / 3.0 * math.log1p(jm1)
    return 1.5 * mu * (math.expm1(t) * (1.0 + e) + e) + 0.5 * kappa * jm1 * jm1


@njit(cache=True, inline="always")
def _stress(H, C, jm1, e, mu, kappa, P):
    """First Piola-Kirchhoff stress, with the identity parts cancelled by hand."""
    J = 1.0 + jm1
    m = mu * math.exp(-2.0 / 3.0 * math.log1p(jm1)) / J
    for i in range(3):
        for j in range(3):
            P[i, j] = m * (J * H[i, j] - (1.0 + e) * C[i, j]) + kappa * jm1 * C[i, j]
        P[i, i] += m * (jm1 - e) + kappa * jm1


@njit(cache=True, nogil=True)
def energy(elements, dN, weights, mu, kappa, u):
    """Strain energy and the smallest det F; (inf, det F) as soon as an element is inverted."""
    H, C = np.zeros((3, 3)), np.zeros((3, 3))
    total, smallest = 0.0, np.inf
    for m in range(elements.shape[0]):
        if mu[m] == 0.0:
            continue
        for q in range(dN.shape[1]):
            _displacement_gradient(u, elements[m], dN[m, q], H)
            jm1, e = _invariants(H, C)
            smallest = min(smallest, 1.0 + jm1)
            if not jm1 > _INVERTED:
                return np.inf, smallest
            total += weights[m, q] * _density(jm1, e, mu[m], kappa[m])
    return total, smallest


@njit(cache=True, nogil=True)
def gradient(elements, dN, weights, mu, kappa, u, g):
    """Adds the nodal forces dW/du to g (N, 3); returns as `energy`."""
    H, C, P = np.zeros((3, 3)), np.zeros((3, 3)), np.zeros((3, 3))
    total, smallest = 0.0, np.inf
    for m in range(elements.shape[0]):
        if mu[m] == 0.0:
            continue
        for q in range(dN.shape[1]):
            _displacement_gradient(u, elements[m], dN[m, q], H)
            jm1, e = _invariants(H, C)
            smallest = min(smallest, 1.0 + jm1)
            if not jm1 > _INVERTED:
                return np.inf, smallest
            w = weights[m, q]
            total += w * _density(jm1, e, mu[m], kappa[m])
            _stress(H, C, jm1, e, mu[m], kappa[m], P)
            for a in range(elements.shape[1]):
                node = elements[m, a]
                for i in range(3):
                    g[node, i] += w * (P[i, 0] * dN[m, q, a, 0] + P[i, 1] * dN[m, q, a, 1] + P[i, 2] * dN[m, q, a, 2])
    return total, smallest


@njit(cache=True, nogil=True)
def element_forces(elements, dN, weights, mu, kappa, u, out):
    """Adds the nodal forces of each element to out (m, nn, 3); all elements must have det F > 0."""
    H, C, P = np.zeros((3, 3)), np.zeros((3, 3)), np.zeros((3, 3))
    for m in range(elements.shape[0]):
        if mu[m] == 0.0:
            continue
        for q in range(dN.shape[1]):
            _displacement_gradient(u, elements[m], dN[m, q], H)
            jm1, e = _invariants(H, C)
            _stress(H, C, jm1, e, mu[m], kappa[m], P)
            for a in range(elements.shape[1]):
                for i in range(3):
                    for j in range(3):
                        out[m, a, i] += weights[m, q] * P[i, j] * dN[m, q, a, j]


@njit(cache=True, inline="always")
def _tangent_vectors(H, C, jm1, dN, f, g):
    """f_a = F dN_a and g_a = F^-T dN_a of all nodes."""
    J = 1.0 + jm1
    for a in range(dN.shape[0]):
        for i in range(3):
            f[a, i] = dN[a, i] + H[i, 0] * dN[a, 0] + H[i, 1] * dN[a, 1] + H[i, 2] * dN[a, 2]
            g[a, i] = (dN[a, i] + C[i, 0] * dN[a, 0] + C[i, 1] * dN[a, 1] + C[i, 2] * dN[a, 2]) / J


@njit(cache=True, inline="always")
def _tangent_scalars(jm1, e, mu, kappa, w):
    """Factors of delta_ik dN_a.dN_b, f_a g_b + g_a f_b, g_a,i g_b,k and g_b,i g_a,k: dP[H] with H = e_k (x) dN_b."""
    J = 1.0 + jm1
    m = w * mu * math.exp(-2.0 / 3.0 * math.log1p(jm1))
    return (
        m,
        -2.0 / 3.0 * m,
        2.0 / 3.0 * m * (1.0 + e) + w * kappa * (2.0 * J - 1.0) * J,
        m * (1.0 + e) - w * kappa * jm1 * J,
    )


@njit(cache=True, inline="always")
def _tangent_block(na, nb, f, g, a, b, s0, s1, s2, s3, block):
    """block (3, 3): the tangent between the nodes a and b, whose shape functions have the gradients na and nb."""
    dot = s0 * (na[0] * nb[0] + na[1] * nb[1] + na[2] * nb[2])
    for i in range(3):
        for k in range(3):
            block[i, k] = s1 * (f[b, k] * g[a, i] + g[b, k] * f[a, i]) + s2 * g[a, i] * g[b, k] + s3 * g[b, i] * g[a, k]
        block[i, i] += dot


@njit(cache=True, nogil=True)
def tangent(elements, dN, weights, mu, kappa, u, rank, indptr, data):
    """Adds the tangent stiffness to `data`, the lower triangle in the CSC form of pattern.SymmetricPattern."""
    nn = elements.shape[1]
    H, C = np.zeros((3, 3)), np.zeros((3, 3))
    f, g = np.zeros((nn, 3)), np.zeros((nn, 3))
    for m in range(elements.shape[0]):
        if mu[m] == 0.0:
            continue
        for q in range(dN.shape[1]):
            _displacement_gradient(u, elements[m], dN[m, q], H)
            jm1, e = _invariants(H, C)
            _tangent_vectors(H, C, jm1, dN[m, q], f, g)
            s0, s1, s2, s3 = _tangent_scalars(jm1, e, mu[m], kappa[m], weights[m, q])
            pair = 0
            for a0 in range(nn):
                for b0 in range(a0 + 1):
                    a, b = a0, b0
                    if elements[m, a] < elements[m, b]:
                        a, b = b0, a0
                    column = 3 * elements[m, b]
                    dot = s0 * (
                        dN[m, q, a, 0] * dN[m, q, b, 0]
                        + dN[m, q, a, 1] * dN[m, q, b, 1]
                        + dN[m, q, a, 2] * dN[m, q, b, 2]
                    )
                    r = rank[m, pair]
                    for k in range(3):
                        if r < 0:
                            base, start = indptr[column + k] - k, k
                        else:
                            base, start = indptr[column + k] + 3 - k + 3 * r, 0
                        pb, pa = s1 * f[b, k] + s2 * g[b, k], s1 * g[b, k]
                        qa = s3 * g[a, k]
                        for i in range(start, 3):
                            value = pb * g[a, i] + pa * f[a, i] + qa * g[b, i]
                            if i == k:
                                value += dot
                            data[base + i] += value
                    pair += 1


@njit(cache=True, nogil=True)
def element_tangents(elements, dN, weights, mu, kappa, u, blocks):
    """Adds the tangent stiffness of each element to blocks (m, nn, nn, 3, 3): d(force on a)/d(position of b)."""
    nn = elements.shape[1]
    H, C, block = np.zeros((3, 3)), np.zeros((3, 3)), np.zeros((3, 3))
    f, g = np.zeros((nn, 3)), np.zeros((nn, 3))
    for m in range(elements.shape[0]):
        for q in range(dN.shape[1]):
            _displacement_gradient(u, elements[m], dN[m, q], H)
            jm1, e = _invariants(H, C)
            _tangent_vectors(H, C, jm1, dN[m, q], f, g)
            s0, s1, s2, s3 = _tangent_scalars(jm1, e, mu[m], kappa[m], weights[m, q])
            for a in range(nn):
                for b in range(nn):
                    _tangent_block(dN[m, q, a], dN[m, q, b], f, g, a, b, s0, s1, s2, s3, block)
                    for i in range(3):
                        for k in range(3):
                            blocks[m, a, b, i, k] += block[i, k]


@njit(cache=True, nogil=True)
def _eigen_symmetric(A, V):
    """Cyclic Jacobi: eigenvectors of A (3, 3) as columns of V; A is overwritten, eigenvalues on its diagonal."""
    for i in range(3):
        for j in range(3):
            V[i, j] = 1.0 if i == j else 0.0
    for _ in range(_JACOBI_SWEEPS):
        off = abs(A[0, 1]) + abs(A[0, 2]) + abs(A[1, 2])
        if off <= 1e-17 * (abs(A[0, 0]) + abs(A[1, 1]) + abs(A[2, 2])):
            break
        for p in range(2):
            for q in range(p + 1, 3):
                if A[p, q] == 0.0:
                    continue
                theta = 0.5 * (A[q, q] - A[p, p]) / A[p, q]
                t = math.copysign(1.0, theta) / (abs(theta) + math.sqrt(1.0 + theta * theta))
                c = 1.0 / math.sqrt(1.0 + t * t)
                s = t * c
                for k in range(3):
                    A[k, p], A[k, q] = c * A[k, p] - s * A[k, q], s * A[k, p] + c * A[k, q]
                    V[k, p], V[k, q] = c * V[k, p] - s * V[k, q], s * V[k, p] + c * V[k, q]
                for k in range(3):
                    A[p, k], A[q, k] = c * A[p, k] - s * A[q, k], s * A[p, k] + c * A[q, k]


@njit(cache=True, nogil=True)
def _singular_frame(H, A, U, V, sigma):
    """F = I + H = U diag(sigma) V^T; A (3, 3) is scratch."""
    for i in range(3):
        for j in range(3):
            A[i, j] = H[i, j] + H[j, i] + H[0, i] * H[0, j] + H[1, i] * H[1, j] + H[2, i] * H[2, j]
    _eigen_symmetric(A, V)
    for k in range(3):
        square = 0.0
        for i in range(3):
            U[i, k] = V[i, k] + H[i, 0] * V[0, k] + H[i, 1] * V[1, k] + H[i, 2] * V[2, k]
            square += U[i, k] * U[i, k]
        sigma[k] = math.sqrt(square)
        for i in range(3):
            U[i, k] /= sigma[k]


@njit(cache=True, nogil=True)
def _positive_part(sigma, s0, s1, s2, s3, A, V, scaling, same, swapped):
    """Eigenvalues of dP/dF below zero set to zero, in the singular frame of F.

    There dP_ii = sum_k scaling_ik H_kk and dP_ij = same_ij H_ij + swapped_ij H_ji; the second has the eigenvalues
    same +- swapped for symmetric and skew H, whatever the singular values are. A, V (3, 3) are scratch.
    """
    for i in range(3):
        for k in range(3):
            A[i, k] = s1 * (sigma[i] / sigma[k] + sigma[k] / sigma[i]) + s2 / (sigma[i] * sigma[k])
            plus = max(s0 + s3 / (sigma[i] * sigma[k]), 0.0)
            minus = max(s0 - s3 / (sigma[i] * sigma[k]), 0.0)
            same[i, k], swapped[i, k] = 0.5 * (plus + minus), 0.5 * (plus - minus)
        A[i, i] += s0 + s3 / (sigma[i] * sigma[i])
    _eigen_symmetric(A, V)
    for i in range(3):
        for k in range(3):
            scaling[i, k] = 0.0
            for j in range(3):
                scaling[i, k] += V[i, j] * max(A[j, j], 0.0) * V[k, j]


@njit(cache=True, nogil=True)
def _frame_block(na, nb, scaling, same, swapped, block):
    """block_ik = sum_jl T_ijkl na_j nb_l for the projected tangent T of `_positive_part`."""
    for i in range(3):
        for k in range(3):
            if i != k:
                block[i, k] = scaling[i, k] * na[i] * nb[k] + swapped[i, k] * na[k] * nb[i]
        j, l = (i + 1) % 3, (i + 2) % 3
        block[i, i] = scaling[i, i] * na[i] * nb[i] + same[i, j] * na[j] * nb[j] + same[i, l] * na[l] * nb[l]


@njit(cache=True, nogil=True)
def _scatter_rotated(U, block, column, r, indptr, data):
    """Adds U block U^T as the r-th block below the diagonal of three columns, or on the diagonal (r < 0)."""
    for k in range(3):
        b0 = block[0, 0] * U[k, 0] + block[0, 1] * U[k, 1] + block[0, 2] * U[k, 2]
        b1 = block[1, 0] * U[k, 0] + block[1, 1] * U[k, 1] + block[1, 2] * U[k, 2]
        b2 = block[2, 0] * U[k, 0] + block[2, 1] * U[k, 1] + block[2, 2] * U[k, 2]
        if r < 0:
            base, start = indptr[column + k] - k, k
        else:
            base, start = indptr[column + k] + 3 - k + 3 * r, 0
        for i in range(start, 3):
            data[base + i] += U[i, 0] * b0 + U[i, 1] * b1 + U[i, 2] * b2


@njit(cache=True, nogil=True)
def tangent_spd(elements, dN, weights, mu, kappa, u, rank, indptr, data):
    """As `tangent`, with dP/dF of each quadrature point replaced by its positive semidefinite part.

    Source: Smith, de Goes, Kim, "Analytic Eigensystems for Isotropic Distortion Energies", ACM TOG 38 (2019) 3.
    """
    nn = elements.shape[1]
    H, C, A = np.zeros((3, 3)), np.zeros((3, 3)), np.zeros((3, 3))
    U, V, W, sigma = np.zeros((3, 3)), np.zeros((3, 3)), np.zeros((3, 3)), np.zeros(3)
    scaling, same, swapped, block = np.zeros((3, 3)), np.zeros((3, 3)), np.zeros((3, 3)), np.zeros((3, 3))
    n = np.zeros((nn, 3))
    for m in range(elements.shape[0]):
        if mu[m] == 0.0:
            continue
        for q in range(dN.shape[1]):
            _displacement_gradient(u, elements[m], dN[m, q], H)
            jm1, e = _invariants(H, C)
            s0, s1, s2, s3 = _tangent_scalars(jm1, e, mu[m], kappa[m], weights[m, q])
            _singular_frame(H, A, U, V, sigma)
            for a in range(nn):
                for i in range(3):
                    n[a, i] = V[0, i] * dN[m, q, a, 0] + V[1, i] * dN[m, q, a, 1] + V[2, i] * dN[m, q, a, 2]
            _positive_part(sigma, s0, s1, s2, s3, A, W, scaling, same, swapped)
            pair = 0
            for a0 in range(nn):
                for b0 in range(a0 + 1):
                    a, b = a0, b0
                    if elements[m, a] < elements[m, b]:
                        a, b = b0, a0
                    _frame_block(n[a], n[b], scaling, same, swapped, block)
                    _scatter_rotated(U, block, 3 * elements[m, b], rank[m, pair], indptr, data)
                    pair += 1


@njit(cache=True, nogil=True)
def mixed(elements, dN, weights, mu, kappa, u, blocks):
    """Adds d(nodal forces)/dx of the glassy term to blocks (m, nn, nn, 3, 3); dN belongs to x, and u = y - x.

    With Fg = F_y F_x^-1 the block (a, b) is -K_ab Fg - w (P dN_b) (x) dN_a: model.md section 2, d/dF_x contracted with
    the shape functions.
    """
    nn = elements.shape[1]
    H, C, P = np.zeros((3, 3)), np.zeros((3, 3)), np.zeros((3, 3))
    f, g = np.zeros((nn, 3)), np.zeros((nn, 3))
    block, Pg = np.zeros((3, 3)), np.zeros(3)
    for m in range(elements.shape[0]):
        if mu[m] == 0.0:
            continue
        for q in range(dN.shape[1]):
            w = weights[m, q]
            _displacement_gradient(u, elements[m], dN[m, q], H)
            jm1, e = _invariants(H, C)
            _stress(H, C, jm1, e, mu[m], kappa[m], P)
            _tangent_vectors(H, C, jm1, dN[m, q], f, g)
            s0, s1, s2, s3 = _tangent_scalars(jm1, e, mu[m], kappa[m], w)
            for a in range(nn):
                for b in range(nn):
                    _tangent_block(dN[m, q, a], dN[m, q, b], f, g, a, b, s0, s1, s2, s3, block)
                    for i in range(3):
                        Pg[i] = w * (P[i, 0] * dN[m, q, b, 0] + P[i, 1] * dN[m, q, b, 1] + P[i, 2] * dN[m, q, b, 2])
                        for k in range(3):
                            blocks[m, a, b, i, k] -= (
                                block[i, k]
                                + block[i, 0] * H[0, k]
                                + block[i, 1] * H[1, k]
                                + block[i, 2] * H[2, k]
                                + Pg[i] * dN[m, q, a, k]
                            )


@njit(cache=True, nogil=True)
def deformed_gradients(elements, dN, u, out):
    """Shape-function gradients with respect to the deformed shape, out (m, nq, nn, 3) = F^-T dN; returns min det F."""
    H, C = np.zeros((3, 3)), np.zeros((3, 3))
    smallest = np.inf
    for m in range(elements.shape[0]):
        for q in range(dN.shape[1]):
            _displacement_gradient(u, elements[m], dN[m, q], H)
            jm1, _ = _invariants(H, C)
            smallest = min(smallest, 1.0 + jm1)
            for a in range(elements.shape[1]):
                for i in range(3):
                    out[m, q, a, i] = (
                        dN[m, q, a, i] + C[i, 0] * dN[m, q, a, 0] + C[i, 1] * dN[m, q, a, 1] + C[i, 2] * dN[m, q, a, 2]
                    ) / (1.0 + jm1)
    return smallest


@njit(cache=True, nogil=True)
def turning_load(elements, dN, weights, u, du, load):
    """Adds to load (N, 3) the right-hand side whose Poisson solution makes the step du turn elements, not shear them.

    A step changes F by dF = (S + W) F with S symmetric, W skew. The element turned by exp(W) after its stretch has
    exp(W) (I + S) F instead of F + dF: load_a = sum_q w (exp(W) (I + S) F - F - dF) dN_a, of second order in du.
    """
    H, C, G = np.zeros((3, 3)), np.zeros((3, 3)), np.zeros((3, 3))
    L, W, W2, A, D = np.zeros((3, 3)), np.zeros((3, 3)), np.zeros((3, 3)), np.zeros((3, 3)), np.zeros((3, 3))
    for m in range(elements.shape[0]):
        for q in range(dN.shape[1]):
            _displacement_gradient(u, elements[m], dN[m, q], H)
            _displacement_gradient(du, elements[m], dN[m, q], G)
            jm1, _ = _invariants(H, C)
            for i in range(3):
                for j in range(3):
                    # F^-1 = (I + C)^T / J
                    L[i, j] = G[i, j] + G[i, 0] * C[j, 0] + G[i, 1] * C[j, 1] + G[i, 2] * C[j, 2]
                    L[i, j] /= 1.0 + jm1
            for i in range(3):
                for j in range(3):
                    W[i, j] = 0.5 * (L[i, j] - L[j, i])
            angle2 = W[0, 1] ** 2 + W[0, 2] ** 2 + W[1, 2] ** 2
            a1, b = _rotation_series(angle2)
            for i in range(3):
                for j in range(3):
                    W2[i, j] = W[i, 0] * W[0, j] + W[i, 1] * W[1, j] + W[i, 2] * W[2, j]
            # A = exp(W) (I + S) - I - S - W, without the terms that cancel
            for i in range(3):
                for j in range(3):
                    A[i, j] = a1 * W[i, j] + b * W2[i, j]
                    for k in range(3):
                        S = 0.5 * (L[k, j] + L[j, k])
                        A[i, j] += ((1.0 + a1) * W[i, k] + b * W2[i, k]) * S
            for i in range(3):
                for j in range(3):
                    D[i, j] = A[i, j] + A[i, 0] * H[0, j] + A[i, 1] * H[1, j] + A[i, 2] * H[2, j]
            for a in range(elements.shape[1]):
                for i in range(3):
                    load[elements[m, a], i] += weights[m, q] * (
                        D[i, 0] * dN[m, q, a, 0] + D[i, 1] * dN[m, q, a, 1] + D[i, 2] * dN[m, q, a, 2]
                    )


@njit(cache=True, inline="always")
def _rotation_series(angle2):
    """a - 1 and b of exp(W) = I + a W + b W^2, a = sin t / t, b = (1 - cos t) / t^2, t^2 = `angle2`."""
    if angle2 < 1e-6:
        return -angle2 / 6.0, 0.5 - angle2 / 24.0
    angle = math.sqrt(angle2)
    return math.sin(angle) / angle - 1.0, 2.0 * math.sin(0.5 * angle) ** 2 / angle2
