"""The figures of the report against closed forms."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from fab4d.mesh.measures import vertex_areas
from fab4d.mesh.topology import face_table
from fab4d.report import metrics
from fab4d.report.metrics import Shapes


@pytest.fixture
def parts(bar):
    X, tets = bar.box()
    return X, tets, face_table(tets).boundary


def shapes(X, faces, *, X_temp=None, x=None, y=None, clamped=True):
    found = [X if s is None else s for s in (X_temp, x, y)]
    return Shapes(X, *found, faces, vertex_areas(X, faces), clamped)


def stretched(X, factor):
    return X * [1, 1, factor]


def test_fixity_of_a_stretched_bar(parts):
    """Ends of aligned bars are half the difference of lengths apart: 10 % stretched, 8 % kept.

    The vertex areas of the six-tet cells are not quite symmetric, so the alignment turns by some 1e-5.
    """
    X, _, faces = parts
    s = shapes(X, faces, x=stretched(X, 1.10), y=stretched(X, 1.08))
    assert metrics.fixity(s) == pytest.approx(1 - 0.02 / 0.10, rel=1e-3)
    assert metrics.undesired_deformation(s) == pytest.approx(0.02 / 0.08, rel=1e-3)


def test_limits_of_fixity(parts):
    """Pure SMP keeps all, pure TPE keeps nothing, and what was never deformed has no fixity."""
    X, _, faces = parts
    x = stretched(X, 1.2)
    smp, tpe = shapes(X, faces, x=x, y=x), shapes(X, faces, x=x, y=X)
    assert metrics.fixity(smp) == pytest.approx(1, abs=1e-12)
    assert metrics.undesired_deformation(smp) == pytest.approx(0, abs=1e-12)
    assert metrics.fixity(tpe) == pytest.approx(0, abs=1e-12)
    assert metrics.undesired_deformation(tpe) is None
    assert metrics.fixity(shapes(X, faces)) is None


def test_rigid_motion_of_the_free_final_shape_changes_nothing(parts, bar):
    X, _, faces = parts
    wanted, x, y = bar.bent(X, bar.WANTED), bar.bent(X, bar.MEDIAN), bar.bent(X, bar.FINAL)
    turned = y @ Rotation.from_euler("xyz", [0.3, -1.0, 2.0]).as_matrix().T + [5.0, 6, 7]
    here = shapes(X, faces, X_temp=wanted, x=x, y=y)
    there = shapes(X, faces, X_temp=wanted, x=x, y=turned)
    assert metrics.final_error(there).rms == pytest.approx(metrics.final_error(here).rms, rel=1e-9)
    assert metrics.fixity(there) == pytest.approx(metrics.fixity(here), rel=1e-9)
    np.testing.assert_allclose(metrics.final_as_wanted(there), metrics.final_as_wanted(here), atol=1e-9)


def test_target_displacement_in_the_frame_of_the_clamp(parts):
    X, _, faces = parts
    moved = X + np.array([0.0, 3.0, 4.0])
    clamped = metrics.target_displacement(shapes(X, faces, X_temp=moved))
    assert (clamped.rms, clamped.max) == (pytest.approx(5.0), pytest.approx(5.0))
    assert metrics.target_displacement(shapes(X, faces, X_temp=moved, clamped=False)).rms < 1e-12


def test_mass_cost_and_share(bar, profile):
    """A share of 2/9 of 1687.5 mm^3 in SMP at the card's densities and prices."""
    mesh, smp, card = bar.mesh_artifact(), bar.labels_artifact()["smp"], profile["materials"]
    cm3 = np.prod(bar.CELLS) * bar.STEP**3 / 1e3
    share = metrics.smp_fraction(mesh, smp)
    assert share == pytest.approx(2 / 9)
    mass, cost = metrics.mass_and_cost(mesh, smp, card)
    smp_g, tpe_g = share * cm3 * card.smp_density, (1 - share) * cm3 * card.tpe_density
    assert mass == pytest.approx(smp_g + tpe_g)
    assert cost == pytest.approx((smp_g * card.smp_price + tpe_g * card.tpe_price) / 1000)


def test_only_patches_with_a_force_count(bar):
    state = bar.state_artifact(forces=np.array([[1.0, 0, 0], [0, 0, 0], [0, -2, 0]]))
    assert metrics.force_count(state) == 2
    assert metrics.force_count(None) == 0


def test_error_is_given_in_mm_and_relative(parts):
    X, _, faces = parts
    error = metrics.final_error(shapes(X, faces, y=stretched(X, 1.1)))
    figures = metrics.error_figures(error, 10.0)
    assert set(figures) == {f"{k}_{u}" for k in ("rms", "max", "hausdorff") for u in ("mm", "rel")}
    assert figures["rms_mm"] == pytest.approx(10 * figures["rms_rel"])
    assert 0 < error.rms < error.max
