"""Flipping labels: known labels found again, and repairs that are made up for."""

from dataclasses import replace

import numpy as np
import pytest
from bars import bar, held_design, two_patches
from labelling import WEIGHTS, at_all_tets, freely, recording, upper_half

from fab4d.design import flips
from fab4d.design.flips import (
    HELD_BACK,
    at_interface,
    compensated,
    error_left,
    flip,
    mended,
    near_interface,
    predicted,
    too_far,
)
from fab4d.design.gauss_newton import equilibrate, held_positions
from fab4d.design.influence import FlipEnergy
from fab4d.design.objective import shape_error
from fab4d.design.reduced import refit
from fab4d.fabrication.wellcomposed import pinched_vertices, well_composed


def test_flips_keep_to_the_share_of_smp() -> None:
    problem = bar(degrees=30.0)
    equilibria, smp = two_patches(problem), upper_half(problem)
    found = at_all_tets(equilibria, held_design(equilibria, smp.astype(float), problem.X_temp))
    volumes, half = problem.volume_fractions, float(problem.volume_fractions @ smp)
    assert (flip(problem, found, smp, smp, freely(problem), 0.0, 500) & ~smp).any()
    for share in (0.0, half + 1e-9, half + 0.02):
        settings = replace(freely(problem), max_smp_fraction=share)
        flipped = flip(problem, found, smp, smp, settings, 0.0, 500)
        assert (flipped != smp).any()
        assert volumes @ flipped <= max(share, half)


def test_flips_lower_the_predicted_error_and_fewer_are_made_where_they_are_dear() -> None:
    problem = bar(cells=(6, 3, 2), degrees=30.0)
    equilibria, smp = two_patches(problem), upper_half(problem)
    found = at_all_tets(equilibria, held_design(equilibria, smp.astype(float), problem.X_temp))
    made = [flip(problem, found, smp, smp, freely(problem), price, 500) for price in (0.0, 1e-2, 10.0)]
    left, count = [error_left(found, smp, each) for each in made], [int((each != smp).sum()) for each in made]
    assert left[0] < left[1] < left[2]
    assert count[0] > count[1] > count[2] == 0
    assert left[2] == pytest.approx(np.linalg.norm(found.residual), rel=0.05)


def test_few_candidates_get_more_steps_each(monkeypatch: pytest.MonkeyPatch) -> None:
    """Three times as many where there are a third of many, and no more than so many times."""
    problem = bar(degrees=30.0)
    equilibria, smp = two_patches(problem), upper_half(problem)
    found, given = at_all_tets(equilibria, held_design(equilibria, smp.astype(float), problem.X_temp)), list[int]()

    def annealed(labels: np.ndarray, _energy: FlipEnergy, _room: float, steps: int, _seed: int) -> np.ndarray:
        given.append(steps)
        return labels

    settings, count = replace(freely(problem), annealed=annealed), len(found.tets)
    for many in (count // 2, 3 * count, 100 * count):
        monkeypatch.setattr(flips, "MANY_CANDIDATES", many)
        flip(problem, found, smp, smp, settings, 0.0, 10)
    assert given == [10, 30, 10 * flips.MORE_STEPS]


def test_a_repair_is_made_up_for() -> None:
    """Tets that were changed by force may be given back, or others changed: the predicted error falls."""
    problem = bar(cells=(6, 3, 2), degrees=30.0)
    equilibria, smp = two_patches(problem), upper_half(problem)
    found = at_all_tets(equilibria, held_design(equilibria, smp.astype(float), problem.X_temp))
    repair = smp.copy()
    repair[np.flatnonzero(at_interface(problem, smp))[::5]] ^= True
    better = compensated(problem, found, smp, repair, freely(problem))
    assert error_left(found, smp, better) < 0.9 * error_left(found, smp, repair)

    others = [repair ^ (np.arange(problem.n_tets) == tet) for tet in range(problem.n_tets)]
    worst = max(others, key=lambda labels: error_left(found, smp, labels))
    kept = compensated(problem, found, smp, repair, replace(freely(problem), printable=lambda labels: worst))  # noqa: ARG005
    np.testing.assert_array_equal(kept, repair)


def test_pinched_labels_are_mended_near_the_wanted_shape() -> None:
    """Better than by the flips that change the least volume, and without doubt."""
    problem = bar(cells=(6, 3, 2), degrees=30.0)
    tets, volumes = problem.body.elements[:, :4], problem.volume_fractions
    equilibria, smp = two_patches(problem), upper_half(problem)
    smp[np.flatnonzero(at_interface(problem, smp))[::3]] ^= True
    assert len(pinched_vertices(tets, smp))
    design = held_design(equilibria, smp.astype(float), problem.X_temp)
    energies, asked, found = list[FlipEnergy](), list[np.ndarray](), at_all_tets(equilibria, design)
    settings = replace(recording(freely(problem), energies), printable=lambda labels: asked.append(labels) or ~labels)
    labels = ~mended(problem, found, smp, settings)
    assert len(energies) == 1
    np.testing.assert_array_equal(energies[0].doubts, found.unseen)
    np.testing.assert_array_equal(labels, asked[0])
    assert len(pinched_vertices(tets, labels)) == 0
    errors = []
    for each in (labels, well_composed(tets, smp, volumes)):
        held, median = held_positions(equilibria, design.median), design.median
        other = equilibrate(equilibria, each.astype(float), held, median.x, median.forces, design.final.y)
        assert other is not None
        errors.append(shape_error(problem, refit(equilibria, other, WEIGHTS, lambda at: None, 3).final.y).rms)  # noqa: ARG005
    assert errors[0] < errors[1]


def test_near_the_interface_are_tets_with_an_edge_of_its_tets() -> None:
    problem = bar(cells=(12, 2, 2))
    corners = problem.body.elements[:, :4]
    smp = problem.body.X[corners].mean(axis=1)[:, 0] > 0.5 * problem.body.X[:, 0].max()
    vertices = set(corners[at_interface(problem, smp)].ravel().tolist())
    expected = [len(vertices & set(tet)) >= 2 for tet in corners.tolist()]
    np.testing.assert_array_equal(near_interface(problem, smp), expected)
    assert 0 < np.mean(expected) < 1


def test_predicted_moves_are_held_back_until_none_is_too_long(monkeypatch: pytest.MonkeyPatch) -> None:
    """And no more than that: by one step of the damping less, one of them would be."""
    problem = bar(cells=(6, 3, 2), degrees=40.0)
    equilibria, smp = two_patches(problem), upper_half(problem)
    found = at_all_tets(equilibria, held_design(equilibria, smp.astype(float), problem.X_temp))
    free = float(np.abs(predicted(found, smp, ~smp).moves).max())
    monkeypatch.setattr(flips, "LARGEST_MOVE", 0.1 * free)
    assert 0 < np.abs(predicted(found, smp, ~smp).moves).max() <= 0.1 * free
    factor = next(k for k in range(20) if not too_far(found.damped(HELD_BACK**k).after(~smp | smp).moves))
    np.testing.assert_allclose(
        predicted(found, smp, ~smp).moves.ravel(), found.damped(HELD_BACK**factor).after(~smp | smp).moves
    )
