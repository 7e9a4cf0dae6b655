"""The design problem in dimensionless form: lengths in L0, stresses in mu_TPE, forces in mu_TPE L0^2."""

from dataclasses import dataclass, replace

import numpy as np

from fab4d.elasticity.elements import Discretisation, discretise
from fab4d.materials.cards import MaterialCard, Moduli
from fab4d.mesh.measures import bounding_box_diagonal, vertex_areas
from fab4d.mesh.quadratic import quadratic_tets, with_midpoints
from fab4d.mesh.tetmesh import BoolArray, FloatArray, IntArray
from fab4d.mesh.topology import face_table, unique_edges


@dataclass(frozen=True, eq=False)
class Problem:
    """Geometry, target and moduli of one scene, dimensionless.

    body : elements in the permanent shape          X_temp : (N, 3) wanted temporary shape
    clamp : (N,) nodes held while programming       faces : (b, 3) boundary faces by their corner vertices
    area_weights : (N,) boundary-vertex areas, sum 1, zero elsewhere
    length, force : mm and N of one unit
    """

    body: Discretisation
    X_temp: FloatArray
    clamp: BoolArray
    faces: IntArray
    face_tets: IntArray
    neighbours: IntArray
    neighbour_areas: FloatArray
    area_weights: FloatArray
    tpe: Moduli
    rubbery: Moduli
    glassy: Moduli
    length: float
    force: float

    @property
    def n_nodes(self) -> int:
        return len(self.body.X)

    @property
    def n_tets(self) -> int:
        return len(self.body.elements)

    @property
    def volume_fractions(self) -> FloatArray:
        """(m,) V_j / V."""
        volumes = self.body.volumes
        return volumes / volumes.sum()

    def with_moduli(
        self, tpe: Moduli | None = None, rubbery: Moduli | None = None, glassy: Moduli | None = None
    ) -> "Problem":
        """The same problem with other moduli, in the same unit, of the phases that are given."""
        return replace(self, tpe=tpe or self.tpe, rubbery=rubbery or self.rubbery, glassy=glassy or self.glassy)


def _scaled(moduli: Moduli, unit: float) -> Moduli:
    return Moduli(moduli.mu / unit, moduli.kappa / unit)


def build_problem(
    X: FloatArray, X_temp: FloatArray, tets: IntArray, clamp: BoolArray, card: MaterialCard, element: str = "linear"
) -> Problem:
    """Dimensionless problem of shapes X, X_temp (n, 3) in mm, tets (m, 4) and the clamp mask (n,).

    element : "linear", or "quadratic" for straight-sided 10-node tets with nodes n.. at the edges' midpoints.
    """
    L0, mu0 = bounding_box_diagonal(X), card.tpe.mu
    table = face_table(tets)
    weights = vertex_areas(X, table.boundary)
    corner = X[table.interior]
    areas = 0.5 * np.linalg.norm(np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]), axis=1)
    elements = tets
    if element == "quadratic":
        elements, edges = quadratic_tets(tets, len(X))
        clamp = np.r_[clamp, clamp[edges].all(axis=1)]
        weights = np.r_[weights, np.zeros(len(edges))]
        X, X_temp = with_midpoints(X, edges), with_midpoints(X_temp, edges)
    return Problem(
        body=discretise(X / L0, elements),
        X_temp=X_temp / L0,
        clamp=clamp,
        faces=table.boundary,
        face_tets=table.boundary_tets,
        neighbours=table.interior_tets,
        neighbour_areas=areas / L0**2,
        area_weights=weights / weights.sum(),
        tpe=_scaled(card.tpe, mu0),
        rubbery=_scaled(card.rubbery, mu0),
        glassy=_scaled(card.glassy, mu0),
        length=L0,
        force=mu0 * L0**2,
    )


def at_nodes(problem: Problem, x: FloatArray) -> FloatArray:
    """Vertex positions (n, 3) at all nodes (N, 3) of the problem: mid-edge nodes half-way; those of all nodes as they
    are."""
    if problem.body.order == 1 or len(x) == problem.n_nodes:
        return x
    edges, _ = unique_edges(problem.body.elements[:, :4])
    return with_midpoints(x, edges)


def face_nodes(problem: Problem, faces: IntArray) -> IntArray:
    """Nodes (f, 3) or (f, 6: corners, then mid-edge nodes) of boundary faces given by their corners (f, 3)."""
    if problem.body.order == 1:
        return faces
    tets = problem.body.elements[:, :4]
    edges, _ = unique_edges(tets)
    n_vertices = problem.n_nodes - len(edges)
    ends = np.sort(faces[:, [[0, 1], [1, 2], [2, 0]]], axis=2)
    keys = edges[:, 0] * n_vertices + edges[:, 1]
    middle = n_vertices + np.searchsorted(keys, ends[..., 0] * n_vertices + ends[..., 1])
    return np.hstack([faces, middle])
