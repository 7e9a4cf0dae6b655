"""Sparsity pattern of the tangent stiffness, built once; only its values change."""

from dataclasses import dataclass

import numpy as np

from fab4d.mesh.tetmesh import FloatArray, IntArray


@dataclass(frozen=True, eq=False)
class SymmetricPattern:
    """Lower triangle, in CSC form, of a symmetric matrix of 3 x 3 node blocks followed by constraint rows.

    indptr (n + 1,), indices (nnz,) : CSC structure, n = 3 N + 3 K
    rank : (m, nn (nn + 1) / 2) for the local node pairs (a, b <= a) of each element, the place of the block's higher
        node in the list of the lower node's higher neighbours; -1 on the diagonal
    coupling : (nnz_W,) places in the data array of the constraint weights, in the order given to `build_pattern`
    """

    n_nodes: int
    indptr: IntArray
    indices: IntArray
    rank: IntArray
    coupling: IntArray

    @property
    def n_dofs(self) -> int:
        return len(self.indptr) - 1

    @property
    def nnz(self) -> int:
        return len(self.indices)

    def column_of_entry(self) -> IntArray:
        """(nnz,) the column of each stored entry."""
        return np.repeat(np.arange(self.n_dofs), np.diff(self.indptr))


def local_pairs(nn: int) -> tuple[IntArray, IntArray]:
    """Local node pairs (a, b) with b <= a, in the order of the pattern's `rank`."""
    return np.tril_indices(nn)


def build_pattern(
    elements: IntArray, n_nodes: int, rows: IntArray | None = None, nodes: IntArray | None = None, n_rows: int = 0
) -> SymmetricPattern:
    """Pattern for elements (m, nn) and `n_rows` vector constraints sum_k w_k x[nodes_k] = c.

    rows, nodes : (nnz_W,) constraint number and node of each weight; each constraint adds three rows, one a coordinate.
    """
    rows = np.zeros(0, np.int64) if rows is None else rows
    nodes = np.zeros(0, np.int64) if nodes is None else nodes
    a, b = local_pairs(elements.shape[1])
    high = np.maximum(elements[:, a], elements[:, b])
    low = np.minimum(elements[:, a], elements[:, b])
    off = high != low
    keys, inverse = np.unique(low[off] * n_nodes + high[off], return_inverse=True)
    key_low, key_high = keys // n_nodes, keys % n_nodes
    first = np.searchsorted(key_low, np.arange(n_nodes + 1))
    rank = np.full(high.shape, -1, np.int64)
    rank[off] = inverse - first[low[off]]

    n_higher = np.diff(first)
    order = np.lexsort((rows, nodes))
    n_coupled = np.bincount(nodes, minlength=n_nodes)
    column_length = (np.array([3, 2, 1]) + 3 * n_higher[:, None] + n_coupled[:, None]).ravel()
    indptr = np.zeros(3 * n_nodes + 3 * n_rows + 1, np.int64)
    np.cumsum(np.r_[column_length, np.ones(3 * n_rows, np.int64)], out=indptr[1:])
    indices = np.zeros(indptr[-1], np.int64)
    coupling = np.zeros((len(rows), 3), np.int64)
    position_in_node = np.arange(len(rows)) - np.searchsorted(nodes[order], nodes[order])
    for k in range(3):
        starts = indptr[3 * np.arange(n_nodes) + k]
        for i in range(k, 3):
            indices[starts + i - k] = 3 * np.arange(n_nodes) + i
        base = starts[key_low] + (3 - k) + 3 * (np.arange(len(keys)) - first[key_low])
        for i in range(3):
            indices[base + i] = 3 * key_high + i
        place = starts[nodes[order]] + (3 - k) + 3 * n_higher[nodes[order]] + position_in_node
        indices[place] = 3 * n_nodes + 3 * rows[order] + k
        coupling[order, k] = place
    indices[indptr[3 * n_nodes] :] = np.arange(3 * n_nodes, 3 * (n_nodes + n_rows))
    return SymmetricPattern(n_nodes, indptr, indices, rank, coupling)


@dataclass(frozen=True, eq=False)
class DirichletMask:
    """Places to overwrite so that fixed dofs decouple: off-diagonal entries and diagonal entries of `fixed`."""

    fixed: IntArray
    off_diagonal: IntArray
    diagonal: IntArray

    def apply(self, data: FloatArray, stiffness: float) -> None:
        """Decouple the fixed dofs in `data`, in place; their diagonal becomes `stiffness`."""
        data[self.off_diagonal] = 0.0
        data[self.diagonal] = stiffness


def dirichlet_mask(pattern: SymmetricPattern, fixed: IntArray) -> DirichletMask:
    """Mask that decouples the dofs `fixed` of a matrix with this pattern."""
    is_fixed = np.zeros(pattern.n_dofs, bool)
    is_fixed[fixed] = True
    columns = pattern.column_of_entry()
    touched = is_fixed[columns] | is_fixed[pattern.indices]
    on_diagonal = columns == pattern.indices
    return DirichletMask(
        np.asarray(fixed, np.int64), np.flatnonzero(touched & ~on_diagonal), np.flatnonzero(touched & on_diagonal)
    )
