"""What repairs of labels change first."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from bent_bar import PROFILE, bent_bar

from fab4d.design.equilibria import Equilibria
from fab4d.design.flips import FlipSettings, at_interface, error_left
from fab4d.design.gauss_newton import equilibrate
from fab4d.design.influence import influence
from fab4d.design.objective import ObjectiveWeights
from fab4d.design.patches import build_patches, spread_centers
from fab4d.design.reduced import Search, at_rest
from fab4d.fabrication.annealing import annealer
from fab4d.mesh.measures import tet_volumes
from fab4d.stages import _repair
from fab4d.stages._design import problem_of
from fab4d.stages._repair import Repair, repaired
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


@pytest.fixture(scope="module")
def flips(mesh: dict[str, np.ndarray]) -> FlipSettings:
    """All labels can be printed that pinch nothing."""
    volumes = by_volume(mesh) / len(mesh["tets"])
    return FlipSettings(printable=lambda smp: smp, annealed=annealer(mesh["tets"], volumes), target_rms=0.0)


WEIGHTS = ObjectiveWeights(error_scale=5e-3)


def by_volume(mesh: dict[str, np.ndarray]) -> np.ndarray:
    volumes = tet_volumes(mesh["X"], mesh["tets"])
    return volumes / volumes.mean()


def labels_by(mesh: dict[str, np.ndarray], found: Search, cost: np.ndarray) -> Any:
    return labels_for(mesh["X"], mesh["tets"], found.design.rho, cost, PROFILE["printer"]).smp


def predicted(found: Search, repair: Repair) -> float:
    all_flips = influence(found.equilibria, found.design, np.arange(len(repair.smp)), WEIGHTS)
    return error_left(all_flips, found.design.rho > 0.5, repair.smp)


def test_the_repair_of_the_smallest_predicted_error_is_taken(
    mesh: dict[str, np.ndarray], found: Search, flips: FlipSettings, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of two, the second is taken where it promises clearly less."""
    away = ~at_interface(found.equilibria.problem, found.design.rho > 0.5)
    other = by_volume(mesh) * np.random.default_rng(1).lognormal(size=len(mesh["tets"])) * np.where(away, 1e3, 1.0)
    monkeypatch.setattr(_repair, "_other_costs", lambda cost, flips, more: [other])  # noqa: ARG005
    monkeypatch.setattr(_repair, "CLEARLY_BETTER", 0.0)
    usual = repaired(mesh, PROFILE["printer"], flips, found, WEIGHTS)
    np.testing.assert_allclose(usual.cost, by_volume(mesh))
    monkeypatch.setattr(_repair, "CLEARLY_BETTER", np.inf)
    second = repaired(mesh, PROFILE["printer"], flips, found, WEIGHTS)
    np.testing.assert_allclose(second.cost, other)
    ratio = predicted(found, second) / predicted(found, usual)
    for limit, expected in ((1.01 * ratio, second), (0.99 * ratio, usual)):
        monkeypatch.setattr(_repair, "CLEARLY_BETTER", limit)
        np.testing.assert_array_equal(repaired(mesh, PROFILE["printer"], flips, found, WEIGHTS).cost, expected.cost)


def test_no_repair_is_taken_whose_influence_is_not_known(
    mesh: dict[str, np.ndarray], found: Search, flips: FlipSettings, monkeypatch: pytest.MonkeyPatch
) -> None:
    inside = np.flatnonzero(~at_interface(found.equilibria.problem, found.design.rho > 0.5))
    assert len(inside)
    usual = labels_for

    def deep(X: Any, tets: Any, rho: Any, cost: Any, printer: Any) -> Any:
        made = usual(X, tets, rho, cost, printer)
        if cost[0] != -1.0:
            return made
        smp = made.smp.copy()
        smp[inside] = ~smp[inside]
        return replace(made, smp=smp)

    marked = np.r_[-1.0, by_volume(mesh)[1:]]
    monkeypatch.setattr(_repair, "labels_for", deep)
    monkeypatch.setattr(_repair, "_other_costs", lambda cost, flips, more: [marked])  # noqa: ARG005
    monkeypatch.setattr(_repair, "CLEARLY_BETTER", 1e9)
    np.testing.assert_allclose(repaired(mesh, PROFILE["printer"], flips, found, WEIGHTS).cost, by_volume(mesh))


def test_a_repair_is_made_up_for(
    mesh: dict[str, np.ndarray], found: Search, flips: FlipSettings, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(_repair, "CLEARLY_BETTER", 0.0)
    made = repaired(mesh, PROFILE["printer"], flips, found, WEIGHTS)
    plain = Repair(made.cost, labels_by(mesh, found, made.cost))
    assert predicted(found, made) < 0.9 * predicted(found, plain)


def test_repairs_keep_to_the_share_of_smp(mesh: dict[str, np.ndarray], found: Search, flips: FlipSettings) -> None:
    free = repaired(mesh, PROFILE["printer"], flips, found, WEIGHTS)
    share = by_volume(mesh)[free.smp].sum() / len(mesh["tets"])
    least = by_volume(mesh)[labels_by(mesh, found, by_volume(mesh))].sum() / len(mesh["tets"])
    kept = repaired(mesh, PROFILE["printer"], replace(flips, max_smp_fraction=share - 0.02), found, WEIGHTS)
    assert by_volume(mesh)[kept.smp].sum() / len(mesh["tets"]) <= max(share - 0.02, least) + 1e-12


def test_without_points_volumes_count(mesh: dict[str, np.ndarray], flips: FlipSettings) -> None:
    rest = at_rest(problem_of(mesh, PROFILE["materials"], "linear"))
    np.testing.assert_allclose(repaired(mesh, PROFILE["printer"], flips, rest, WEIGHTS).cost, by_volume(mesh))
