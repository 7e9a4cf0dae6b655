"""The plan of the rig against geometry, statics and heat conduction."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from shapes.boxes import box

from fab4d.io.csvtable import csv_bytes, read_csv
from fab4d.mesh.quadratic import quadratic_tets, with_midpoints
from fab4d.mesh.topology import face_table
from fab4d.rig.clamp import clamp_of, corner_mark
from fab4d.rig.plan import force_trust, limit_reasons, plan_summary, rig_plan
from fab4d.rig.points import LoadPoints, load_points
from fab4d.rig.schedule import CONDUCTIVITY, SPECIFIC_HEAT, conduction_time, schedule, thickness
from fab4d.rig.table import FORCE_COLUMNS, force_rows


def points_with(force: np.ndarray) -> LoadPoints:
    k = len(force)
    zero = np.zeros((k, 3))
    return LoadPoints(np.arange(k), zero, np.ones(k), force, zero, np.tile([0.0, 0, 1], (k, 1)))


@pytest.mark.parametrize(
    ("force", "azimuth", "elevation"),
    [
        ((1, 0, 0), 0, 0),
        ((0, 2, 0), 90, 0),
        ((-3, 0, 0), 180, 0),
        ((-3, -0.0, 0), 180, 0),
        ((0, -1, 0), -90, 0),
        ((0, 0, 5), 0, 90),
        ((0, 0, -5), 0, -90),
        ((1, 1, np.sqrt(2)), 45, 45),
    ],
)
def test_azimuth_and_elevation(force, azimuth, elevation):
    points = points_with(np.array([force], float))
    assert points.azimuth[0] == pytest.approx(azimuth, abs=1e-12)
    assert points.elevation[0] == pytest.approx(elevation, abs=1e-12)


@given(st.tuples(*[st.floats(-1e4, 1e4)] * 3).filter(lambda f: np.linalg.norm(f) > 1e-3))
def test_angles_and_size_give_the_force_back(force):
    points = points_with(np.array([force]))
    a, e = np.radians(points.azimuth[0]), np.radians(points.elevation[0])
    direction = np.array([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)])
    np.testing.assert_allclose(points.size[0] * direction, force, atol=1e-6 * points.size[0])


def test_kgf_by_definition():
    assert points_with(np.array([[0, 0, 9.80665]])).kgf[0] == pytest.approx(1.0, rel=1e-15)


def test_points_of_the_bar(bar):
    state = bar.state_artifact()
    points = load_points(state)
    width = bar.CELLS[0] * bar.STEP
    np.testing.assert_allclose(points.position[0], [width / 2, width / 2, bar.LENGTH], atol=1e-12)
    np.testing.assert_allclose(points.normal[0], [np.sin(bar.MEDIAN), 0, np.cos(bar.MEDIAN)], atol=1e-9)
    np.testing.assert_allclose(points.hold[0], bar.bent(points.position[:1], bar.MEDIAN)[0], atol=0.05)
    assert points.size[1] == pytest.approx(98.0665)
    assert points.kgf[1] == pytest.approx(10.0)


def test_clamp_balances_the_points(bar):
    state = bar.state_artifact()
    clamp, points = clamp_of(state, face_table(state["elements"]).boundary), load_points(state)
    width = bar.CELLS[0] * bar.STEP
    assert clamp is not None
    assert clamp.area == pytest.approx(width**2)
    np.testing.assert_allclose(clamp.upper, [width, width, 0])
    np.testing.assert_allclose(clamp.force + points.force.sum(axis=0), 0, atol=1e-12)
    moments = np.cross(points.hold - clamp.center, points.force).sum(axis=0)
    np.testing.assert_allclose(clamp.moment + moments, 0, atol=1e-9)


def test_mark_is_the_lowest_corner_of_the_clamp(bar):
    X, tets = bar.box()
    faces = face_table(tets).boundary
    np.testing.assert_array_equal(X[corner_mark(X, X[:, 2] == 0, faces)], [0, 0, 0])
    np.testing.assert_array_equal(X[corner_mark(X, X[:, 2] == bar.LENGTH, faces)], [0, 0, bar.LENGTH])
    np.testing.assert_array_equal(X[corner_mark(X, np.zeros(len(X), bool), faces)], [0, 0, 0])


def test_thickness_of_a_bar(bar):
    """The largest ball in a bar of square section has the width as diameter."""
    X, tets = bar.box()
    assert thickness(X, tets, face_table(tets).boundary) == pytest.approx(bar.CELLS[0] * bar.STEP)


def test_thickness_of_a_plate_one_tet_thick(bar):
    X, tets = bar.box()
    low = tets[(X[tets][:, :, 1] <= bar.STEP).all(axis=1)]
    assert thickness(X, low, face_table(low).boundary) == pytest.approx(bar.STEP)


def test_conduction_against_a_finite_difference_solution():
    """An explicit solution of the heat equation in half a wall, from the same start to the same remainder."""
    wall, film, density = 12.0, 200.0, 1.2
    n, half = 60, 6e-3
    dx, a = half / n, CONDUCTIVITY / (1e3 * density * SPECIFIC_HEAT)
    dt = 0.2 * dx**2 / a
    T, seconds = np.ones(n + 1), 0.0
    while T[0] > 0.1:
        flow = a * dt / dx**2
        new = T.copy()
        new[1:-1] += flow * (T[2:] - 2 * T[1:-1] + T[:-2])
        new[0] += 2 * flow * (T[1] - T[0])
        new[-1] += 2 * flow * (T[-2] - T[-1] - dx * film / CONDUCTIVITY * T[-1])
        T, seconds = new, seconds + dt
    assert conduction_time(wall, film, density, 0.1) == pytest.approx(seconds, rel=0.01)


def test_conduction_limits():
    """A wall at once at the bath's temperature: quadratic in thickness; a slow film: linear."""
    assert conduction_time(20, 1e6, 1.2, 0.1) / conduction_time(10, 1e6, 1.2, 0.1) == pytest.approx(4, rel=1e-2)
    assert conduction_time(2, 0.1, 1.2, 0.1) / conduction_time(1, 0.1, 1.2, 0.1) == pytest.approx(2, rel=1e-2)


def test_schedule_order_and_temperatures(card):
    steps = schedule(card, 12.0, clamped=True)
    assert [s.name for s in steps] == ["Mount", "Heat", "Load", "Hold", "Cool", "Unload", "Measure"]
    heat, cool = steps[1], steps[4]
    assert (heat.core_temperature, cool.core_temperature) == (343.0, 313.0)
    assert heat.bath_temperature > heat.core_temperature
    assert cool.bath_temperature < cool.core_temperature
    water, oven = heat.times
    assert 5 <= water.minutes <= 8
    assert 25 <= oven.minutes <= 35


def test_checks_are_true_distances_and_well_apart(bar, card):
    state = bar.state_artifact()
    checks = rig_plan(state, card).checks
    assert checks.count == 4
    for shape, distances in (("nodes", checks.permanent), ("x", checks.median), ("y", checks.final)):
        a, b = state[shape][checks.vertices[:, 0]], state[shape][checks.vertices[:, 1]]
        np.testing.assert_allclose(np.linalg.norm(a - b, axis=1), distances)
    assert np.min([checks.permanent, checks.median, checks.final]) > 0.15 * bar.LENGTH
    assert np.max(np.bincount(checks.vertices.ravel())) <= 2
    assert np.min(np.abs(checks.median - checks.permanent)) > 1.0


@pytest.mark.parametrize(("cells", "fraction"), [((10, 1, 1), 0.15), ((10, 2, 2), 0.37), ((10, 3, 4), 0.52)])
def test_force_trust_is_that_of_the_thinnest_walls(cells, fraction):
    """A bar of n cells across: the table of model.md section 5, by the side that fewer cells span."""
    X, tets = box((40.0, 10.0, 10.0), cells, "six")
    trust = force_trust(X, tets)
    assert (trust.element_order, trust.elements_across) == (1, pytest.approx(min(cells)))
    assert trust.least_fraction == pytest.approx(fraction)
    assert (trust.thin_share > 0.8) == (min(cells) == 1)
    quadratic = force_trust(*_quadratic(X, tets))
    assert quadratic.elements_across == pytest.approx(min(cells))
    assert quadratic.least_fraction > 0.92


def _quadratic(X, tets):
    elements, edges = quadratic_tets(tets, len(X))
    return with_midpoints(X, edges), elements


def test_the_place_with_the_fewest_elements_is_told():
    """A step: one cell thick beyond x = 20, four before."""
    X, tets = box((40.0, 10.0, 8.0), (8, 2, 4), "six")
    center = X[tets].mean(axis=1)
    kept = tets[(center[:, 0] < 20) | (center[:, 2] < 2)]
    used, numbers = np.unique(kept, return_inverse=True)
    trust = force_trust(X[used], numbers.reshape(-1, 4))
    assert trust.elements_across == pytest.approx(1.0)
    assert trust.thin_place[0] > 20
    assert trust.thin_place[2] in (0.0, 2.0)
    assert 0.2 < trust.thin_share < 0.8


def test_limits_of_the_rig():
    points = points_with(np.array([[0, 0, 10.0], [0, 0, -30.0]]))
    assert limit_reasons(points, 50, 2, pull_only=False) == []
    assert "point 2 needs 30 N" in limit_reasons(points, 20, 2, pull_only=False)[0]
    assert "2 points" in limit_reasons(points, 50, 1, pull_only=False)[0]
    assert "point 2 points into" in limit_reasons(points, 50, 2, pull_only=True)[0]


def test_force_table_round_trip(bar):
    points = load_points(bar.state_artifact())
    rows = force_rows(points, bar.mesh_artifact()["vertex_map"])
    back = read_csv(csv_bytes(FORCE_COLUMNS, rows), FORCE_COLUMNS, "forces.csv")
    assert [int(r["point"]) for r in back] == [1, 2, 3]
    assert [int(r["vertex"]) for r in back] == [int(v) + 5 for v in points.vertex]
    for k, row in enumerate(back):
        assert [float(row[f"force_{a}_N"]) for a in "xyz"] == points.force[k].tolist()
        assert [float(row[f"hold_{a}_mm"]) for a in "xyz"] == points.hold[k].tolist()
    assert float(back[1]["pulley_mass_g"]) == pytest.approx(10_000.0)
    assert b"-0.0," not in csv_bytes(FORCE_COLUMNS, rows)


def test_no_clamp_is_said(bar, card):
    state = bar.state_artifact()
    state["clamp"] = np.zeros(len(state["nodes"]), bool)
    plan = rig_plan(state, card)
    assert plan.clamp is None
    assert plan.left_out[0]["what"] == "clamp"
    assert plan_summary(plan, [])["clamp"] is None


def test_quadratic_state_gives_the_same_plan(bar, card):
    linear, quadratic = rig_plan(bar.state_artifact(), card), rig_plan(bar.state_artifact(quadratic=True), card)
    np.testing.assert_allclose(linear.points.position, quadratic.points.position)
    assert linear.wall == quadratic.wall
    assert linear.clamp is not None
    assert quadratic.clamp is not None
    assert linear.clamp.n_vertices == quadratic.clamp.n_vertices
    np.testing.assert_array_equal(linear.checks.vertices, quadratic.checks.vertices)


def test_thicker_parts_wait_longer(card):
    thin, thick = schedule(card, 3.0, True), schedule(card, 30.0, True)
    assert thick[1].times[0].minutes > 10 * thin[1].times[0].minutes
    dense = replace(card, smp_density=2.4)
    assert schedule(dense, 30.0, True)[1].times[0].minutes > thick[1].times[0].minutes
