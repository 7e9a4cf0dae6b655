"""Direct solution of sparse symmetric systems behind one interface: analyse once, factor, read the inertia, solve.

`rslab` (LDL^T) is used where it is installed, SciPy's SuperLU on an own nested dissection otherwise.
"""

import os
from collections.abc import Callable
from functools import cached_property
from importlib.util import find_spec
from typing import Any, Protocol

import numpy as np
from scipy.sparse import csc_array, csr_array
from scipy.sparse.linalg import splu

from fab4d.errors import MissingToolError
from fab4d.mesh.tetmesh import FloatArray, IntArray
from fab4d.solvers._row_kernels import largest_entries
from fab4d.solvers.nested_dissection import nested_dissection
from fab4d.solvers.threads import THREADED_FROM, usable_cores

# Not only where it is used: its allocator takes the thread that loads it for one that never ends, and crashes after its
# end (microsoft/mimalloc issue 1287).
if find_spec("rslab"):
    import rslab

BACKENDS = ("rslab", "splu")
# Forces one backend where the caller of `analyse` names none.
BACKEND_VARIABLE = "FAB4D_LINEAR_BACKEND"

# A matrix is called singular when a load of the size of its own rows moves something by more than this. A clamped strip
# of 1000 elements of contrast 158 reaches 1e12; bodies with a free rigid mode start at 4e15.
SINGULAR_RESPONSE = 1e14
# Refine a solution whose error relative to |A| |x| + |b| is above this: SuperLU runs without pivoting.
REFINE_ABOVE = 1e-14
MAX_REFINEMENTS = 5
# Relative to its own compliance, how far rslab's factor lets a constraint give before refinement.
CONSTRAINT_SOFTNESS = 1e-6
# A factor whose refined solutions stay above both, relative to |A| |x| + |b| and to |b|, hides vanishing pivots.
UNUSABLE_ABOVE, UNSOLVED_ABOVE = 1e-12, 1e-6


Solve = Callable[[FloatArray], FloatArray]


class Factor(Protocol):
    """A factorisation A = L D L^T."""

    @property
    def n_negative(self) -> int:
        """Number of negative eigenvalues of A (Sylvester's law of inertia)."""

    def solve(self, b: FloatArray) -> FloatArray:
        """x (n,) with A x = b."""

    def solve_many(self, B: FloatArray) -> FloatArray:
        """X (n, k) with A X = B; cheaper than k single solves."""


class Analysis(Protocol):
    """The symbolic factorisation of one sparsity pattern."""

    def factor(self, data: FloatArray) -> Factor:
        """Factor the matrix with these values (nnz,) of the lower triangle in CSC form.

        Raises SingularMatrixError when the matrix has no inverse within rounding.
        """


class SingularMatrixError(ArithmeticError):
    """A pivot vanished: the matrix has no inverse."""


def analyse(indptr: IntArray, indices: IntArray, backend: str | None = None) -> Analysis:
    """Symbolic factorisation of the symmetric matrix whose lower triangle has this CSC structure.

    indptr (n + 1,), indices (nnz,) : rows ascending in each column, the diagonal stored in all of them
    backend : `rslab` or `splu`; None takes the one named by the environment variable FAB4D_LINEAR_BACKEND, else rslab
        where it is installed, else splu
    Raises ValueError for another structure or an unknown backend, MissingToolError when rslab is asked for in vain.
    """
    _check_structure(indptr, indices)
    name = backend or os.environ.get(BACKEND_VARIABLE) or _best_backend()
    if name not in BACKENDS:
        msg = f"unknown linear backend {name!r}: use one of {', '.join(BACKENDS)}, or unset {BACKEND_VARIABLE}"
        raise ValueError(msg)
    if name == "splu":
        return _SpluAnalysis(indptr, indices)
    if not find_spec("rslab"):
        msg = f"the linear backend rslab is not installed: install it, or use splu (unset {BACKEND_VARIABLE})"
        raise MissingToolError(msg)
    return _RslabAnalysis(indptr, indices)


def backward_error(indptr: IntArray, indices: IntArray, data: FloatArray, x: FloatArray, b: FloatArray) -> float:
    """Largest |b - A x| / (|A| |x| + |b|) of any row: x solves exactly a system whose entries differ by this factor.

    indptr, indices, data : lower triangle of A in CSC form        x, b : (n,) or (n, k)
    Source: Oettli and Prager, Numer. Math. 6 (1964) 405.
    """
    residual = np.abs(b - product(indptr, indices, data, x))
    size = product(indptr, indices, np.abs(data), np.abs(x)) + np.abs(b)
    return float(np.max(np.divide(residual, size, out=np.zeros_like(residual), where=size > 0.0), initial=0.0))


def product(indptr: IntArray, indices: IntArray, data: FloatArray, x: FloatArray) -> FloatArray:
    """A x for x (n,) or (n, k); indptr, indices, data : lower triangle of A in CSC form."""
    n = len(indptr) - 1
    lower = csc_array((data, indices, indptr), shape=(n, n))
    diagonal = data[indptr[:-1]]
    return lower @ x + lower.T @ x - (diagonal * x.T).T


def _best_backend() -> str:
    return "rslab" if find_spec("rslab") else "splu"


def _check_structure(indptr: IntArray, indices: IntArray) -> None:
    n = len(indptr) - 1
    columns = np.repeat(np.arange(n), np.diff(indptr))
    ascending = np.all(np.diff(columns * n + indices) > 0)
    if not (np.all(np.diff(indptr) > 0) and ascending and np.array_equal(indices[indptr[:-1]], np.arange(n))):
        msg = "the lower triangle needs its whole diagonal and ascending rows in each column"
        raise ValueError(msg)


def _scaling(indptr: IntArray, indices: IntArray, data: FloatArray) -> FloatArray:
    """Row scales s (n,) = max_j |A_ij|^(1/2) of a symmetric matrix given by its lower triangle.

    Raises SingularMatrixError for an empty row or an entry that is not finite.
    """
    largest = np.zeros(len(indptr) - 1)
    largest_entries(indptr, indices, data, largest)
    bad = ~(np.isfinite(largest) & (largest > 0.0))
    if np.any(bad):
        row = int(np.argmax(bad))
        msg = f"row {row} of the matrix is empty or not finite (largest entry {largest[row]})"
        raise SingularMatrixError(msg)
    return np.sqrt(largest)


def _check_regular(factor: Factor, scale: FloatArray) -> None:
    """Raise SingularMatrixError when a random load of the size of the matrix rows moves an unknown too far.

    Rounding turns vanishing pivots into tiny ones, so that a factorisation does not notice a missing support.
    """
    load = np.random.default_rng(0).standard_normal(len(scale))
    response = np.abs(factor.solve(scale * load) * scale)
    row = int(np.argmax(response))
    if not response[row] < SINGULAR_RESPONSE:
        msg = f"the matrix is singular: unknown {row} moves by {response[row]:.1e} under a load of the size of its row"
        raise SingularMatrixError(msg)


def _refined(solve: Solve, product: Solve, size: float, b: FloatArray) -> FloatArray:
    """A^-1 b by iterative refinement of an approximate `solve`; `product` is x -> A x, `size` the largest |A_ij|.

    Raises SingularMatrixError when the factor has lost its digits.
    """
    x = solve(b)
    for step in range(MAX_REFINEMENTS + 1):
        residual = b - product(x)
        error = np.max(np.abs(residual), initial=0.0)
        load = np.max(np.abs(b), initial=0.0)
        reference = size * np.max(np.abs(x), initial=0.0) + load
        if error <= REFINE_ABOVE * reference or step == MAX_REFINEMENTS:
            break
        x = x + solve(residual)
    if not error <= max(UNUSABLE_ABOVE * reference, UNSOLVED_ABOVE * load):
        msg = f"vanishing pivots: a solution misses its right-hand side {load:.1e} by {error:.1e}"
        raise SingularMatrixError(msg)
    return x


class _RslabFactor:
    def __init__(self, factor: Any) -> None:
        self._factor = factor

    @property
    def n_negative(self) -> int:
        return int(self._factor.inertia[1])

    def solve(self, b: FloatArray) -> FloatArray:
        return self._factor.solve(b)

    def solve_many(self, B: FloatArray) -> FloatArray:
        return self._factor.solve_many(np.ascontiguousarray(B))


class _RegularisedFactor(_RslabFactor):
    """Factor of a matrix near A, made exact by refinement."""

    def __init__(self, factor: Any, product: Solve, size: float) -> None:
        super().__init__(factor)
        self._product, self._size = product, size

    def solve(self, b: FloatArray) -> FloatArray:
        return _refined(super().solve, self._product, self._size, b)

    def solve_many(self, B: FloatArray) -> FloatArray:
        return _refined(super().solve_many, self._product, self._size, B)


class _RslabAnalysis:
    def __init__(self, indptr: IntArray, indices: IntArray, threads: int | None = None) -> None:
        n = len(indptr) - 1
        pattern = csc_array((np.ones(len(indices)), indices, indptr), shape=(n, n))
        usual = usable_cores() if n >= THREADED_FROM else 1
        self._symbolic = rslab.analyze(pattern, path="ldlt", threads=threads or usual)
        self._structure = indptr, indices

    def factor(self, data: FloatArray) -> Factor:
        scale = _scaling(*self._structure, data)
        # rslab pivots inside a supernode only, which a constraint with a zero diagonal does not survive.
        constraints = np.flatnonzero(data[self._structure[0][:-1]] == 0.0)
        try:
            factor = self._regularised(data, constraints) if len(constraints) else self._plain(data)
        except RuntimeError as error:  # rslab's "matrix is numerically rank-deficient"
            raise SingularMatrixError(str(error)) from error
        _check_regular(factor, scale)
        return factor

    def _plain(self, data: FloatArray) -> _RslabFactor:
        return _RslabFactor(self._symbolic.factor(data))

    def _regularised(self, data: FloatArray, constraints: IntArray) -> _RslabFactor:
        indptr, indices = self._structure
        changed = data.copy()
        changed[indptr[constraints]] = -_softness(indptr, indices, data)[constraints]
        size = float(np.max(np.abs(data)))
        return _RegularisedFactor(self._symbolic.factor(changed), lambda x: product(indptr, indices, data, x), size)


def _softness(indptr: IntArray, indices: IntArray, data: FloatArray) -> FloatArray:
    """A small part (n,) of the compliance that each row, read as a constraint, feels: max_j A_ij^2 / |A_jj|."""
    diagonal = np.abs(data[indptr[:-1]])
    column = np.repeat(np.arange(len(diagonal)), np.diff(indptr))
    largest = np.zeros(len(diagonal))
    with_stiffness = diagonal[column] > 0.0
    entry = np.flatnonzero((indices != column) & with_stiffness)
    np.maximum.at(largest, indices[entry], data[entry] ** 2 / diagonal[column[entry]])
    return CONSTRAINT_SOFTNESS * largest


class _SpluFactor:
    """SuperLU factors of the permuted matrix A[order][:, order]."""

    def __init__(self, matrix: csc_array, order: IntArray) -> None:
        self._matrix, self._order = matrix, order
        self._size = float(np.max(np.abs(matrix.data)))
        try:
            self._lu = splu(matrix, permc_spec="NATURAL", diag_pivot_thresh=0.0, options={"SymmetricMode": True})
        except RuntimeError as error:  # SuperLU's "Factor is exactly singular"
            raise SingularMatrixError(str(error)) from error
        if not np.array_equal(self._lu.perm_r, self._lu.perm_c):
            msg = "a pivot on the diagonal vanished"
            raise SingularMatrixError(msg)

    @cached_property
    def n_negative(self) -> int:
        return int(np.count_nonzero(self._lu.U.diagonal() < 0.0))

    def solve(self, b: FloatArray) -> FloatArray:
        # SuperLU solves column by column.
        right = np.asfortranarray(b[self._order])
        x = np.zeros(b.shape)
        x[self._order] = _refined(self._lu.solve, self._matrix.__matmul__, self._size, right)
        return x

    def solve_many(self, B: FloatArray) -> FloatArray:
        return self.solve(B)


class _SpluAnalysis:
    def __init__(self, indptr: IntArray, indices: IntArray) -> None:
        n = len(indptr) - 1
        self._structure = indptr, indices
        self._order = _elimination_order(indptr, indices)
        position = np.zeros(n, np.int64)
        position[self._order] = np.arange(n)
        columns = np.repeat(np.arange(n), np.diff(indptr))
        off = np.flatnonzero(indices != columns)
        entry = np.r_[np.arange(len(indices)), off]
        row, column = position[np.r_[indices, columns[off]]], position[np.r_[columns, indices[off]]]
        by_column = np.lexsort((row, column))
        self._entry = entry[by_column]
        self._rows = row[by_column].astype(np.int32)
        self._starts = np.searchsorted(column[by_column], np.arange(n + 1)).astype(np.int32)

    def factor(self, data: FloatArray) -> Factor:
        scale = _scaling(*self._structure, data)
        n = len(self._order)
        factor = _SpluFactor(csc_array((data[self._entry], self._rows, self._starts), shape=(n, n)), self._order)
        _check_regular(factor, scale)
        return factor


def _elimination_order(indptr: IntArray, indices: IntArray) -> IntArray:
    """Unknowns (n,) in elimination order, found on the graph of 3 x 3 node blocks where n allows it.

    Trailing blocks that store no entry but their diagonal are constraints: their diagonal may be zero, so each follows
    the last block that it couples.
    """
    n = len(indptr) - 1
    block = 3 if n % 3 == 0 else 1
    n_nodes, pairs = _block_graph(indptr, indices, block)
    low, high = pairs.T
    is_constraint = _trailing_constraints(indptr, block, n_nodes)
    kept = ~is_constraint[high]
    first, second = np.r_[low[kept], high[kept]], np.r_[high[kept], low[kept]]
    n_free = n_nodes - int(is_constraint.sum())
    graph = csr_array((np.ones(len(first), np.int8), (first, second)), shape=(n_free, n_free))
    key = np.full(n_nodes, -1.0)
    key[nested_dissection(graph.indptr, graph.indices)] = np.arange(n_free)
    np.maximum.at(key, high[~kept], key[low[~kept]] + 0.5)
    order = np.argsort(key, kind="stable")
    return (block * order[:, None] + np.arange(block)).ravel()


def _block_graph(indptr: IntArray, indices: IntArray, block: int) -> tuple[int, IntArray]:
    """Number of blocks and the pairs (k, 2), lower block first, that share an entry."""
    n = len(indptr) - 1
    low, high = np.repeat(np.arange(n), np.diff(indptr)) // block, indices // block
    keys = np.unique(low[low != high] * n + high[low != high])
    return n // block, np.column_stack([keys // n, keys % n])


def _trailing_constraints(indptr: IntArray, block: int, n_nodes: int) -> np.ndarray:
    """Mask (n_nodes,) of the blocks at the end whose columns hold their diagonal alone."""
    alone = np.all(np.diff(indptr).reshape(n_nodes, block) == 1, axis=1)
    last_coupled = np.flatnonzero(~alone)
    n_free = int(last_coupled[-1]) + 1 if len(last_coupled) else n_nodes
    return np.arange(n_nodes) >= n_free
