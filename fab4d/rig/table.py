"""The points as a table for other programs."""

import numpy as np

from fab4d.mesh.tetmesh import FloatArray, IntArray
from fab4d.rig.points import LoadPoints

FORCE_COLUMNS = (
    "point",
    "vertex",
    *(f"position_{a}_mm" for a in "xyz"),
    "pad_area_mm2",
    "pad_radius_mm",
    *(f"force_{a}_N" for a in "xyz"),
    "force_N",
    "force_kgf",
    "pulley_mass_g",
    *(f"direction_{a}" for a in "xyz"),
    "azimuth_deg",
    "elevation_deg",
    *(f"hold_{a}_mm" for a in "xyz"),
    "travel_mm",
    "force_uncertainty_N",
)


def force_rows(
    points: LoadPoints, vertex_map: IntArray, uncertainty: FloatArray | None = None
) -> list[dict[str, float]]:
    """One row a point with the columns `FORCE_COLUMNS`; points count from 1, `vertex` from 0 in the permanent file.

    vertex_map : (n,) number in the permanent file of each vertex        uncertainty : (K,) of the forces, N; None: nan
    """
    columns = np.column_stack(
        [
            np.arange(1, points.count + 1),
            vertex_map[points.vertex],
            points.position,
            points.pad_area,
            points.pad_radius,
            points.force,
            points.size,
            points.kgf,
            1e3 * points.kgf,
            points.direction,
            points.azimuth,
            points.elevation,
            points.hold,
            points.travel,
            np.full(points.count, np.nan) if uncertainty is None else uncertainty,
        ]
    )
    whole = ("point", "vertex")
    return [
        {name: int(value) if name in whole else float(value) for name, value in zip(FORCE_COLUMNS, row, strict=True)}
        for row in columns
    ]
