"""Fill-reducing elimination order of a sparse symmetric matrix, from its graph alone."""

import numpy as np
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components, maximum_bipartite_matching

from fab4d.mesh.tetmesh import BoolArray, FloatArray, IntArray

# Parts of at most this many vertices are not split: their factor is dense anyway.
LEAF_SIZE = 4
# Averages over neighbours that straighten a cut, a cheap step towards the Fiedler vector.
SMOOTHING_STEPS = 20


def nested_dissection(indptr: IntArray, indices: IntArray) -> IntArray:
    """Vertices (n,) in elimination order: both halves of each split one after the other, then their separator.

    indptr (n + 1,), indices : CSR neighbour lists of an undirected graph; both directions of each edge, no loops
    All parts of one depth are split together. Source: George, SIAM J. Numer. Anal. 10 (1973) 345; the separators are
    smallest vertex covers of the cut edges (Koenig's theorem).
    """
    n = len(indptr) - 1
    graph = csr_array((np.ones(len(indices), np.int8), indices, indptr), shape=(n, n))
    vertices, paths = np.arange(n), []
    while len(vertices):
        n_parts, part = connected_components(graph, directed=False)
        # The path of a vertex is the list of its parts from the whole graph down; -1 once it is removed.
        paths.append(np.full(n, -1))
        paths[-1][vertices] = part
        is_leaf = np.bincount(part, minlength=n_parts)[part] <= LEAF_SIZE
        keep = np.flatnonzero(~(is_leaf | _separators(graph, part)))
        graph, vertices = graph[keep][:, keep], vertices[keep]
    # A separator's path is the beginning of the paths of its halves: sorted it precedes them, and reversed it follows.
    return np.lexsort(paths[::-1])[::-1] if paths else vertices


def _separators(graph: csr_array, part: IntArray) -> BoolArray:
    """Mask (n,) of vertices whose removal cuts each connected part in two of nearly equal size."""
    position = _along(graph, part)
    order = np.lexsort((position, part))
    starts, sizes = _part_slices(part)
    place = np.zeros(len(part), np.int64)
    place[order] = np.arange(len(part)) - np.repeat(starts, sizes)
    upper = 2 * place >= sizes[part]
    row = np.repeat(np.arange(len(part)), np.diff(graph.indptr))
    cut = ~upper[row] & upper[graph.indices]
    return _smallest_cover(row[cut], graph.indices[cut], len(part))


def _part_slices(part: IntArray) -> tuple[IntArray, IntArray]:
    """First place and length of each part in an array sorted by part."""
    sizes = np.bincount(part)
    return np.cumsum(sizes) - sizes, sizes


def _along(graph: csr_array, part: IntArray) -> FloatArray:
    """A coordinate (n,) along the longest extent of each part."""
    starts, _ = _part_slices(part)
    start = np.argsort(part, kind="stable")[starts]
    one_end = _farthest(_distances(graph, start), part)
    from_one = _distances(graph, one_end)
    from_other = _distances(graph, _farthest(from_one, part))
    position = (from_one - from_other).astype(np.float64)
    degree = np.maximum(np.diff(graph.indptr), 1)
    for _ in range(SMOOTHING_STEPS):
        position = 0.5 * (position + graph @ position / degree)
    return position


def _farthest(distance: IntArray, part: IntArray) -> IntArray:
    """The vertex of each part with the largest distance."""
    starts, sizes = _part_slices(part)
    return np.lexsort((distance, part))[starts + sizes - 1]


def _distances(graph: csr_array, roots: IntArray) -> IntArray:
    """Number of edges (n,) from the root of the vertex's connected part."""
    distance = np.full(graph.shape[0], -1)
    front, step = roots, 0
    while len(front):
        distance[front] = step
        reached = _neighbours(graph, front)
        front, step = np.unique(reached[distance[reached] < 0]), step + 1
    return distance


def _neighbours(graph: csr_array, vertices: IntArray) -> IntArray:
    """The neighbour lists of `vertices`, one after another."""
    starts = graph.indptr[vertices]
    counts = graph.indptr[vertices + 1] - starts
    shift = np.cumsum(counts) - counts
    return graph.indices[np.repeat(starts - shift, counts) + np.arange(counts.sum())]


def _smallest_cover(low: IntArray, high: IntArray, n: int) -> BoolArray:
    """Mask (n,) of the fewest vertices that touch every edge (low_k, high_k) of a bipartite graph.

    Koenig: with Z reached from the unmatched low vertices along alternating paths, (low - Z) and (high in Z).
    """
    edges = csr_array((np.ones(len(low), np.int8), (low, high)), shape=(n, n))
    partner = maximum_bipartite_matching(edges, perm_type="row")
    is_low, reached_high = np.zeros(n, bool), np.zeros(n, bool)
    is_low[low] = True
    matched = np.zeros(n, bool)
    matched[partner[partner >= 0]] = True
    reached_low = is_low & ~matched
    front = np.flatnonzero(reached_low)
    while len(front):
        high_front = np.unique(_neighbours(edges, front))
        high_front = high_front[~reached_high[high_front]]
        reached_high[high_front] = True
        front = partner[high_front]
        reached_low[front] = True
    return (is_low & ~reached_low) | reached_high
