"""A design of a coarser mesh of the same part, carried over to the fine one."""

from dataclasses import dataclass, replace

import numpy as np

from fab4d.design.equilibria import Equilibria
from fab4d.design.finish import carried_over
from fab4d.design.patches import build_patches
from fab4d.design.problem import Problem
from fab4d.design.reduced import Search
from fab4d.elasticity.untangle import untangle
from fab4d.mesh.coarsening import nearest_tets
from fab4d.mesh.interpolation import closest_shape
from fab4d.mesh.measures import deformation_gradients
from fab4d.mesh.tetmesh import BoolArray, FloatArray, IntArray


@dataclass(frozen=True, eq=False)
class Level:
    """A coarse problem and where it is in the fine one, both of linear elements.

    vertices : (n_c,) fine nodes that are the coarse ones
    tets : (m,) coarse tet around, or nearest to, the middle of each fine one
    """

    coarse: Problem
    fine: Problem
    vertices: IntArray
    tets: IntArray


def level_of(coarse: Problem, fine: Problem, vertices: IntArray) -> Level:
    """The level of a coarse problem whose nodes are `vertices` (n_c,) of the fine one."""
    points = fine.body.X * fine.length
    middles = points[fine.body.elements].mean(axis=1)
    return Level(coarse, fine, vertices, nearest_tets(coarse.body.X * coarse.length, coarse.body.elements, middles))


def carried_up(level: Level, at: Search) -> Search | None:
    """The state of a search on the coarse problem, in equilibrium on the fine one; None where none is found near it."""
    fine, ratio, design = level.fine, level.coarse.length / level.fine.length, at.design
    radius, centers = at.patch_radius * ratio, level.vertices[at.equilibria.patches.centers]
    equilibria = Equilibria(fine, build_patches(fine, centers, radius))
    x = _shape(level, design.median.x, fine.clamp)
    y = _shape(level, design.final.y, np.zeros(fine.n_nodes, bool))
    forces = design.median.forces * (level.coarse.force / fine.force)
    carried = carried_over(equilibria, design.rho[level.tets], x, y, forces)
    if carried is None:
        return None
    relaxed_rms = at.relaxed_rms * ratio
    return replace(at, equilibria=equilibria, design=carried, patch_radius=radius, relaxed_rms=relaxed_rms)


def _shape(level: Level, shape: FloatArray, clamp: BoolArray) -> FloatArray:
    """The coarse `shape` (N_c, 3) on the fine nodes (N, 3), whose tets are deformed as the coarse ones are.

    clamp : (N,) fine nodes that are where the permanent shape has them
    Interpolated between the coarse nodes instead, tets outside the coarse surface may turn over. Where tets are much
    squeezed some do so even then, and are mended.
    """
    coarse, X, tets = level.coarse, level.fine.body.X, level.fine.body.elements
    F = deformation_gradients(coarse.body.X, shape, coarse.body.elements)[level.tets]
    goal = X.copy()
    goal[level.vertices] = shape * (coarse.length / level.fine.length)
    goal[clamp] = X[clamp]
    fixed = np.union1d(level.vertices, np.flatnonzero(clamp))
    return untangle(X, closest_shape(X, tets, F, fixed, goal), tets, clamp).x
