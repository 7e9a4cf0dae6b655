"""A design of a coarse mesh, carried over to the fine one of the same part."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from bars import CARD, SIZE, bar, corner, held_design

from fab4d.design import levels
from fab4d.design.equilibria import Equilibria
from fab4d.design.forward import balance
from fab4d.design.gauss_newton import held_positions
from fab4d.design.levels import Level, carried_up, level_of
from fab4d.design.patches import build_patches
from fab4d.design.problem import build_problem
from fab4d.design.reduced import Search
from fab4d.mesh.coarsening import coarsened
from fab4d.mesh.measures import deformation_gradients

DENSE = 6.0
"""Patch radius, mm."""


@pytest.fixture(scope="module")
def level() -> Level:
    fine = bar((15, 4, 4), 20.0)
    X, X_temp, tets = fine.body.X * fine.length, fine.X_temp * fine.length, fine.body.elements
    mesh = coarsened(X, X_temp, tets, fine.clamp, len(tets) // 4)
    kept = mesh.vertices
    return level_of(build_problem(X[kept], X_temp[kept], mesh.tets, fine.clamp[kept], CARD), fine, kept)


@pytest.fixture(scope="module")
def found(level: Level) -> Search:
    """SMP in the half of the bar beyond its middle, bent at the tip."""
    coarse = level.coarse
    radius = DENSE / coarse.length
    centers = np.array([corner(coarse, (1.0, 0.5, 1.0)), corner(coarse, (0.6, 1.0, 0.5))])
    equilibria = Equilibria(coarse, build_patches(coarse, centers, radius))
    middle = coarse.body.X[coarse.body.elements].mean(axis=1)[:, 0] * coarse.length
    rho = (middle > SIZE[0] / 2).astype(np.float64)
    return Search(equilibria, held_design(equilibria, rho, coarse.X_temp), radius, relaxed_rms=0.01)


def test_a_design_is_carried_over_in_equilibrium(level: Level, found: Search) -> None:
    up = carried_up(level, found)
    assert up is not None
    fine, design = level.fine, up.design
    assert up.relaxed_rms * fine.length == pytest.approx(found.relaxed_rms * level.coarse.length)
    left = balance(up.equilibria, design.rho, design.median, design.final)
    assert max(left.median, left.final) < 1e-4
    X = fine.body.X * fine.length
    coarse_X = level.coarse.body.X * level.coarse.length
    np.testing.assert_allclose(X[up.equilibria.patches.centers], coarse_X[found.equilibria.patches.centers])
    middle = X[fine.body.elements].mean(axis=1)[:, 0]
    clear = np.abs(middle - SIZE[0] / 2) > 5.0
    np.testing.assert_array_equal(design.rho[clear], middle[clear] > SIZE[0] / 2)
    apart = held_positions(up.equilibria, design.median) * fine.length
    apart -= held_positions(found.equilibria, found.design.median) * level.coarse.length
    assert np.abs(apart).max() < 0.1 * DENSE
    moved = design.final.y[level.vertices] * fine.length - found.design.final.y * level.coarse.length
    assert np.abs(moved).max() < 0.05 * SIZE[0]


def test_tets_that_turn_over_on_the_way_are_mended(
    level: Level, found: Search, monkeypatch: pytest.MonkeyPatch
) -> None:
    usual, closest = carried_up(level, found), levels.closest_shape
    body, outer = level.fine.body, np.union1d(level.fine.faces, np.flatnonzero(level.fine.clamp))
    inner = np.setdiff1d(np.arange(level.fine.n_nodes), np.union1d(level.vertices, outer))[:2]
    turned = []

    def through_its_tets(*args: Any) -> np.ndarray:
        shape = closest(*args)
        shape[inner, 2] += 0.08
        turned.append(np.linalg.det(deformation_gradients(body.X, shape, body.elements)).min())
        return shape

    monkeypatch.setattr(levels, "closest_shape", through_its_tets)
    up = carried_up(level, found)
    assert len(inner)
    assert max(turned) < 0
    assert usual is not None
    assert up is not None
    np.testing.assert_allclose(up.design.median.x, usual.design.median.x, atol=1e-4)
    np.testing.assert_allclose(up.design.final.y, usual.design.final.y, atol=1e-4)


def test_without_an_equilibrium_nothing_is_carried_over(
    level: Level, found: Search, monkeypatch: pytest.MonkeyPatch
) -> None:
    upside_down = replace(found.design.median, x=found.design.median.x * [1.0, 1.0, -1.0])
    assert carried_up(level, replace(found, design=replace(found.design, median=upside_down))) is None
    monkeypatch.setattr(levels, "carried_over", lambda *_: None)
    assert carried_up(level, found) is None
