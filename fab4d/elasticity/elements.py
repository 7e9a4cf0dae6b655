"""Linear and quadratic tets: shape-function gradients and quadrature weights in the permanent shape."""

from dataclasses import dataclass

import numpy as np

from fab4d.mesh.measures import edge_matrices
from fab4d.mesh.tetmesh import FloatArray, IntArray
from fab4d.mesh.topology import TET_EDGES

# Four-point rule of degree 2 on the reference tet, barycentric coordinates. Source: Keast, CMAME 55 (1986) 339.
_A, _B = (5 + 3 * 5**0.5) / 20, (5 - 5**0.5) / 20
QUADRATURE_4 = np.full((4, 4), _B) + (_A - _B) * np.eye(4)

# Gradients of the barycentric coordinates on the reference tet (4, 3).
_GRAD_BARYCENTRIC = np.vstack([-np.ones(3), np.eye(3)])


@dataclass(frozen=True, eq=False)
class Discretisation:
    """Elements with their constant data; nn nodes and nq quadrature points an element.

    elements : (m, nn) node numbers          X : (N, 3) permanent node positions
    dN : (m, nq, nn, 3) gradients of the shape functions with respect to X
    weights : (m, nq) quadrature weights times the volume element
    """

    X: FloatArray
    elements: IntArray
    dN: FloatArray
    weights: FloatArray

    @property
    def order(self) -> int:
        return 1 if self.elements.shape[1] == 4 else 2

    @property
    def volumes(self) -> FloatArray:
        """(m,) volumes in the permanent shape."""
        return self.weights.sum(axis=1)


def _reference_gradients(order: int) -> FloatArray:
    """(nq, nn, 3) shape-function gradients at the quadrature points of the reference tet."""
    if order == 1:
        return _GRAD_BARYCENTRIC[None]
    corner = (4 * QUADRATURE_4 - 1)[:, :, None] * _GRAD_BARYCENTRIC
    i, j = TET_EDGES.T
    middle = 4 * (QUADRATURE_4[:, i, None] * _GRAD_BARYCENTRIC[j] + QUADRATURE_4[:, j, None] * _GRAD_BARYCENTRIC[i])
    return np.concatenate([corner, middle], axis=1)


def discretise(X: FloatArray, elements: IntArray) -> Discretisation:
    """Discretisation of straight-sided tets: elements (m, 4) linear, (m, 10) quadratic in VTK node order.

    X : (N, 3) permanent node positions.
    """
    order = 1 if elements.shape[1] == 4 else 2
    D = edge_matrices(X, elements[:, :4])
    dN = np.ascontiguousarray(np.einsum("qaj,mji->mqai", _reference_gradients(order), np.linalg.inv(D)))
    nq = dN.shape[1]
    weights = np.repeat(np.linalg.det(D)[:, None] / (6.0 * nq), nq, axis=1)
    return Discretisation(np.ascontiguousarray(X), np.ascontiguousarray(elements), dN, weights)
