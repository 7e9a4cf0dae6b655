"""Points that help little are given up for points where the error stays.

All forces, those of the points held and those of candidates, are put in one linear model of the final shape. In it the
best single exchanges follow from small dense systems; what they promise is then judged by the equilibria.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from fab4d.design.equilibria import RIG_COMPLIANCE, Equilibria
from fab4d.design.gauss_newton import SEARCH_TOLERANCE, Design, Model
from fab4d.design.objective import ObjectiveWeights, shape_error
from fab4d.design.patches import Patches, build_patches, pad_vertices, spread_centers
from fab4d.design.problem import Problem
from fab4d.mesh.tetmesh import FloatArray, IntArray

CANDIDATES = 100
# An exchange has to lower the predicted objective by this share of it, or by the smaller one while the tolerance is
# missed; no more are made at once.
LEAST_GAIN, LEAST_GAIN_BEYOND, MOST_EXCHANGES = 0.03, 0.01, 6
# Additions that are tried with each removal.
BEST_ADDITIONS = 8
FORCE_RIDGE = 1e-3
SMALLEST_FADE = 1e-2


@dataclass(frozen=True, eq=False)
class ForceModel:
    """E_p / error_scale^2 as a quadratic of the changes (T, 3) of all forces: K of the points, then the candidates'.

    H (3T, 3T), gradient (3T,), value : of the quadratic        ridge (3T,) : holds forces back that do hardly anything
    present (3T,) : the forces as they are, zero at candidates
    """

    H: FloatArray
    gradient: FloatArray
    value: float
    ridge: FloatArray
    present: FloatArray

    def without(self, chosen: Sequence[int], gone: Sequence[int]) -> float:
        """The least value when only the forces `chosen` change and those `gone` vanish."""
        x = np.zeros_like(self.present)
        x[dofs(gone)] = -self.present[dofs(gone)]
        free = dofs(chosen)
        push = (self.gradient + self.H @ x)[free]
        x[free] = -np.linalg.solve(self.H[np.ix_(free, free)] + np.diag(self.ridge[free]), push)
        return self.value + float(self.gradient @ x + 0.5 * x @ self.H @ x)


def dofs(points: Sequence[int]) -> IntArray:
    """(3k,) components of the forces of `points`."""
    return (3 * np.asarray(points, np.int64)[:, None] + np.arange(3)).ravel()


def exchanged(
    equilibria: Equilibria, weights: ObjectiveWeights, model: Model, design: Design, radius: float
) -> Iterator[tuple[Equilibria, Design]]:
    """The design held at better points, in equilibrium: with all exchanges that promise enough, half of them, the best.

    model : of the objective at the design        radius : of a patch, L0
    Empty where no exchange promises enough or leads to an equilibrium.
    """
    patches, problem = equilibria.patches, equilibria.problem
    centers = candidate_centers(problem, patches, shape_error(problem, design.final.y).e, radius)
    if not patches.count or not len(centers):
        return
    forces = force_model(equilibria, weights, model, design, _separate_patches(problem, centers, radius))
    better = better_points(forces, patches.count)
    for made in sorted({len(better), (len(better) + 1) // 2, min(len(better), 1)} - {0}, reverse=True):
        chosen = better[made - 1]
        kept = np.array([k for k in chosen if k < patches.count], np.int64)
        new = np.array([k - patches.count for k in chosen if k >= patches.count], np.int64)
        moved = _moved(equilibria, design, kept, np.concatenate([patches.centers[kept], centers[new]]), radius)
        if moved is not None:
            yield moved


def held_apart(
    equilibria: Equilibria, weights: ObjectiveWeights, model: Model, design: Design, other: FloatArray, radius: float
) -> tuple[Equilibria, Design] | None:
    """The design held where it differs most from another shape that its points hold, so that they hold one shape only.

    model : of the objective at the design        other : (N, 3) median shape        radius : of a patch, L0
    The point that helps least is given up. None where every vertex has a point near, or no equilibrium leads there.
    """
    patches, problem = equilibria.patches, equilibria.problem
    among = _away_from(problem, patches, pad_vertices(problem), radius)
    if not len(among):
        return None
    apart = np.linalg.norm(other - design.median.x, axis=1)[among]
    center = among[[int(np.argmax(apart))]]
    forces = force_model(equilibria, weights, model, design, _separate_patches(problem, center, radius))
    points = list(range(patches.count + 1))
    idle = min(points[:-1], key=lambda k: forces.without([p for p in points if p != k], [k]))
    kept = np.delete(np.arange(patches.count), idle)
    return _moved(equilibria, design, kept, np.concatenate([patches.centers[kept], center]), radius)


# -- candidates


def candidate_centers(problem: Problem, patches: Patches, e: FloatArray, radius: float) -> IntArray:
    """Vertices for new patches: half spread out, half where the error e (N, 3) is largest; none at `patches`."""
    half = CANDIDATES // 2
    centers = np.unique(np.concatenate([spread_centers(problem, half), worst_centers(problem, e, half, radius)]))
    return _away_from(problem, patches, centers, radius)


def _away_from(problem: Problem, patches: Patches, centers: IntArray, radius: float) -> IntArray:
    """Those of the vertices `centers` that are not within a radius of the centre of a patch."""
    X = problem.body.X
    gaps = np.linalg.norm(X[centers][:, None] - X[patches.centers], axis=2)
    return centers[gaps.min(axis=1, initial=np.inf) > radius]


def worst_centers(problem: Problem, e: FloatArray, count: int, radius: float) -> IntArray:
    """`count` vertices with the largest error, no two of them within a patch of each other."""
    among = pad_vertices(problem)
    X, size = problem.body.X[among], np.linalg.norm(e[among], axis=1)
    centers: list[int] = []
    while len(centers) < count and size.max(initial=-1.0) >= 0:
        worst = int(np.argmax(size))
        centers.append(int(among[worst]))
        size[np.linalg.norm(X - X[worst], axis=1) <= 2 * radius] = -1.0
    return np.array(centers, np.int64)


def _separate_patches(problem: Problem, centers: IntArray, radius: float) -> Patches:
    """One patch for each centre as if it were the only one: candidates may overlap."""
    each = [build_patches(problem, centers[k : k + 1], radius) for k in range(len(centers))]
    rows = np.repeat(np.arange(len(each)), [len(p.nodes) for p in each])
    nodes, weights = (np.concatenate([getattr(p, name) for p in each]) for name in ("nodes", "weights"))
    return Patches(centers, np.zeros((0, 3), np.int64), np.zeros(len(centers) + 1, np.int64), rows, nodes, weights)


# -- linear model


def force_model(
    equilibria: Equilibria, weights: ObjectiveWeights, model: Model, design: Design, candidates: Patches
) -> ForceModel:
    """The quadratic model in all forces, the rig pulling instead of holding."""
    problem = equilibria.problem
    by_force = _shape_by_force(model, candidates, problem.n_nodes)
    error = shape_error(problem, design.final.y)
    e = (2 * problem.area_weights[:, None] * (error.e @ error.R) / weights.error_scale**2).ravel()
    H = by_force.T @ model.metric.apply(by_force)
    blocks = np.trace(H.reshape(len(H) // 3, 3, -1, 3), axis1=1, axis2=3).diagonal() / 3
    present = np.zeros(len(H))
    present[: design.median.forces.size] = design.median.forces.ravel()
    value = (error.rms / weights.error_scale) ** 2
    return ForceModel(H, by_force.T @ e, value, FORCE_RIDGE * np.repeat(blocks, 3), present)


def _shape_by_force(model: Model, candidates: Patches, n_nodes: int) -> FloatArray:
    """dy/df (3N, 3(K + C)) of the forces at the points and at the candidates."""
    lin = model.lin
    n, k = lin.M.shape[0], 3 * lin.n_patches
    rhs = np.zeros((n + k, 3 * candidates.count))
    rhs[:n] = np.kron(candidates.operator(n_nodes).T.toarray(), np.eye(3))
    z, dy = lin.respond(rhs, np.zeros((n, rhs.shape[1])))
    of_points = np.linalg.solve(model.df_dc.T, model.dy_dc.T).T
    return np.hstack([of_points, dy - of_points @ z[n:]])


def better_points(model: ForceModel, count: int) -> list[list[int]]:
    """`count` of the model's points after one exchange, two, and so on, as long as each promises enough.

    The first `count` points are those held.
    """
    total = len(model.present) // 3
    chosen, gone = list(range(count)), set[int]()
    value = model.without(chosen, [])
    least = LEAST_GAIN if model.value <= 1 else LEAST_GAIN_BEYOND
    better: list[list[int]] = []
    while len(better) < MOST_EXCHANGES:
        others = [k for k in range(total) if k not in chosen]
        added = sorted(others, key=lambda k: model.without([*chosen, k], sorted(gone - {k})))
        options = []
        for new in added[:BEST_ADDITIONS]:
            for old in chosen:
                after = [k for k in chosen if k != old] + [new]
                missing = (gone | ({old} if old < count else set())) - {new}
                options.append((model.without(after, sorted(missing)), after, missing))
        best, after, missing = min(options, key=lambda option: option[0])
        if best > (1 - least) * value:
            break
        value, chosen, gone = best, after, missing
        better.append(chosen)
    return better


# -- the way there


def _moved(
    equilibria: Equilibria, design: Design, kept: IntArray, centers: IntArray, radius: float
) -> tuple[Equilibria, Design] | None:
    """The design held at `centers`, the first of which are the points `kept`; other forces fade to zero."""
    problem, forces = equilibria.problem, design.median.forces
    other = equilibria.with_patches(build_patches(problem, centers, radius))
    f = np.zeros((len(centers), 3))
    f[: len(kept)] = forces[kept]
    fading = forces.copy()
    fading[kept] = 0.0
    extra = equilibria.patches.spread(fading, problem.n_nodes)
    held = other.patches.mean(design.median.x) + RIG_COMPLIANCE * f
    median, y, done, step = design.median, design.final.y, 0.0, 1.0
    x = median.x
    while done < 1.0:
        aim = min(1.0, done + step)
        trial = other.solve_median(design.rho, held, x, f, SEARCH_TOLERANCE, 12, (1 - aim) * extra)
        final = other.solve_final(design.rho, trial, y, SEARCH_TOLERANCE, 12) if trial.solution.converged else None
        if final is not None and final.solution.converged:
            median, x, f, y, done, step = trial, trial.x, trial.forces, final.y, aim, 2 * step
            found = Design(design.rho, median, final)
        else:
            step /= 2
            if step < SMALLEST_FADE:
                return None
    return other, found
