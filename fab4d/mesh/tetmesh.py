"""The tet mesh: vertex positions and tets."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]


def frozen(array: NDArray, dtype: type) -> NDArray:
    """`array` as a contiguous read-only array of `dtype`."""
    result: NDArray = np.array(array, dtype=dtype, order="C", copy=True)
    result.setflags(write=False)
    return result


@dataclass(frozen=True, eq=False)
class TetMesh:
    """Vertices X (n, 3) in mm and linear tets (m, 4), positively oriented: det[X1-X0, X2-X0, X3-X0] > 0."""

    X: FloatArray
    tets: IntArray

    def __post_init__(self) -> None:
        object.__setattr__(self, "X", frozen(self.X, np.float64))
        object.__setattr__(self, "tets", frozen(self.tets, np.int64))
        if self.X.ndim != 2 or self.X.shape[1] != 3 or self.tets.ndim != 2 or self.tets.shape[1] != 4:
            msg = f"a tet mesh needs X (n, 3) and tets (m, 4), not {self.X.shape} and {self.tets.shape}"
            raise ValueError(msg)
        if len(self.tets) and not (self.tets.min() >= 0 and self.tets.max() < len(self.X)):
            msg = f"tet vertex index out of range 0..{len(self.X) - 1}"
            raise ValueError(msg)

    @property
    def n_vertices(self) -> int:
        return len(self.X)

    @property
    def n_tets(self) -> int:
        return len(self.tets)
