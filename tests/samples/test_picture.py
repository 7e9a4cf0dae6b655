"""The picture of a finished run."""

import sys
from pathlib import Path

import meshio
import numpy as np
import picture
import pytest
from PIL import Image
from shapes.boxes import box

from fab4d.report.views import CLAMP_COLOUR, SMP_COLOUR, TPE_COLOUR


@pytest.fixture
def design() -> meshio.Mesh:
    """A bar of 40 x 10 x 10 mm, its clamped half SMP, held at x = 0, lifted by a force of 5 N in its free end."""
    X, tets = box((40.0, 10.0, 10.0), (4, 1, 1), "six")
    lifted = X + np.column_stack([np.zeros((len(X), 2)), 0.01 * X[:, 0] ** 2])
    end = X[:, 0] > 39
    return meshio.Mesh(
        X,
        [("tetra", tets)],
        point_data={
            "median": lifted,
            "temporary": lifted,
            "force": np.where(end[:, None], [0, 0, 5 / end.sum()], 0.0),
            "held": np.where(end, 0, -1),
            "clamp": (X[:, 0] < 1).astype(np.int8),
        },
        cell_data={"smp": [(X[tets].mean(axis=1)[:, 0] < 20).astype(np.int8)]},
    )


def test_faces_have_the_colour_of_what_is_under_them(design: meshio.Mesh) -> None:
    faces, colours = picture.surface_colours(design)
    x = design.points[faces].mean(axis=1)[:, 0]
    wanted = np.where((x < 20)[:, None], SMP_COLOUR, TPE_COLOUR)
    wanted[np.isclose(x, 0)] = CLAMP_COLOUR
    np.testing.assert_array_equal(colours, wanted)


def test_the_force_of_a_patch_is_the_sum_at_its_centre(design: meshio.Mesh) -> None:
    centres, forces = picture.point_forces(design)
    np.testing.assert_allclose(centres, [[40, 5, 5 + 16]])
    np.testing.assert_allclose(forces, [[0, 0, 5]])


def test_without_forces_there_are_no_arrows(design: meshio.Mesh) -> None:
    design.point_data["held"][:] = -1
    centres, forces = picture.point_forces(design)
    assert centres.shape == forces.shape == (0, 3)
    image = np.asarray(picture.picture(design, picture.view_axes(-90, 0)))
    assert not np.any(np.all(image == picture.RED, axis=2))


@pytest.mark.parametrize(
    ("azimuth", "elevation", "towards"), [(0, 0, [1, 0, 0]), (-90, 0, [0, -1, 0]), (30, 90, [0, 0, 1])]
)
def test_view_axes_are_a_rotation_towards_the_viewer(azimuth: float, elevation: float, towards: list[float]) -> None:
    axes = picture.view_axes(azimuth, elevation)
    np.testing.assert_allclose(axes @ axes.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(axes) == pytest.approx(1)
    np.testing.assert_allclose(axes[2], towards, atol=1e-12)


def test_the_arrow_points_up_in_the_middle_picture(
    design: meshio.Mesh, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    design.write(tmp_path / "design.vtu")
    arguments = [str(tmp_path), str(tmp_path / "bar.png"), "--azimuth", "-90", "--elevation", "0"]
    monkeypatch.setattr(sys, "argv", ["picture.py", *arguments])
    picture.main()
    image = np.asarray(Image.open(tmp_path / "bar.png"))
    rows, columns = np.nonzero(np.all(image == picture.RED, axis=2))
    assert image.shape[1] / 3 < columns.min() < columns.max() < 2 * image.shape[1] / 3
    width = [np.ptp(columns[rows == row]) for row in range(rows.min(), rows.max() + 1)]
    assert np.argmax(width) < len(width) / 2  # the head is wider than the shaft and the dot at its foot
