"""How stable a design is, and how its error moves when the rig or the material is not as designed."""

from dataclasses import dataclass

import numpy as np

from fab4d.design.equilibria import RIG_COMPLIANCE, Equilibria, Median, Pinned
from fab4d.design.gauss_newton import SEARCH_TOLERANCE, Design, equilibrate, held_positions
from fab4d.design.objective import shape_error, shape_metric
from fab4d.design.sensitivity import Linearisation
from fab4d.design.turning import Turning
from fab4d.materials.cards import Moduli
from fab4d.mesh.tetmesh import BoolArray, FloatArray
from fab4d.solvers.linear import Factor, SingularMatrixError

PHASES = ("tpe", "rubbery", "glassy")
NEWTON_STEPS = 25
# A stiffness below this part of the largest is none: a part without a clamp may be moved as a whole.
NO_STIFFNESS = 1e-9
# Forces that differ by this part of their size count as equal.
FORCE_TOLERANCE = 1e-4
MOST_FORCE_STEPS, SMALLEST_DAMPING = 8, 0.05
# A step to changed forces moves the points no farther than this, in L0, and is given up where the shape does not follow
# in a few steps: then it has none to follow to.
LONGEST_MOVE, FEW_NEWTON_STEPS = 0.1, 6
# In how many parts a change of the forces is made, the second time because the first one failed, or at once where it
# moves a point farther than LONGEST_MOVE.
FORCE_PARTS = 1, 4


@dataclass(frozen=True, eq=False)
class Response:
    """What moves of the held positions c do to a design: to first order, and to its squared error to second.

    rms : of the design, L0         dx_dc (3N, 3K), df_dc (3K, 3K), dy_dc (3N, 3K)
    stiffened (3N + 3K, 3K) : dx_dc and df_dc with K+ of `soft_modes` as tangent, which has no soft modes
    gradient (3K,), curvature (3K, 3K) : rms^2(c + dc) = rms^2 + 2 gradient . dc + dc . curvature dc, L0^2
    held_negative, final_negative : negative eigenvalues of the tangents, of the median's with its 3K constraints
    """

    rms: float
    dx_dc: FloatArray
    df_dc: FloatArray
    dy_dc: FloatArray
    stiffened: FloatArray
    gradient: FloatArray
    curvature: FloatArray
    held_negative: int
    final_negative: int

    def rms_after(self, dc: FloatArray) -> float:
        """RMS error, L0, once the held positions have moved by dc (K, 3), L0."""
        d = dc.ravel()
        return float(np.sqrt(max(float(self.rms**2 + 2 * self.gradient @ d + d @ self.curvature @ d), 0.0)))

    def expected_rms(self, size: float) -> float:
        """Root of the mean squared error, L0, with every point off by `size`, L0, in a random direction of its own.

        It is the same with every coordinate off by a uniformly random length up to `size`: the covariance is
        size^2 / 3 in both cases.
        """
        return float(np.sqrt(self.rms**2 + size**2 / 3 * np.trace(self.curvature)))

    def worst_move(self, point: int, size: float) -> FloatArray:
        """(3,) the move of one point by `size` that makes the error largest."""
        at = slice(3 * point, 3 * point + 3)
        H, g = self.curvature[at, at], self.gradient[at]
        _, axes = np.linalg.eigh(H)
        # d -> H d + g raises the error and keeps the signs of d along the axes; among moves with the signs of g the
        # largest error is the only stationary one.
        move = axes @ np.where(axes.T @ g < 0, -1.0, 1.0) * (size / np.sqrt(3))
        for _ in range(300):
            steeper = H @ move + g
            length = float(np.linalg.norm(steeper))
            if length == 0.0:
                break
            move = steeper * (size / length)
        return move

    def moves_for_forces(self, change: FloatArray) -> FloatArray:
        """(K, 3) moves of the held positions, L0, that change the forces by `change` (K, 3)."""
        return _least_moves(self.df_dc, change)


def response_of(equilibria: Equilibria, design: Design, lin: Linearisation) -> Response:
    """How the design, with the linear maps `lin` about it, responds to moves of its held positions."""
    problem, y, k = equilibria.problem, design.final.y, 3 * equilibria.patches.count
    positive = equilibria.held_analysis.factor(equilibria.median_tangent(design.rho, design.median.x, spd=True))
    dx_dc, df_dc, dy_dc = lin.held_columns()
    error = shape_error(problem, y)
    pull = (problem.area_weights[:, None] * (error.e @ error.R)).ravel()
    curvature = 0.5 * dy_dc.T @ shape_metric(problem, y, 1.0).apply(dy_dc)
    return Response(
        rms=error.rms,
        dx_dc=dx_dc,
        df_dc=df_dc,
        dy_dc=dy_dc,
        stiffened=_held_columns(positive, design.median.x.size, k),
        gradient=dy_dc.T @ pull,
        curvature=0.5 * (curvature + curvature.T),
        held_negative=lin.held.n_negative,
        final_negative=lin.free.n_negative,
    )


@dataclass(frozen=True, eq=False)
class Instability:
    """In how many independent ways a design moves away by itself: 0 is stable.

    held : the median shape with its points locked      final : the free final shape
    dead_loads : the median shape under forces that stay what they are wherever it goes, such as those of weights
    points : (K,) whether it moves away when this point alone carries a dead load and all others are locked
    """

    held: int
    final: int
    dead_loads: int
    points: BoolArray


def instability_of(response: Response) -> Instability:
    """Count the negative eigenvalues of the tangents.

    df/dc is minus the inverse of the Schur complement of K in [[K, -W^T], [-W, -d]]. So K has the negative eigenvalues
    of df/dc and those of the locked shape (inertia additivity: Haynsworth, Linear Algebra Appl. 1 (1968) 73).
    """
    stiffness = 0.5 * (response.df_dc + response.df_dc.T)
    zero = NO_STIFFNESS * np.abs(stiffness).max(initial=0.0)
    blocks = [stiffness[k : k + 3, k : k + 3] for k in range(0, len(stiffness), 3)]
    held = response.held_negative - len(stiffness)
    return Instability(
        held=held,
        final=response.final_negative,
        dead_loads=held + int(np.sum(np.linalg.eigvalsh(stiffness) < -zero)),
        points=np.array([np.linalg.eigvalsh(block)[0] < -zero for block in blocks], bool),
    )


# -- the changed design, in equilibrium; `near` are the linear maps about the design


def with_moved_points(
    equilibria: Equilibria, design: Design, near: Linearisation, response: Response, dc: FloatArray
) -> Design | None:
    """The design once its held positions have moved by dc (K, 3), L0; None where no equilibrium is found near it."""
    held = held_positions(equilibria, design.median) + dc
    x, f, y = design.median.x, design.median.forces, design.final.y
    dx, df = _ahead(equilibria, design, response, dc)
    follow = equilibria.free_turning.step(y, near.final_follows(dx))
    ahead = equilibria.held_turning.step(x, dx), f + df, follow
    # From far ahead the way past unstable states is long, and the other one mostly leads there too.
    for guess, stay in ((ahead, True), ((x, f, y), False)):
        found = equilibrate(equilibria, design.rho, held, *guess, SEARCH_TOLERANCE, NEWTON_STEPS, stay=stay, near=near)
        if found is not None:
            return found
    return None


def _ahead(equilibria: Equilibria, design: Design, response: Response, dc: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Changes dx (N, 3) and df (K, 3) of the median shape when the held positions move by dc (K, 3).

    A soft mode moves by far less than the tangent tells, for it stiffens on the way. Without soft modes the prediction
    is too stiff, but nearer then: of the two the one with the lower energy.
    """
    x, d, n = design.median.x, dc.ravel(), design.median.x.size
    stiffened = response.stiffened @ d
    ways = (response.dx_dc @ d, response.df_dc @ d), (stiffened[:n], stiffened[n:])

    def energy(way: tuple[FloatArray, FloatArray]) -> float:
        return equilibria.median_gradient(design.rho, equilibria.held_turning.step(x, way[0].reshape(-1, 3)))[1]

    dx, df = min(ways, key=energy)
    return dx.reshape(-1, 3), df.reshape(-1, 3)


def with_scaled_modulus(
    equilibria: Equilibria, design: Design, near: Linearisation, phase: str, factor: float
) -> Design | None:
    """The design at the same held positions with mu and kappa of one of PHASES times `factor`."""
    moduli: Moduli = getattr(equilibria.problem, phase)
    other = equilibria.with_moduli(**{phase: Moduli(factor * moduli.mu, factor * moduli.kappa)})
    held, x, f, y = held_positions(equilibria, design.median), design.median.x, design.median.forces, design.final.y
    return equilibrate(other, design.rho, held, x, f, y, SEARCH_TOLERANCE, NEWTON_STEPS, near=near)


def with_scaled_forces(
    equilibria: Equilibria, design: Design, near: Linearisation, response: Response, factor: float
) -> Design | None:
    """The design with `factor` times its forces; None where no path of equilibria leads there."""
    problem = equilibria.problem
    turning = Turning(problem.body, np.flatnonzero(problem.clamp), equilibria.operator[:0])
    travel = np.linalg.norm(response.moves_for_forces((factor - 1) * design.median.forces), axis=1).max(initial=0.0)
    for parts in FORCE_PARTS[int(travel > LONGEST_MOVE) :]:
        median: Median | None = design.median
        for share in np.linspace(0, 1, parts + 1)[1:]:
            wanted = (1 + share * (factor - 1)) * design.median.forces
            median = _median_of_forces(equilibria, turning, design.rho, median, wanted) if median else None
        if median is not None:
            return _unloaded(equilibria, design, near, median)
    return None


def _median_of_forces(
    equilibria: Equilibria, turning: Turning, rho: FloatArray, median: Median, wanted: FloatArray
) -> Median | None:
    """The median shape near another one that the wanted forces (K, 3) hold; None where it is not found.

    The points stay locked while it is sought, for under the forces themselves the shape need not be stable. Damped
    Newton steps on the held positions; what is left is measured as moves of the points, for as forces stiff directions
    would hide the soft ones (natural monotonicity test: Deuflhard, Newton Methods for Nonlinear Problems, 3.3).
    """
    damping = 1.0
    for _ in range(MOST_FORCE_STEPS):
        if np.linalg.norm(wanted - median.forces) <= FORCE_TOLERANCE * np.linalg.norm(wanted):
            return median
        step = _step_to_forces(equilibria, turning, rho, median, wanted, damping)
        if step is None:
            return None
        median, damping = step
    return None


def _step_to_forces(
    equilibria: Equilibria, turning: Turning, rho: FloatArray, median: Median, wanted: FloatArray, damping: float
) -> tuple[Median, float] | None:
    """The median shape after a damped Newton step to the wanted forces (K, 3), and the damping of the next step."""
    n = median.x.size
    tangent = _stable_tangent(equilibria, rho, median)
    if tangent is None:
        return None
    columns = _held_columns(tangent, n, median.forces.size)
    dc = _least_moves(columns[n:], wanted - median.forces)
    size = float(np.linalg.norm(dc))
    damping = min(damping, LONGEST_MOVE / size)
    while damping >= SMALLEST_DAMPING:
        dz = columns @ (damping * dc.ravel())
        x = turning.step(median.x, dz[:n].reshape(-1, 3))
        f = median.forces + dz[n:].reshape(-1, 3)
        held = equilibria.patches.mean(x) + RIG_COMPLIANCE * f
        trial = equilibria.solve_median(rho, held, x, f, SEARCH_TOLERANCE, FEW_NEWTON_STEPS, near=tangent)
        if not trial.solution.converged:
            damping /= 4
            continue
        left = _least_moves(columns[n:], wanted - trial.forces)
        if np.linalg.norm(left) <= (1 - damping / 4) * size:
            return trial, min(1.0, 2 * damping)
        bend = float(np.linalg.norm(left - (1 - damping) * dc))
        damping = min(damping / 2, damping**2 * size / (2 * bend))
    return None


def _stable_tangent(equilibria: Equilibria, rho: FloatArray, median: Median) -> Factor | None:
    """None where the shape is not stable even with its points locked: the part would have snapped over on the way."""
    try:
        tangent = equilibria.held_analysis.factor(equilibria.median_tangent(rho, median.x))
    except SingularMatrixError:
        return None
    return tangent if tangent.n_negative == median.forces.size else None


def _held_columns(tangent: Factor, n: int, k: int) -> FloatArray:
    """(n + k, k) derivatives of the n positions of the median shape and of its k forces by the held positions."""
    rhs = np.zeros((n + k, k))
    rhs[n + np.arange(k), np.arange(k)] = -1.0
    return tangent.solve_many(rhs)


def _least_moves(df_dc: FloatArray, change: FloatArray) -> FloatArray:
    """The smallest moves (K, 3) of the held positions that change the forces by `change` (K, 3)."""
    moves: FloatArray = np.linalg.lstsq(df_dc, change.ravel(), rcond=NO_STIFFNESS)[0].astype(np.float64)
    return moves.reshape(-1, 3)


def _unloaded(equilibria: Equilibria, design: Design, near: Linearisation, median: Median) -> Design | None:
    """The design with another median shape."""
    y, cold = design.final.y, Pinned(near.free, near.free_fixed)
    for guess in (y, y + median.x - design.median.x, median.x):
        final = equilibria.solve_final(design.rho, median, guess, SEARCH_TOLERANCE, NEWTON_STEPS, near=cold)
        if final.solution.converged:
            return Design(design.rho, median, final)
    return None
