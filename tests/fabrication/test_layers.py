"""What lines leave empty of known cross-sections, and that noise is cleaned until they leave little."""

import numpy as np
import pytest

from fab4d.fabrication import labels
from fab4d.fabrication.bodies import bodies_from_labels
from fab4d.fabrication.labels import MAX_UNFILLED, Lines, printable_labels
from fab4d.fabrication.layers import FEW_LEVELS, MOST_LEVELS, Unfilled, unfilled

LINES = Lines(0.42, 0.2, 0.84, 0.4)


def test_corners_of_a_square_stay_empty(meshes):
    X, tets = meshes["box"]((4, 4, 2), size=0.5)
    found = unfilled(bodies_from_labels(X, tets, np.zeros(len(tets), bool)), 0.4, 0.2)["tpe"]
    # A disc of radius r leaves (4 - pi) r^2 in four right corners.
    assert found.share == pytest.approx((4 - np.pi) * 0.2**2 / 4, rel=0.1)
    assert found.share_inside == 0
    assert np.abs(np.abs(np.array(found.where[:2]) - 1) - 1).max() < 0.11


def test_a_wall_thinner_than_a_line_stays_empty_and_the_interface_is_to_blame(meshes):
    X, tets = meshes["box"]((10, 10, 2), size=0.3)
    wall = X[tets].mean(axis=1)[:, 0] < 0.3
    found = unfilled(bodies_from_labels(X, tets, wall), 0.4, 0.2)
    assert found["smp"].share == pytest.approx(1)
    assert 0.95 < found["smp"].share_inside < 1  # but for the part's own corners
    assert found["smp"].where[:2] == pytest.approx((0.15, 1.5), abs=1e-3)
    assert found["tpe"].share_inside < 0.01


def test_what_the_part_itself_is_to_blame_for_is_told_apart(meshes):
    X, tets = meshes["box"]((10, 1, 4), size=0.3)
    found = unfilled(bodies_from_labels(X, tets, X[tets].mean(axis=1)[:, 0] < 1.5), 0.4, 0.2)
    assert found["smp"].share == found["tpe"].share == pytest.approx(1)
    assert found["smp"].share_inside == found["tpe"].share_inside == pytest.approx(0, abs=1e-9)


@pytest.mark.parametrize(("cell", "grows"), [(1.4, True), (2.0, False)])
def test_noise_is_cleaned_until_lines_fill_the_bodies(meshes, cell, grows):
    X, tets = meshes["box"]((6, 6, 6), size=cell)
    smp = np.random.default_rng(1).random(len(tets)) < 0.5
    result = printable_labels(X, tets, smp, LINES)
    assert (result.feature[0] > LINES.feature_xy) == (result.changed_fraction["larger_features"] > 0) == grows
    bodies = bodies_from_labels(X, tets, result.smp)
    assert max(body.share_inside for body in unfilled(bodies, 0.42, 0.2).values()) <= MAX_UNFILLED


def test_a_design_is_not_cleaned_away_for_its_corners(meshes):
    X, tets = meshes["box"]((8, 8, 8), size=0.8)
    blob = meshes["blob"](X, tets)
    result = printable_labels(X, tets, blob, LINES)
    bodies = bodies_from_labels(X, tets, result.smp)
    assert unfilled(bodies, 0.42, 0.2)["smp"].share_inside > MAX_UNFILLED
    assert result.changed_fraction["total"] < 0.03


@pytest.mark.parametrize(("seen", "looks"), [(0.4, [FEW_LEVELS]), (0.6, [FEW_LEVELS, MOST_LEVELS])])
def test_all_layers_are_looked_at_where_few_leave_much_empty(meshes, monkeypatch, seen, looks):
    """seen : of what may be left empty, in every layer"""
    X, tets = meshes["box"]((8, 4, 4), size=1.5)
    asked = []

    def told(bodies, _width, _height, most_levels):
        asked.append(most_levels)
        return {body.name: Unfilled(1.0, seen * MAX_UNFILLED, None) for body in bodies.printed}

    monkeypatch.setattr(labels, "unfilled", told)
    printable_labels(X, tets, X[tets].mean(axis=1)[:, 0] < 6.0, LINES)
    assert asked == looks


def test_few_layers_are_spread_over_the_height(meshes):
    """Walls thinner than a line in the upper half alone."""
    X, tets = meshes["box"]((10, 4, 16), size=0.3)
    x, _, z = X[tets].mean(axis=1).T
    bodies = bodies_from_labels(X, tets, x < np.where(z > 2.4, 0.3, 1.5))
    few, many = (unfilled(bodies, 0.4, 0.1, levels)["smp"].share_inside for levels in (FEW_LEVELS, MOST_LEVELS))
    assert few == pytest.approx(many, rel=0.1)
    assert many == pytest.approx(0.3 / 1.8, rel=0.1)
