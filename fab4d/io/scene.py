"""The scene: what the user wants, checked and in mm, N and MPa."""

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from fab4d.materials.cards import MaterialCard


@dataclass(frozen=True)
class PrinterCard:
    """A dual-extruder printer. Lengths in mm; `volume` is usable with both tools."""

    name: str
    volume: tuple[float, float, float]
    line_width: float
    layer_height: float
    filament_diameter: float
    source: str


@dataclass(frozen=True)
class RigCard:
    """An actuator rig: how many points it pulls, how hard (N), through pads of what radius (mm)."""

    name: str
    max_points: int
    max_force: float
    patch_radius: float
    pull_only: bool
    source: str


@dataclass(frozen=True)
class ClampRegion:
    """A region held fixed: a box (2, 3) in mm, vertex numbers of the mesh file, or a named set of it."""

    box: tuple[tuple[float, float, float], tuple[float, float, float]] | None = None
    vertices: tuple[int, ...] | None = None
    set_name: str | None = None


@dataclass(frozen=True)
class Goal:
    """tolerance: largest RMS distance to the temporary shape, mm (None: 5e-3 of the diagonal); max_forces: None: the rig's."""

    tolerance: float | None = None
    max_forces: int | None = None
    max_smp_fraction: float | None = None


@dataclass(frozen=True)
class Acceptance:
    """The paper's two acceptance checks, as fractions."""

    max_ambiguous_fraction: float = 1e-3
    max_isolated_fraction: float = 0.30


@dataclass(frozen=True)
class Weights:
    """The paper's weights in the dimensionless form of model.md section 4; None leaves the choice to the solver."""

    lam_pfinal: float | None = None
    lam_force: float | None = None
    lam_mat: float | None = None
    lam_smooth: float | None = None
    lam_SMP: float | None = None


@dataclass(frozen=True)
class SolverSettings:
    """method: `reduced` or `admm`; element: `linear` or `quadratic`; seed of every random choice."""

    method: str = "reduced"
    element: str = "linear"
    seed: int = 0


@dataclass(frozen=True)
class Gravity:
    """Direction of gravity while programming, unit vector."""

    direction: tuple[float, float, float]


@dataclass(frozen=True)
class Scene:
    """A whole scene. Lengths are already mm; `units` is the length unit of the mesh files."""

    name: str
    units: str
    permanent: Path
    temporary: Path
    materials: MaterialCard
    printer: PrinterCard
    rig: RigCard
    clamp: tuple[ClampRegion, ...] = ()
    goal: Goal = field(default_factory=Goal)
    weights: Weights = field(default_factory=Weights)
    acceptance: Acceptance = field(default_factory=Acceptance)
    solver: SolverSettings = field(default_factory=SolverSettings)
    gravity: Gravity | None = None


@dataclass(frozen=True, eq=False)
class RawMesh:
    """A tet mesh as read: points (n, 3) in the file's unit, tets (m, 4) or (m, 10), named vertex sets, file name."""

    points: np.ndarray
    tets: np.ndarray
    sets: dict[str, np.ndarray]
    file: str
