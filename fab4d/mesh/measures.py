"""Lengths, areas, volumes and deformation gradients of tet meshes, in mm."""

import numpy as np

from fab4d.mesh.tetmesh import FloatArray, IntArray


def edge_matrices(X: FloatArray, tets: IntArray) -> FloatArray:
    """Edge vectors of each tet as columns, (m, 3, 3): D[:, :, k] = X[tets[:, k+1]] - X[tets[:, 0]]."""
    return np.swapaxes(X[tets[:, 1:]] - X[tets[:, :1]], 1, 2)


def tet_volumes(X: FloatArray, tets: IntArray) -> FloatArray:
    """Signed volumes (m,), mm^3."""
    return np.linalg.det(edge_matrices(X, tets)) / 6.0


def face_area_vectors(X: FloatArray, faces: IntArray) -> FloatArray:
    """Area times outward normal of triangles (b, 3), mm^2."""
    return 0.5 * np.cross(X[faces[:, 1]] - X[faces[:, 0]], X[faces[:, 2]] - X[faces[:, 0]])


def unit_vectors(vectors: FloatArray) -> FloatArray:
    """Vectors (k, 3) divided by their lengths; zero stays zero."""
    lengths = np.linalg.norm(vectors, axis=1, keepdims=True)
    return vectors / np.where(lengths > 0.0, lengths, 1.0)


def vertex_areas(X: FloatArray, faces: IntArray) -> FloatArray:
    """A third of the area of the triangles `faces` at each vertex, (n,), mm^2; zero off the surface."""
    areas = np.linalg.norm(face_area_vectors(X, faces), axis=1)
    return np.bincount(faces.ravel(), np.repeat(areas / 3.0, 3), minlength=len(X)).astype(np.float64)


def bounding_box_diagonal(X: FloatArray) -> float:
    """L0: diagonal of the axis-parallel bounding box, mm."""
    return float(np.linalg.norm(X.max(axis=0) - X.min(axis=0)))


def deformation_gradients(X: FloatArray, x: FloatArray, tets: IntArray) -> FloatArray:
    """F = dx/dX of each linear tet, (m, 3, 3)."""
    return edge_matrices(x, tets) @ np.linalg.inv(edge_matrices(X, tets))
