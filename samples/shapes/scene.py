"""A sample and its files: scene.toml and the two meshes."""

from dataclasses import dataclass
from pathlib import Path

import meshio
import numpy as np

from fab4d.mesh.measures import bounding_box_diagonal
from fab4d.mesh.tetmesh import FloatArray, IntArray

Box = tuple[tuple[float, float, float], tuple[float, float, float]]

SCENE = """\
# {title}
name = "{name}"
units = "mm"

[shape]
permanent = "perm.vtu"
temporary = "temp.vtu"

[[rig.clamp]]
box = [{low}, {high}]

[goal]
tolerance = {tolerance:.3g}
max_forces = {max_forces}
"""


@dataclass(frozen=True, eq=False)
class Sample:
    """A pair of shapes (n, 3), mm, on the same tets (m, 4), and what a user wants of them."""

    title: str
    X: FloatArray
    X_temp: FloatArray
    tets: IntArray
    clamp: Box
    max_forces: int
    tolerance: float
    """Largest RMS error over the bounding-box diagonal."""
    max_smp_fraction: float | None = None


def rounded(X: FloatArray) -> FloatArray:
    """To 1e-9 mm: the last bits of sine and cosine differ between machines."""
    return np.round(X, 9) + 0.0


def scene_text(name: str, sample: Sample) -> str:
    """The scene file of `sample`."""
    low, high = ([float(c) for c in corner] for corner in sample.clamp)
    tolerance = sample.tolerance * bounding_box_diagonal(sample.X)
    text = SCENE.format(
        title=sample.title, name=name, low=low, high=high, tolerance=tolerance, max_forces=sample.max_forces
    )
    smp = "" if sample.max_smp_fraction is None else f"max_smp_fraction = {sample.max_smp_fraction}\n"
    return text + smp


def write_sample(folder: Path, name: str, sample: Sample) -> None:
    """Write scene.toml, perm.vtu and temp.vtu into `folder`."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "scene.toml").write_text(scene_text(name, sample), encoding="utf-8")
    for file, points in (("perm.vtu", sample.X), ("temp.vtu", sample.X_temp)):
        mesh = meshio.Mesh(rounded(points), [("tetra", sample.tets)])
        meshio.write(folder / file, mesh, file_format="vtu", compression="zlib")
