"""Printability of blocks whose figures are known: a plate, a tower on a foot, a hook that falls over."""

import numpy as np
import pytest

from fab4d.fabrication.bodies import bodies_from_labels
from fab4d.fabrication.printability import PrintCheck, PrintLimits, print_checks, tool_changes

LIMITS = PrintLimits((300.0, 200.0, 100.0), nozzle=0.4, line_width=0.42, layer_height=0.2, purge_per_change=100.0)


def checks(X, tets, smp, limits=LIMITS):
    found = print_checks(X, tets, smp, bodies_from_labels(X, tets, smp), limits)
    return {check.check: check for check in found}


def failing(*args):
    return {name for name, check in checks(*args).items() if not check.ok}


def stretched(mesh, *sides):
    X, tets = mesh
    return X * np.array(sides) / X.max(axis=0), tets


def halves(X, tets, axis, at):
    return X[tets].mean(axis=1)[:, axis] < at


@pytest.fixture
def block(meshes):
    """20 x 10 x 6 mm, SMP below x = 8."""
    X, tets = stretched(meshes["box"]((10, 5, 3)), 20, 10, 6)
    return X, tets, halves(X, tets, 0, 8)


def test_a_block_is_printable(block):
    found = checks(*block)
    # Small parts purge more than they weigh.
    assert {name for name, check in found.items() if not check.ok} == {"purge of the tool changes"}
    assert found["smallest contact of a cluster"].value == pytest.approx(60)
    assert found["smallest cluster"].value == pytest.approx(480)
    assert found["height over the root of the first layer's area"].value == pytest.approx(6 / np.sqrt(200))
    assert found["centre of mass inside the first layer's hull"].value == pytest.approx(5)
    assert found["purge of the tool changes"].value == pytest.approx(30 * 100 / 1200)


@pytest.mark.parametrize(("thickness", "fails"), [(0.3, True), (0.7, False)])
def test_walls_and_layers_have_limits_of_their_own(meshes, thickness, fails):
    wall = stretched(meshes["box"]((8, 1, 4)), 20, thickness, 10)
    plate = stretched(meshes["box"]((8, 8, 1)), 20, 20, thickness / 2)
    none = np.zeros(len(wall[1]), bool)
    assert ("walls below the nozzle" in failing(*wall, none)) == fails
    assert "places below a layer" not in failing(*wall, none)
    none = np.zeros(len(plate[1]), bool)
    assert ("places below a layer" in failing(*plate, none)) == fails
    assert "walls below the nozzle" not in failing(*plate, none)


def test_a_thin_lining_is_found_where_it_is(meshes):
    X, tets = meshes["box"]((10, 4, 4))
    X[:, 0] = np.where(X[:, 0] <= 1, 0.2 * X[:, 0], X[:, 0])
    check = checks(X, tets, halves(X, tets, 0, 0.2))["walls below the nozzle"]
    assert check.value == pytest.approx(0.2 / 10, rel=0.01)
    assert check.where[0] < 0.2


def test_small_clusters_and_contacts_are_named_with_their_place(meshes):
    X, tets = meshes["box"]((6, 3, 3), 0.35)
    smp = halves(X, tets, 0, 0.35) & (X[tets].mean(axis=1) < 0.35).all(axis=1)
    found = checks(X, tets, smp)
    assert not found["smallest cluster"].ok
    assert found["smallest cluster"].value == pytest.approx(0.35**3)
    assert found["smallest contact of a cluster"].value == pytest.approx(3 * 0.35**2)
    assert max(found["smallest cluster"].where) < 0.35


def test_towers_and_hooks_fall(meshes):
    tower = meshes["box"]((1, 1, 12), 2.0)
    height = "height over the root of the first layer's area"
    assert height in failing(*tower, np.zeros(len(tower[1]), bool))
    # An L standing on the end of its short leg.
    hook = meshes["cells"]([(0, 0, 0), (0, 0, 1), *((k, 0, 2) for k in range(6))], 5.0)
    found = checks(*hook, np.zeros(len(hook[1]), bool))
    check = found["centre of mass inside the first layer's hull"]
    centre = (2 * 0.5 + sum(k + 0.5 for k in range(6))) / 8 * 5.0
    assert not check.ok
    assert check.value == pytest.approx(5.0 - centre)


def test_a_part_may_be_turned_on_the_bed_but_not_tipped(meshes):
    def reach(*sides):
        X, tets = stretched(meshes["box"]((2, 2, 2)), *sides)
        return checks(X, tets, np.zeros(len(tets), bool))["reach beyond the volume of both tools"]

    assert reach(190, 290, 90).ok
    assert reach(290, 190, 90).value == -10
    assert reach(90, 90, 110).value == 10
    assert not reach(210, 210, 50).ok


def test_a_material_held_by_an_edge_is_counted(meshes):
    X, tets = meshes["box"]((2, 2, 1), 5.0)
    centre = X[tets].mean(axis=1) < 5
    smp = centre[:, 0] == centre[:, 1]
    found = print_checks(X, tets, smp, bodies_from_labels(X, tets, np.ones(len(tets), bool)), LIMITS)
    (check,) = [c for c in found if c.check == "places held by an edge or a point"]
    assert not check.ok
    assert check.value == 2
    assert check.where[:2] == (5.0, 5.0)


@pytest.mark.parametrize(("axis", "at", "changes"), [(0, 8, 30), (2, 4, 0), (2, 3, 10)])
def test_tools_change_in_layers_with_both_materials(block, axis, at, changes):
    """A cut across at z = 3 goes through the cells from 2 to 4 mm."""
    X, tets, _ = block
    assert tool_changes(X, tets, halves(X, tets, axis, at), 0.2) == changes
    assert tool_changes(X + 7.3, tets, halves(X, tets, axis, at), 0.2) == changes


def test_what_lines_leave_empty_is_told_for_each_body(meshes):
    X, tets = meshes["box"]((10, 10, 4), 0.3)
    found = checks(X, tets, halves(X, tets, 0, 0.3))
    assert found["SMP that lines leave empty"].value == pytest.approx(1)
    assert not found["SMP that lines leave empty"].ok
    assert found["SMP that lines leave empty"].where[0] == pytest.approx(0.15, abs=0.01)
    assert found["TPE that lines leave empty"].ok


@pytest.mark.parametrize(
    ("value", "sense", "limit", "ok", "marginal"),
    [
        (0.9, "at most", 1.0, True, True),
        (0.7, "at most", 1.0, True, False),
        (1.1, "at most", 1.0, False, False),
        (1.1, "at least", 1.0, True, True),
        (1.3, "at least", 1.0, True, False),
        (1, "at most", 1, True, False),
        (3.0, "at least", 0.0, True, False),
    ],
)
def test_what_holds_barely(value, sense, limit, ok, marginal):
    assert PrintCheck("x", ok, value, sense, limit, "mm").marginal == marginal
