"""The figures by which a finished design is judged, from its verified state."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from fab4d.materials.cards import MaterialCard
from fab4d.mesh.distance import (
    Displacement,
    ShapeError,
    aligned,
    aligned_hausdorff_distance,
    prescribed_displacement,
    shape_error,
)
from fab4d.mesh.measures import bounding_box_diagonal, tet_volumes, vertex_areas
from fab4d.mesh.tetmesh import BoolArray, FloatArray, IntArray
from fab4d.mesh.topology import face_table


@dataclass(frozen=True, eq=False)
class Shapes:
    """The four shapes at the vertices (n, 3) of the linear tets, mm: permanent X, wanted X_temp, median x, final y;
    boundary faces (b, 3) and vertex areas (n,) of X, mm^2; whether the part has a clamp."""

    X: FloatArray
    X_temp: FloatArray
    x: FloatArray
    y: FloatArray
    faces: IntArray
    areas: FloatArray
    clamped: bool

    @property
    def surface(self) -> IntArray:
        """The boundary vertices."""
        return np.unique(self.faces)


def shapes_of(mesh: Mapping[str, np.ndarray], state: Mapping[str, np.ndarray] | None) -> Shapes:
    """The shapes of a verified state; without one (nothing to program) the part stays as printed."""
    X, faces = mesh["X"], face_table(mesh["tets"]).boundary
    x, y = (X, X) if state is None else (state["x"][: len(X)], state["y"][: len(X)])
    # What a projection of the wanted shape costs is part of the error.
    wanted = mesh.get("X_wanted", mesh["X_temp"])
    return Shapes(X, wanted, x, y, faces, vertex_areas(X, faces), bool(mesh["clamp"].any()))


def final_error(shapes: Shapes) -> ShapeError:
    """Distance of the final to the wanted shape: `mesh.distance.shape_error`."""
    return shape_error(shapes.y, shapes.X_temp, shapes.faces, shapes.areas)


def final_as_wanted(shapes: Shapes) -> FloatArray:
    """The free final shape (n, 3), moved rigidly to where the wanted one is."""
    on = shapes.surface
    return aligned(shapes.y, shapes.X_temp, on, shapes.areas[on])


def target_displacement(shapes: Shapes) -> Displacement:
    """How far the wanted shape is from the permanent one, mm: `mesh.distance.prescribed_displacement`."""
    on = shapes.surface
    return prescribed_displacement(shapes.X, shapes.X_temp, on, shapes.areas[on], shapes.clamped)


def fixity(shapes: Shapes) -> float | None:
    """1 - d(final, median) / d(median, permanent) with d the Hausdorff distance after rigid alignment: model.md 3.

    1: nothing springs back; 0: all of it. None when the median shape is the permanent one.
    """
    return _one_minus(_spring_back(shapes), _distance(shapes, shapes.x, shapes.X), shapes)


def undesired_deformation(shapes: Shapes) -> float | None:
    """R_r = d(final, median) / d(final, permanent), the measure of the paper's section 6, d as in `fixity`.

    None when the final shape is the permanent one.
    """
    from_permanent = _distance(shapes, shapes.y, shapes.X)
    return None if _negligible(from_permanent, shapes) else _spring_back(shapes) / from_permanent


def smp_fraction(mesh: Mapping[str, np.ndarray], smp: BoolArray) -> float:
    """Share of the SMP tets in the volume."""
    V = tet_volumes(mesh["X"], mesh["tets"])
    return float(V[smp].sum() / V.sum())


def mass_and_cost(mesh: Mapping[str, np.ndarray], smp: BoolArray, card: MaterialCard) -> tuple[float, float]:
    """Mass (g) and price of the material (USD) of the solid part; supports, purge and waste are not in it."""
    V = 1e-3 * tet_volumes(mesh["X"], mesh["tets"])
    smp_mass, tpe_mass = V[smp].sum() * card.smp_density, V[~smp].sum() * card.tpe_density
    return float(smp_mass + tpe_mass), float(1e-3 * (smp_mass * card.smp_price + tpe_mass * card.tpe_price))


def force_count(state: Mapping[str, np.ndarray] | None) -> int:
    """Patches that carry a force."""
    return 0 if state is None else int(np.any(state["patch_force"] != 0.0, axis=1).sum())


def error_figures(error: ShapeError, L0: float) -> dict[str, Any]:
    """The error in mm and relative to the diagonal L0 (mm)."""
    plain = {"rms": error.rms, "max": error.max, "hausdorff": error.hausdorff}
    return {f"{k}_mm": v for k, v in plain.items()} | {f"{k}_rel": v / L0 for k, v in plain.items()}


def _one_minus(a: float, b: float, shapes: Shapes) -> float | None:
    return None if _negligible(b, shapes) else 1.0 - a / b


def _spring_back(shapes: Shapes) -> float:
    return _distance(shapes, shapes.y, shapes.x)


def _distance(shapes: Shapes, a: FloatArray, b: FloatArray) -> float:
    return aligned_hausdorff_distance(a, b, shapes.faces, shapes.areas)


def _negligible(distance: float, shapes: Shapes) -> bool:
    return distance < 1e-12 * bounding_box_diagonal(shapes.X)
