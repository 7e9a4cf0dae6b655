"""What the stages solve, refit and verify share: the dimensionless problem, patch arrays, and the trace of iterates."""

import time
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from fab4d.design.gauss_newton import Design
from fab4d.design.objective import ObjectiveWeights
from fab4d.design.patches import Patches, patches_from_faces
from fab4d.design.problem import Problem, build_problem
from fab4d.design.reduced import Search, at_rest
from fab4d.fabrication.labels import ambiguous_fraction
from fab4d.io.csvtable import TRACE_COLUMNS, csv_bytes, read_csv
from fab4d.io.scene import Goal, RigCard, Weights
from fab4d.materials.cards import MaterialCard
from fab4d.mesh.distance import prescribed_displacement, shape_error
from fab4d.mesh.measures import vertex_areas
from fab4d.report.verdict import default_tolerance
from fab4d.stages.monitor import Monitor

# Price of SMP and of a rough interface, in units of the squared error at the tolerance. Rough interfaces are pinched in
# many places, and repairing these costs more accuracy than a smooth one does from the start.
LAM_SMP, LAM_SMOOTH = 0.05, 2.5
# Limits of rig and material are penalties, exceeded a little where the error pulls: they begin below the true limit.
LIMIT_MARGIN = 0.9
# Surfaces that are squeezed below the first number turn unstable in short waves, which coarse meshes are too stiff to
# show: plane ones below 0.54, evenly in all directions below 0.67 (Biot, Appl. Sci. Res. A 12 (1963) 168). Near
# these states most steps lead to no equilibrium, and rounding loses most of the accuracy. A 5000th of the volume
# squeezed to nothing counts as much as an error of the tolerance.
LEAST_STRETCH, LAM_SQUEEZE = 0.6, 5000.0


def problem_of(mesh: Mapping[str, np.ndarray], materials: MaterialCard, element: str) -> Problem:
    """The dimensionless design problem of the `mesh` artifact."""
    return build_problem(mesh["X"], mesh["X_temp"], mesh["tets"], mesh["clamp"], materials, element)


def objective_weights(
    problem: Problem, goal: Goal, weights: Weights, rig: RigCard, materials: MaterialCard
) -> ObjectiveWeights:
    """Weights of the objective: the scene's, or else those that count an error of the goal's tolerance as 1."""
    return ObjectiveWeights(
        error_scale=tolerance_of(problem, goal) if weights.lam_pfinal is None else weights.lam_pfinal**-0.5,
        lam_SMP=LAM_SMP if weights.lam_SMP is None else weights.lam_SMP,
        lam_mat=0.0 if weights.lam_mat is None else weights.lam_mat,
        lam_smooth=LAM_SMOOTH if weights.lam_smooth is None else weights.lam_smooth,
        pull_only=rig.pull_only,
        max_force=LIMIT_MARGIN * rig.max_force / problem.force,
        smp_max_stretch=LIMIT_MARGIN * materials.smp_max_stretch,
        tpe_max_stretch=LIMIT_MARGIN * materials.tpe_max_stretch,
        least_stretch=LEAST_STRETCH,
        lam_squeeze=LAM_SQUEEZE,
    )


def tolerance_of(problem: Problem, goal: Goal) -> float:
    """The largest RMS error, L0, that the goal allows."""
    return _usual_tolerance(problem) if goal.tolerance is None else goal.tolerance / problem.length


def _usual_tolerance(problem: Problem) -> float:
    """That of a goal without one, in L0."""
    on, a = np.flatnonzero(problem.area_weights), problem.area_weights
    moved = prescribed_displacement(problem.body.X, problem.X_temp, on, a[on], bool(problem.clamp.any()))
    return default_tolerance(1.0, moved.rms)


def patch_arrays(problem: Problem, patches: Patches, design: Design) -> dict[str, np.ndarray]:
    """The five patch arrays of pipeline/README.md, in mm and N."""
    return {
        "patch_center": patches.centers,
        "patch_faces": patches.faces,
        "patch_offsets": patches.offsets,
        "patch_held": patches.mean(design.median.x) * problem.length,
        "patch_force": design.median.forces * problem.force,
    }


def patches_of(problem: Problem, arrays: Mapping[str, np.ndarray]) -> Patches:
    """The patches of an artifact, for the problem's element."""
    return patches_from_faces(problem, arrays["patch_center"], arrays["patch_faces"], arrays["patch_offsets"])


def tau_seconds(problem: Problem, repeats: int = 3) -> float:
    """The unit of work: the fastest of `repeats` factorisations of the scene's own stiffness matrix at rest, s."""
    rest = at_rest(problem)
    data = rest.equilibria.final_tangent(rest.design.rho, rest.design.median, problem.body.X)
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        rest.equilibria.free_analysis.factor(data)
        times.append(time.perf_counter() - start)
    return min(times)


@dataclass
class _Log:
    """The rows of error-vs-time.csv, and when its clock stood at zero."""

    start: float
    rows: list[dict[str, Any]]


class Trace:
    """Rows of error-vs-time.csv, one for each iterate shown to it; tells the monitor of each."""

    def __init__(self, problem: Problem, mesh: Mapping[str, np.ndarray], monitor: Monitor, tau_s: float) -> None:
        self._problem, self._mesh, self._monitor, self._tau_s = problem, mesh, monitor, tau_s
        self._areas = vertex_areas(mesh["X"], problem.faces)
        self._log = _Log(time.perf_counter(), [])

    @property
    def rows(self) -> list[dict[str, Any]]:
        """All rows so far."""
        return self._log.rows

    def add(self, phase: str, at: Search) -> None:
        """Measure the true error of the design and append its row, unless the last step changed nothing."""
        if not at.accepted:
            return
        wall_s = time.perf_counter() - self._log.start
        n, design, problem = len(self._mesh["X"]), at.design, self._problem
        error = shape_error(design.final.y[:n] * problem.length, self._mesh["X_temp"], problem.faces, self._areas)
        row: dict[str, Any] = {
            "solver": "reduced",
            "phase": phase,
            "wall_s": wall_s,
            "tau": wall_s / self._tau_s,
            "rms_mm": error.rms,
            "max_mm": error.max,
            "hausdorff_mm": error.hausdorff,
            "smp_fraction": float(problem.volume_fractions @ design.rho),
            "forces": at.equilibria.patches.count,
            "ambiguous_fraction": ambiguous_fraction(design.rho),
        }
        self.rows.append(row)
        self._monitor.progress(
            phase, rms_mm=error.rms, forces=row["forces"], smp_fraction=row["smp_fraction"], tau=row["tau"]
        )

    def on(self, problem: Problem, mesh: Mapping[str, np.ndarray]) -> "Trace":
        """The same rows and clock for iterates on another mesh of the part, measured there."""
        other = Trace(problem, mesh, self._monitor, self._tau_s)
        other._log = self._log
        return other

    def go_on(self, csv: bytes) -> None:
        """Take over the rows of an interrupted run; its time counts."""
        self._log.rows = [
            {key: value if key in ("solver", "phase") else float(value) for key, value in row.items()}
            for row in read_csv(csv, TRACE_COLUMNS, "checkpoint")
        ]
        if self.rows:
            self._log.start -= self.rows[-1]["wall_s"]

    def csv(self) -> bytes:
        """The rows as CSV with a header."""
        return csv_bytes(TRACE_COLUMNS, self.rows)
