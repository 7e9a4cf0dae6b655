"""Exchanging points: the linear model against differences, and a point that is missing found."""

import itertools
from dataclasses import replace

import numpy as np
import pytest
from bars import TIGHT, bar, corner, held_design, mixed_density

from fab4d.design import exchange, reduced
from fab4d.design.equilibria import Equilibria
from fab4d.design.exchange import (
    _separate_patches,
    _shape_by_force,
    better_points,
    candidate_centers,
    exchanged,
    force_model,
    held_apart,
    worst_centers,
)
from fab4d.design.forward import balance
from fab4d.design.gauss_newton import Design, Model, build_model
from fab4d.design.objective import ObjectiveWeights, shape_error, smoothness_matrix
from fab4d.design.patches import build_patches
from fab4d.design.problem import Problem
from fab4d.design.reduced import Phase, ReducedSettings, Search, exchange_step

WEIGHTS = ObjectiveWeights(error_scale=1e-3)
RADIUS = 6.0 / 42.0


def held_at(problem: Problem, *places: tuple[float, float, float]) -> Equilibria:
    centers = np.array([corner(problem, place) for place in places])
    return Equilibria(problem, build_patches(problem, centers, RADIUS))


def model_at(equilibria: Equilibria, design: Design) -> Model:
    return build_model(equilibria, WEIGHTS, smoothness_matrix(equilibria.problem), design)


@pytest.fixture(scope="module")
def bent() -> tuple[Equilibria, Design]:
    """Held at the tip and at a place near the clamp where a force does little."""
    problem = bar(cells=(6, 2, 2), degrees=50.0)
    equilibria = held_at(problem, (1.0, 0.5, 1.0), (0.3, 0.5, 1.0))
    return equilibria, held_design(equilibria, mixed_density(problem), problem.X_temp)


def test_the_shape_follows_a_force_as_the_model_says() -> None:
    """A force at a candidate while the forces at the points stay what they are, by central differences."""
    problem = bar(cells=(4, 2, 2), degrees=4.0)  # stable with these loads hanging
    equilibria = held_at(problem, (1.0, 0.5, 1.0))
    design = held_design(equilibria, mixed_density(problem), problem.X_temp)
    candidates = _separate_patches(problem, np.array([corner(problem, (0.7, 1.0, 0.5))]), RADIUS)
    model, force = model_at(equilibria, design), np.array([[0.3, -0.5, 0.8]])
    expected = _shape_by_force(model, candidates, problem.n_nodes)[:, 3:] @ force.ravel()
    free = Equilibria(problem, build_patches(problem, np.zeros(0, np.int64), 0.0))
    loads = equilibria.patches.spread(design.median.forces, problem.n_nodes)
    h, none = 1e-6, np.zeros((0, 3))

    def shape(sign: float) -> np.ndarray:
        extra = loads + candidates.spread(sign * h * force, problem.n_nodes)
        median = free.solve_median(design.rho, none, design.median.x, none, TIGHT, 40, extra)
        final = free.solve_final(design.rho, median, design.final.y, TIGHT, 40)
        assert median.solution.converged
        assert final.solution.converged
        return final.y.ravel()

    found = (shape(1.0) - shape(-1.0)) / (2 * h)
    # The metric does not see rigid motions, which are free.
    seen, right = model.metric.apply(found), model.metric.apply(expected)
    np.testing.assert_allclose(seen, right, atol=1e-4 * np.abs(right).max())


def test_a_point_goes_where_it_helps(bent: tuple[Equilibria, Design]) -> None:
    equilibria, design = bent
    problem = equilibria.problem
    other, after = next(exchanged(equilibria, WEIGHTS, model_at(equilibria, design), design, RADIUS))
    assert other.patches.count == 2
    assert set(other.patches.centers.tolist()) != set(equilibria.patches.centers.tolist())
    # The other forces have gone to exactly zero: the shapes are in equilibrium with the points' forces alone.
    left = balance(other, after.rho, after.median, after.final)
    assert left.median < 1e-4
    assert left.final < 1e-4
    assert after.median.forces.shape == (2, 3)
    assert np.abs(problem.X_temp - after.final.y).max() < 0.5


def test_a_point_that_helps_little_goes_where_two_shapes_differ_most(bent: tuple[Equilibria, Design]) -> None:
    equilibria, design = bent
    problem = equilibria.problem
    place = corner(problem, (0.7, 1.0, 0.5))
    away = np.exp(-(np.linalg.norm(problem.body.X - problem.body.X[place], axis=1) ** 2) / 0.02)
    other = design.median.x + 0.1 * away[:, None] * [0.0, 0.6, 0.8]
    moved = held_apart(equilibria, WEIGHTS, model_at(equilibria, design), design, other, RADIUS)
    assert moved is not None
    found, after = moved
    assert found.patches.centers.tolist() == [corner(problem, (1.0, 0.5, 1.0)), place]
    left = balance(found, after.rho, after.median, after.final)
    assert max(left.median, left.final) < 1e-4


def test_no_point_moves_to_where_others_are(bent: tuple[Equilibria, Design]) -> None:
    """All vertices are within a radius of a point; and shapes that differ most at a point differ next to it as well."""
    equilibria, design = bent
    problem, model = equilibria.problem, model_at(equilibria, design)
    assert held_apart(equilibria, WEIGHTS, model, design, design.median.x, 2.0) is None
    tip = problem.body.X[corner(problem, (1.0, 0.5, 1.0))]
    apart = np.exp(-np.linalg.norm(problem.body.X - tip, axis=1))
    moved = held_apart(equilibria, WEIGHTS, model, design, design.median.x + 0.1 * apart[:, None], RADIUS)
    assert moved is not None
    assert np.linalg.norm(problem.body.X[moved[0].patches.centers[-1]] - tip) > RADIUS


def test_the_step_keeps_an_exchange_only_where_the_objective_falls(bent: tuple[Equilibria, Design]) -> None:
    equilibria, design = bent
    problem = equilibria.problem
    L = smoothness_matrix(problem)
    settings = ReducedSettings(2, (RADIUS,), WEIGHTS)
    start = Search(equilibria, design, RADIUS, Phase.EXCHANGE)
    end = exchange_step(start, settings, L)
    before, after = (shape_error(problem, s.design.final.y).rms for s in (start, end))
    assert end.phase is Phase.RELAX
    assert end.exchanges == 1
    assert after < 0.8 * before
    lax = replace(settings, weights=WEIGHTS.replace(error_scale=1.0))
    assert exchange_step(start, lax, L).equilibria is equilibria


def test_another_exchange_is_tried_where_the_first_comes_to_nothing(
    bent: tuple[Equilibria, Design], monkeypatch: pytest.MonkeyPatch
) -> None:
    equilibria, design = bent
    L, weights = smoothness_matrix(equilibria.problem), WEIGHTS
    good = next(exchanged(equilibria, weights, model_at(equilibria, design), design, RADIUS))
    nowhere = held_at(equilibria.problem, (0.3, 0.0, 0.0), (0.3, 1.0, 0.0))
    bad = nowhere, held_design(nowhere, design.rho, equilibria.problem.body.X)
    start = Search(equilibria, design, RADIUS, Phase.EXCHANGE)
    for offered, expected in (([bad, good], good[0]), ([bad], equilibria), ([], equilibria)):
        monkeypatch.setattr(reduced, "exchanged", lambda *_, offered=offered: iter(offered))
        assert exchange_step(start, ReducedSettings(2, (RADIUS,), weights), L).equilibria is expected


def test_each_further_exchange_promises_more(bent: tuple[Equilibria, Design], monkeypatch: pytest.MonkeyPatch) -> None:
    """While the tolerance is missed, an exchange that promises little is better than none."""
    equilibria, design = bent
    problem = equilibria.problem
    centers = candidate_centers(problem, equilibria.patches, shape_error(problem, design.final.y).e, RADIUS)
    candidates = _separate_patches(problem, centers, RADIUS)
    forces = force_model(equilibria, WEIGHTS, model_at(equilibria, design), design, candidates)
    better = better_points(forces, 2)
    values = [forces.without([0, 1], [])]
    values += [forces.without(points, sorted({0, 1} - set(points))) for points in better]
    assert len(better) > 0
    assert all(after < 0.99 * before for before, after in itertools.pairwise(values))
    assert all(len(set(a) - set(b)) == 1 for a, b in itertools.pairwise([[0, 1], *better]))
    monkeypatch.setattr(exchange, "LEAST_GAIN", 1.0)  # no exchange gains everything
    assert better_points(forces, 2) == better
    H, gradient, ridge = (term / forces.value for term in (forces.H, forces.gradient, forces.ridge))
    assert better_points(replace(forces, H=H, gradient=gradient, value=1.0, ridge=ridge), 2) == []


def test_the_model_knows_what_the_held_points_do(bent: tuple[Equilibria, Design]) -> None:
    """Without candidates the best change of forces is that of the held positions."""
    equilibria, design = bent
    problem = equilibria.problem
    candidates = _separate_patches(problem, np.array([corner(problem, (0.7, 1.0, 0.5))]), RADIUS)
    model = model_at(equilibria, design)
    forces = replace(force_model(equilibria, WEIGHTS, model, design, candidates), ridge=np.full(9, 1e-12))
    gain = 0.5 * model.gradient_c @ np.linalg.solve(model.H_cc, model.gradient_c)
    assert forces.without([0, 1], []) == pytest.approx(forces.value - gain, rel=1e-3)
    assert forces.without([0, 1, 2], []) <= forces.without([0, 1], [])
    assert forces.without([0], [1]) >= forces.without([0, 1], [])


def test_the_worst_places_are_apart() -> None:
    problem = bar(cells=(6, 2, 2))
    e = problem.body.X[:, :1] * np.ones(3)
    worst = worst_centers(problem, e, 4, RADIUS)
    X = problem.body.X[worst]
    assert X[0, 0] == problem.body.X[:, 0].max()
    gaps = np.linalg.norm(X[:, None] - X[None], axis=2)[~np.eye(len(X), dtype=bool)]
    assert gaps.min() > 2 * RADIUS
