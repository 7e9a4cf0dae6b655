"""Compiled loops over the nodes around one tet, whose own nodes come last."""
# mypy: disable-error-code="no-untyped-def"

import numpy as np
from numba import njit

# Sums may be reordered, so that they are vectorised.
_SUMS = {"reassoc", "contract", "nsz"}


@njit(cache=True, nogil=True)
def nodes_around(tet, elements, edges, star_start, star, local):
    """The vertices of all tets that share a vertex with `tet`, and middle nodes of edges to these; its own ones last.

    edges (6, 2) : corners between which the fifth to tenth node of an element are
    star_start (n + 1,), star : tets of each vertex in turn        local (N,) : -1; returned so
    """
    own, most, count = elements[tet], 0, 0
    for vertex in own[:4]:
        most += (star_start[vertex + 1] - star_start[vertex]) * len(own)
    found = np.zeros(most, np.int64)
    for node in own:
        local[node] = 0
    for vertex in own[:4]:
        for place in range(star_start[vertex], star_start[vertex + 1]):
            nodes = elements[star[place]]
            for k in range(len(nodes)):
                near = k < 4 or nodes[edges[k - 4, 0]] == vertex or nodes[edges[k - 4, 1]] == vertex
                if near and local[nodes[k]] < 0:
                    local[nodes[k]] = 0
                    found[count] = nodes[k]
                    count += 1
    around = np.append(found[:count], own)
    for node in around:
        local[node] = -1
    return around


@njit(cache=True, nogil=True)
def between(nodes, indptr, indices, data, local):
    """(n, n) the lower triangle of what a symmetric matrix has between the dofs of `nodes`.

    indptr, indices, data : lower triangle of 3 x 3 node blocks in CSC form, then constraints
    local (N,) : -1; returned so
    """
    n = 3 * len(nodes)
    K = np.zeros((n, n))
    for k in range(len(nodes)):
        local[nodes[k]] = k
    for k in range(len(nodes)):
        for c in range(3):
            column = 3 * nodes[k] + c
            for place in range(indptr[column], indptr[column + 1]):
                row = indices[place]
                if row < 3 * len(local) and local[row // 3] >= 0:
                    i, j = 3 * local[row // 3] + row % 3, 3 * k + c
                    K[max(i, j), min(i, j)] = data[place]
    for node in nodes:
        local[node] = -1
    return K


@njit(cache=True, nogil=True, fastmath=_SUMS)
def solve(L, b):
    """Overwrites b (n,) with (L L^T)^-1 b."""
    n = len(b)
    for i in range(n):
        value = b[i]
        for k in range(i):
            value -= L[i, k] * b[k]
        b[i] = value / L[i, i]
    for i in range(n - 1, -1, -1):
        b[i] /= L[i, i]
        for k in range(i):
            b[k] -= L[i, k] * b[i]


@njit(cache=True, nogil=True)
def product(nodes, indptr, indices, data, local, z, out):
    """out += A z with A what a matrix of 3 x 3 blocks has between `nodes`.

    indptr, indices, data (., 3, 3) : BSR form        local (N,) : -1; returned so        z, out (n,)
    """
    for k in range(len(nodes)):
        local[nodes[k]] = k
    for k in range(len(nodes)):
        for place in range(indptr[nodes[k]], indptr[nodes[k] + 1]):
            other = local[indices[place]]
            if other >= 0:
                for i in range(3):
                    for j in range(3):
                        out[3 * k + i] += data[place, i, j] * z[3 * other + j]
    for node in nodes:
        local[node] = -1
