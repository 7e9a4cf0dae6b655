"""Modes at both ends of a spectrum by block Lanczos.

A factor is read as a whole for each solution, which takes most of the time of a single one: eight at once take some
twice as long. Source: Golub and Underwood, "The block Lanczos method for computing eigenvalues", Mathematical Software
III (1977) 361, with all vectors orthogonalised against each other.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from fab4d.mesh.tetmesh import BoolArray, FloatArray

Apply = Callable[[FloatArray], FloatArray]

# A vector adds nothing to the space if less than this share of what the operator does to it is outside.
DEPENDENT = 1e-8


@dataclass(frozen=True, eq=False)
class Modes:
    """Eigenvalues (k,) rising, their vectors (n, k), orthonormal in the mass, and which have converged (k,)."""

    values: FloatArray
    vectors: FloatArray
    converged: BoolArray

    @property
    def found(self) -> "Modes":
        """Those that have converged."""
        return Modes(self.values[self.converged], self.vectors[:, self.converged], self.converged[self.converged])


def end_modes(
    apply: Apply, mass: Apply, start: FloatArray, lowest: int, highest: int, tolerance: float, most_blocks: int
) -> Modes:
    """The `lowest` and the `highest` eigenpairs of an operator that is symmetric in the inner product u . mass(v).

    apply, mass : (n, b) -> (n, b), by columns
    start : (n, b) vectors to begin with
    A mode has converged when its residual, in the norm of the mass, is at most `tolerance` of its eigenvalue. The space
    grows by b vectors at a time, `most_blocks` times at most.
    """
    n, b = start.shape
    V, MV = (np.zeros((n, b * most_blocks), order="F") for _ in range(2))
    T, size = np.zeros((b * most_blocks,) * 2), 0
    block, mass_block = _orthonormal(start, mass(start), 0.0)
    while True:
        count = block.shape[1]
        old, size = size, size + count
        V[:, old:size], MV[:, old:size] = block, mass_block
        rest = apply(mass_block)
        T[:size, old:size] = MV[:, :size].T @ rest
        T[old:size, :size] = T[:size, old:size].T
        for _ in range(2):
            rest -= V[:, :size] @ (MV[:, :size].T @ rest)
        mass_rest = mass(rest)
        values, inside = np.linalg.eigh(T[:size, :size])
        ends = np.unique(np.r_[: min(lowest, size), max(size - highest, 0) : size])
        tail = inside[old:, ends]
        residuals = np.sqrt(np.maximum(np.einsum("ik,ij,jk->k", tail, rest.T @ mass_rest, tail), 0.0))
        converged = residuals <= tolerance * np.abs(values[ends])
        block, mass_block = _orthonormal(rest, mass_rest, float(np.abs(values).max()))
        complete = len(ends) == lowest + highest and converged.all()
        if complete or not block.shape[1] or size + block.shape[1] > V.shape[1]:
            return Modes(values[ends], V[:, :size] @ inside[:, ends], converged)


def _orthonormal(vectors: FloatArray, weighted: FloatArray, size: float) -> tuple[FloatArray, FloatArray]:
    """An orthonormal basis (n, k) of vectors (n, b), and the mass times it; weighted (n, b) : the mass times vectors.

    size : of vectors that count
    """
    squares, turn = np.linalg.eigh(vectors.T @ weighted)
    kept = squares > max((DEPENDENT * size) ** 2, DEPENDENT**2 * float(squares[-1]))
    turn = turn[:, kept] / np.sqrt(squares[kept])
    return vectors @ turn, weighted @ turn
