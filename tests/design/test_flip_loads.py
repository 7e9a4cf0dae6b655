"""The small systems around flipped tets against the matrices that they are cut out of."""

import numpy as np
import pytest
from bars import bar, held_design, mixed_density, two_patches
from scipy.sparse import csc_array

from fab4d.design import _star_kernels as kernels
from fab4d.design import flip_loads as module
from fab4d.design.equilibria import Equilibria
from fab4d.design.flip_loads import flip_loads
from fab4d.design.gauss_newton import Design
from fab4d.design.sensitivity import linearise
from fab4d.mesh.topology import TET_EDGES, cells_by_vertex


@pytest.fixture(scope="module", params=["linear", "quadratic"])
def state(request: pytest.FixtureRequest) -> tuple[Equilibria, Design]:
    problem = bar(cells=(4, 2, 2), degrees=35.0, element=request.param)
    equilibria = two_patches(problem)
    return equilibria, held_design(equilibria, np.round(mixed_density(problem)), problem.X_temp)


def at_vertex(elements: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    return cells_by_vertex(elements[:, :4], int(elements[:, :4].max()) + 1)


def around(equilibria: Equilibria, tet: int) -> np.ndarray:
    elements = equilibria.problem.body.elements
    local = np.full(equilibria.problem.n_nodes, -1)
    nodes = kernels.nodes_around(tet, elements, TET_EDGES, *at_vertex(elements), local)
    assert (local == -1).all()
    return nodes


def whole(equilibria: Equilibria, design: Design) -> np.ndarray:
    """(3N, 3N) tangent of the final shape."""
    pattern = equilibria.free_pattern
    data = equilibria.final_tangent(design.rho, design.median, design.final.y)
    lower = csc_array((data, pattern.indices, pattern.indptr), shape=(pattern.n_dofs,) * 2).toarray()
    return lower + np.tril(lower, -1).T


def dofs(nodes: np.ndarray) -> np.ndarray:
    return (3 * nodes[:, None] + np.arange(3)).ravel()


def test_nodes_around_a_tet_are_those_nearest_to_it(state: tuple[Equilibria, Design]) -> None:
    """Vertices that share a tet with one of its own, and the middles of edges at its own."""
    equilibria, _ = state
    elements, X = equilibria.problem.body.elements, equilibria.problem.body.X
    for tet in (0, 17, 50):
        own = elements[tet]
        star = elements[np.isin(elements[:, :4], own[:4]).any(axis=1)]
        expected = set(star[:, :4].ravel().tolist()) | set(own.tolist())
        for vertex in own[:4]:
            at = star[(star[:, :4] == vertex).any(axis=1)]
            middles = {tuple(np.round((X[vertex] + X[other]) / 2, 9)) for other in np.unique(at[:, :4])}
            expected |= {int(n) for n in np.unique(at[:, 4:]) if tuple(np.round(X[n], 9)) in middles}
        nodes = around(equilibria, tet)
        assert len(nodes) == len(set(nodes.tolist()))
        assert set(nodes.tolist()) == expected
        np.testing.assert_array_equal(nodes[-len(own) :], own)


def test_what_is_cut_out_is_what_the_matrices_have_there(state: tuple[Equilibria, Design]) -> None:
    equilibria, design = state
    K, pattern = whole(equilibria, design), equilibria.free_pattern
    M = linearise(equilibria, design.rho, design.median, design.final).M
    data = equilibria.final_tangent(design.rho, design.median, design.final.y)
    nodes, local = around(equilibria, 17), np.full(equilibria.problem.n_nodes, -1)
    at = dofs(nodes)
    cut = kernels.between(nodes, pattern.indptr, pattern.indices, data, local)
    np.testing.assert_array_equal(cut, np.tril(K[np.ix_(at, at)]))
    z, out = np.random.default_rng(0).normal(size=len(at)), np.zeros(len(at))
    kernels.product(nodes, M.indptr, M.indices, M.data, local, z, out)
    np.testing.assert_allclose(out, M.toarray()[np.ix_(at, at)] @ z, atol=1e-12 * np.abs(M.data).max())


def test_tets_among_nodes_that_give_way_move_as_the_small_system_says(state: tuple[Equilibria, Design]) -> None:
    """By its Cholesky factor, or its inverse where there is none, as of the negative tangent."""
    equilibria, design = state
    K = whole(equilibria, design)
    pattern, mask = equilibria.free_pattern, equilibria.free_mask(design.final.y)
    data = equilibria.final_tangent(design.rho, design.median, design.final.y)
    elements = equilibria.problem.body.elements
    M = linearise(equilibria, design.rho, design.median, design.final).M
    held = int(mask.fixed[0]) // 3
    tets = [17, int(np.flatnonzero((elements == held).any(axis=1))[0])]
    for sign in (1.0, -1.0):
        tangent = module._Tangent(pattern, sign * data, mask)
        for tet, found in zip(
            tets, module._around(elements, at_vertex(elements), tangent, np.array(tets)), strict=True
        ):
            at, size = dofs(found.nodes), 3 * elements.shape[1]
            inverse = np.linalg.inv(sign * K[np.ix_(at, at)])
            free = ~np.isin(dofs(elements[tet]), mask.fixed)
            expected = np.where(free[:, None] & free, inverse[-size:, -size:], 0.0)
            scale = np.abs(inverse).max()
            np.testing.assert_allclose(found.compliance, expected, atol=1e-9 * scale)
            f = np.random.default_rng(0).normal(size=size)
            np.testing.assert_allclose(found.moves(f), inverse[:, -size:] @ (free * f), atol=1e-8 * scale)
            moved = np.random.default_rng(1).normal(size=len(at))
            followed = free * (inverse @ (M.toarray()[np.ix_(at, at)] @ moved))[-size:]
            np.testing.assert_allclose(
                found.follow(M, moved, np.full(equilibria.problem.n_nodes, -1)),
                followed,
                atol=1e-7 * np.abs(followed).max(),
            )


def test_loads_of_all_tets_hold_those_of_some(state: tuple[Equilibria, Design]) -> None:
    equilibria, design = state
    lin = linearise(equilibria, design.rho, design.median, design.final)
    tets = np.arange(0, equilibria.problem.n_tets, 2)
    loads = flip_loads(equilibria, design, lin, tets)
    some = flip_loads(equilibria, design, lin, tets[40:43])
    part = loads.of(np.arange(40, 43))
    for name in ("hot", "cold"):
        all_of, some_of = getattr(part, name).toarray(), getattr(some, name).toarray()
        np.testing.assert_allclose(some_of, all_of, atol=1e-12 * np.abs(all_of).max())
        assert np.abs(all_of).max() > 0
