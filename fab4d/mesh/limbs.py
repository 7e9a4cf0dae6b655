"""Limbs of a part: what sticks out, seen from where it is held."""
# mypy: disable-error-code="no-untyped-def"

import numpy as np
from numba import njit
from scipy.sparse import coo_array, csr_array
from scipy.sparse.csgraph import dijkstra

from fab4d.mesh.tetmesh import BoolArray, FloatArray, IntArray
from fab4d.mesh.topology import unique_edges


def limbs(X: FloatArray, tets: IntArray, root: BoolArray, shortest: float) -> IntArray:
    """Limb (n,) of each vertex, from 0; -1 for vertices of the trunk between the limbs.

    X : (n, 3), mm      tets : (m, 4)       root : (n,) where the part is held; its middle where nothing is
    shortest : length, mm, along the edges of the tets, that a limb has at least beyond the place where it leaves others
    A limb is a leaf of the merge tree of the distance from the root, simplified by persistence.
    Source: Carr, Snoeyink, Axen, Computational Geometry 24 (2003) 75, section 4.
    """
    graph = _edge_graph(X, tets)
    roots = np.flatnonzero(root) if root.any() else np.array([_middle(graph)])
    distance = dijkstra(graph, directed=False, indices=roots, min_only=True)
    order = np.argsort(-distance, kind="stable")
    both = (graph + graph.T).tocsr()
    found = _leaves(order, distance, both.indptr.astype(np.int64), both.indices.astype(np.int64), shortest)
    numbers = np.unique(found[found >= 0])
    return np.where(found >= 0, np.searchsorted(numbers, found), -1)


def _edge_graph(X: FloatArray, tets: IntArray) -> csr_array:
    edges, _ = unique_edges(tets)
    lengths = np.linalg.norm(X[edges[:, 0]] - X[edges[:, 1]], axis=1)
    return coo_array((lengths, (edges[:, 0], edges[:, 1])), shape=(len(X), len(X))).tocsr()


def _middle(graph: csr_array) -> int:
    """The vertex whose larger distance to two far ends is the smallest."""

    def far(vertex: int) -> FloatArray:
        distances: FloatArray = dijkstra(graph, directed=False, indices=vertex)
        return distances

    one = int(np.argmax(far(0)))
    from_one = far(one)
    return int(np.argmin(np.maximum(from_one, far(int(np.argmax(from_one))))))


@njit(cache=True)
def _find(parent, v):
    while parent[v] != v:
        parent[v] = parent[parent[v]]
        v = parent[v]
    return v


@njit(cache=True)
def _leaves(order, height, indptr, indices, shortest):
    """Leaf (n,) of each vertex, -1 for none, named by its highest vertex.

    Vertices are added by falling height. Where two components meet that are both higher by `shortest`, those that hold
    no leaf yet become leaves.
    """
    n = len(order)
    parent, top = np.full(n, -1), np.zeros(n, np.int64)
    leaf_of = np.full(n, -1)
    has_leaf = np.zeros(n, np.bool_)
    # The component of a vertex when it was added is not stored: members of a new leaf are marked through `chain`.
    chain, last = np.full(n, -1), np.zeros(n, np.int64)
    for v in order:
        parent[v], top[v], last[v] = v, v, v
        for e in range(indptr[v], indptr[v + 1]):
            w = indices[e]
            if parent[w] < 0:
                continue
            a, b = _find(parent, v), _find(parent, w)
            if a == b:
                continue
            if height[top[a]] < height[top[b]]:
                a, b = b, a
            if height[top[b]] - height[v] >= shortest:
                for c in (a, b):
                    if not has_leaf[c]:
                        member = c
                        while member >= 0:
                            leaf_of[member] = top[c]
                            member = chain[member]
                has_leaf[a] = True
            has_leaf[a] = has_leaf[a] or has_leaf[b]
            parent[b] = a
            chain[last[a]] = b
            last[a] = last[b]
    if not has_leaf.any() and n > 0 and height[order[0]] >= shortest:
        leaf_of[:] = order[0]
    return leaf_of
