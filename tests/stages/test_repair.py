"""What repairs of labels change first."""

from typing import Any

import numpy as np
import pytest
from bent_bar import PROFILE, bent_bar

from fab4d.design.equilibria import Equilibria
from fab4d.design.flips import error_modes, whole_flips
from fab4d.design.gauss_newton import equilibrate
from fab4d.design.patches import build_patches, spread_centers
from fab4d.design.reduced import Search, at_rest
from fab4d.io.scene import Goal
from fab4d.mesh.measures import tet_volumes
from fab4d.stages import _repair
from fab4d.stages._design import problem_of
from fab4d.stages._repair import repaired
from fab4d.stages.threshold import labels_for


@pytest.fixture(scope="module")
def mesh() -> dict[str, np.ndarray]:
    return bent_bar((9, 2, 2), 20.0)


@pytest.fixture(scope="module")
def found(mesh: dict[str, np.ndarray]) -> Search:
    """Labels with much to repair, held at three points where the wanted shape has them."""
    problem = problem_of(mesh, PROFILE["materials"], "linear")
    equilibria = Equilibria(problem, build_patches(problem, spread_centers(problem, 3), 4.0 / problem.length))
    rho = (np.random.default_rng(0).random(problem.n_tets) < 0.4).astype(np.float64)
    held = equilibria.patches.mean(problem.X_temp)
    design = equilibrate(equilibria, rho, held, problem.X_temp, np.zeros((3, 3)), problem.X_temp, max_iterations=60)
    assert design is not None
    return Search(equilibria, design)


def cost_of(mesh: dict[str, np.ndarray], found: Search, goal: Goal) -> np.ndarray:
    cost, smp = repaired(mesh, PROFILE["printer"], goal, found)
    np.testing.assert_array_equal(smp, labels_by(mesh, found, cost))
    return cost


def by_volume(mesh: dict[str, np.ndarray]) -> np.ndarray:
    volumes = tet_volumes(mesh["X"], mesh["tets"])
    return volumes / volumes.mean()


def labels_by(mesh: dict[str, np.ndarray], found: Search, cost: np.ndarray) -> Any:
    return labels_for(mesh["X"], mesh["tets"], found.design.rho, cost, PROFILE["printer"]).smp


def test_repairs_go_by_influence_where_that_promises_a_smaller_error(
    mesh: dict[str, np.ndarray], found: Search, monkeypatch: pytest.MonkeyPatch
) -> None:
    change, error = whole_flips(error_modes(found.equilibria, found.design), found.design.rho)

    def left(smp: np.ndarray) -> float:
        return float(np.linalg.norm(error + change[smp != (found.design.rho > 0.5)].sum(axis=0)))

    monkeypatch.setattr(_repair, "CLEARLY_BETTER", np.inf)
    other = cost_of(mesh, found, Goal())
    assert not np.allclose(other, by_volume(mesh))
    ratio = left(labels_by(mesh, found, other))
    ratio /= left(labels_by(mesh, found, by_volume(mesh)))
    for limit, expected in ((1.01 * ratio, other), (0.99 * ratio, by_volume(mesh))):
        monkeypatch.setattr(_repair, "CLEARLY_BETTER", limit)
        np.testing.assert_allclose(cost_of(mesh, found, Goal()), expected, rtol=1e-12)


def test_repairs_keep_to_the_share_of_smp(
    mesh: dict[str, np.ndarray], found: Search, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(_repair, "CLEARLY_BETTER", np.inf)
    share = by_volume(mesh)[labels_by(mesh, found, cost_of(mesh, found, Goal()))].sum() / len(mesh["tets"])
    kept = cost_of(mesh, found, Goal(max_smp_fraction=share + 1e-6))
    assert not np.allclose(kept, by_volume(mesh))
    np.testing.assert_allclose(cost_of(mesh, found, Goal(max_smp_fraction=share - 1e-6)), by_volume(mesh))


def test_without_points_volumes_count(mesh: dict[str, np.ndarray]) -> None:
    rest = at_rest(problem_of(mesh, PROFILE["materials"], "linear"))
    np.testing.assert_allclose(cost_of(mesh, rest, Goal()), by_volume(mesh))
