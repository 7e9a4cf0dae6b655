"""Direct solution of sparse symmetric systems behind one interface: analyse once, factor, read the inertia, solve.

`rslab` (LDL^T) is used where it is installed, SciPy's SuperLU on an own nested dissection otherwise.
"""

from typing import Protocol

import numpy as np

from fab4d.mesh.tetmesh import FloatArray, IntArray


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
        """Factor the matrix with these values (nnz,) of the lower triangle in CSC form."""


class SingularMatrixError(ArithmeticError):
    """A pivot vanished: the matrix has no inverse."""


class _RslabFactor:
    def __init__(self, factor) -> None:  # noqa: ANN001
        self._factor = factor

    @property
    def n_negative(self) -> int:
        return int(self._factor.inertia[1])

    def solve(self, b: FloatArray) -> FloatArray:
        return self._factor.solve(b)

    def solve_many(self, B: FloatArray) -> FloatArray:
        return self._factor.solve_many(np.ascontiguousarray(B))


class _RslabAnalysis:
    def __init__(self, indptr: IntArray, indices: IntArray) -> None:
        import rslab
        from scipy.sparse import csc_array

        n = len(indptr) - 1
        pattern = csc_array((np.ones(len(indices)), indices, indptr), shape=(n, n))
        self._symbolic = rslab.analyze(pattern, path="ldlt")

    def factor(self, data: FloatArray) -> Factor:
        try:
            return _RslabFactor(self._symbolic.factor(data))
        except (ValueError, RuntimeError, ArithmeticError) as error:
            raise SingularMatrixError(str(error)) from error


def analyse(indptr: IntArray, indices: IntArray) -> Analysis:
    """Symbolic factorisation of the symmetric matrix whose lower triangle has this CSC structure."""
    return _RslabAnalysis(indptr, indices)
