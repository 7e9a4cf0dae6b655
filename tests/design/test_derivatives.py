"""Derivatives of the whole design against central differences of re-solved equilibria."""

from collections.abc import Callable

import numpy as np
import pytest
from bars import TIGHT, bar, held_design, mixed_density, two_patches

from fab4d.design.equilibria import Equilibria, Final, Median
from fab4d.design.gauss_newton import Design, build_model, equilibrate, evaluate, held_positions
from fab4d.design.objective import ObjectiveWeights, density_terms, smoothness_matrix, squeeze, stretch_excess
from fab4d.design.sensitivity import linearise

STEPS = 10.0 ** -np.arange(2.0, 7.0, 0.5)


def best_error(f: Callable[[float], np.ndarray], derivative: np.ndarray) -> float:
    """Smallest relative error of df/dt at 0 against central differences, over a sweep of steps."""
    differences = [(f(t) - f(-t)) / (2 * t) for t in STEPS]
    return min(float(np.linalg.norm(d - derivative) / np.linalg.norm(derivative)) for d in differences)


class Moved:
    """The design at t along a direction of density and held positions, solved anew to rounding."""

    def __init__(self, equilibria: Equilibria, at: Design, seed: int) -> None:
        rng = np.random.default_rng(seed)
        self.equilibria, self.at = equilibria, at
        self.drho = rng.standard_normal(len(at.rho))
        self.held = held_positions(equilibria, at.median)
        self.dc = 0.1 * rng.standard_normal(self.held.shape)

    def __call__(self, t: float) -> Design:
        at = self.at
        rho, held = at.rho + t * self.drho, self.held + t * self.dc
        # Guessed where they are, so that the final shape keeps the six dofs that the derivatives fix.
        median = self.equilibria.solve_median(rho, held, at.median.x, at.median.forces, TIGHT, 30)
        final = self.equilibria.solve_final(rho, median, at.final.y, TIGHT, 30)
        assert median.solution.converged
        assert final.solution.converged
        return Design(rho, median, final)


@pytest.fixture(scope="module", params=["linear", "quadratic"])
def moved(request: pytest.FixtureRequest) -> Moved:
    problem = bar((3, 2, 1), element=request.param)
    equilibria = two_patches(problem)
    return Moved(equilibria, held_design(equilibria, mixed_density(problem), problem.X_temp), 1)


def test_forward_is_the_derivative_of_both_equilibria(moved: Moved) -> None:
    lin = linearise(moved.equilibria, moved.at.rho, moved.at.median, moved.at.final)
    dx, df, dy = lin.forward(moved.drho, moved.dc)
    designs: dict[float, Design] = {t: moved(t) for t in np.r_[STEPS, -STEPS]}
    assert best_error(lambda t: designs[t].median.x, dx) < 1e-8
    assert best_error(lambda t: designs[t].median.forces, df) < 1e-8
    assert best_error(lambda t: designs[t].final.y, dy) < 1e-8


def test_adjoint_is_the_transpose_of_forward(moved: Moved) -> None:
    lin = linearise(moved.equilibria, moved.at.rho, moved.at.median, moved.at.final)
    change = lin.forward(moved.drho, moved.dc)
    rng = np.random.default_rng(2)
    for used in np.eye(3):
        g = [share * rng.standard_normal(d.shape) for share, d in zip(used, change, strict=True)]
        g_rho, g_c = lin.adjoint(*g)
        forward = sum(float((a * b).sum()) for a, b in zip(g, change, strict=True))
        # A random g turns the part about its six fixed dofs, which costs digits.
        assert float(g_rho @ moved.drho + (g_c * moved.dc).sum()) == pytest.approx(forward, rel=1e-8)


def test_held_columns_are_forward_of_each_held_coordinate(moved: Moved) -> None:
    lin = linearise(moved.equilibria, moved.at.rho, moved.at.median, moved.at.final)
    for column, forward in zip(lin.held_columns(), lin.forward(np.zeros_like(moved.drho), moved.dc), strict=True):
        np.testing.assert_allclose(column @ moved.dc.ravel(), forward.ravel(), atol=1e-10 * np.abs(forward).max())


def test_the_final_shape_follows_the_median_shape_as_when_both_are_moved(moved: Moved) -> None:
    lin = linearise(moved.equilibria, moved.at.rho, moved.at.median, moved.at.final)
    dx, _, dy = lin.forward(np.zeros_like(moved.drho), moved.dc)
    np.testing.assert_allclose(lin.final_follows(dx), dy, atol=1e-12 * np.abs(dy).max())


def test_the_guess_of_a_final_shape_that_follows_is_right_to_first_order(
    moved: Moved, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of the design with moved points, guessed where it is."""
    at, lin = moved.at, linearise(moved.equilibria, moved.at.rho, moved.at.median, moved.at.final)
    guesses, solve = list[np.ndarray](), Equilibria.solve_final

    def watched(
        self: Equilibria, rho: np.ndarray, median: Median, y: np.ndarray, *rest: object, **more: object
    ) -> Final:
        guesses.append(y)
        return solve(self, rho, median, y, *rest, **more)  # type: ignore[arg-type]

    monkeypatch.setattr(Equilibria, "solve_final", watched)
    off = []
    for t in (0.02, 0.01):
        there = equilibrate(
            moved.equilibria,
            at.rho,
            moved.held + t * moved.dc,
            at.median.x,
            at.median.forces,
            at.final.y,
            TIGHT,
            near=lin,
        )
        assert there is not None
        off.append(np.linalg.norm(guesses[-1] - there.final.y))
    assert off[1] < 0.3 * off[0]


def weights_for(design: Design) -> ObjectiveWeights:
    """All terms at work: one patch force beyond its limit, one within, some tets stretched or squeezed too far."""
    sizes = np.linalg.norm(design.median.forces, axis=1)
    return ObjectiveWeights(
        error_scale=0.01,
        lam_SMP=0.3,
        lam_mat=0.2,
        lam_round=0.1,
        lam_smooth=0.5,
        max_force=float(np.sqrt(sizes.min() * sizes.max())),
        smp_max_stretch=1.02,
        tpe_max_stretch=1.02,
        least_stretch=0.99,
        lam_squeeze=1000.0,
    )


def test_gradient_of_the_objective(moved: Moved) -> None:
    weights, L = weights_for(moved.at), smoothness_matrix(moved.equilibria.problem)
    model = build_model(moved.equilibria, weights, L, moved.at)
    assert len(model.force_rows) == 1
    problem, x = moved.equilibria.problem, moved.at.median.x
    stretched, squeezed = stretch_excess(problem, weights, moved.at.rho, x).tets, squeeze(problem, weights, x).tets
    assert 0 < len(stretched) < len(moved.drho)
    assert 0 < len(squeezed) < len(moved.drho)
    assert model.shape_rows.shape[0] == len(stretched) + len(squeezed)
    slope = model.gradient_rho @ moved.drho + model.gradient_c @ moved.dc.ravel()
    assert best_error(lambda t: np.array([evaluate(moved.equilibria, weights, L, moved(t))]), np.array([slope])) < 1e-7


def test_gradient_vanishes_for_rigid_motions_of_the_final_shape(moved: Moved) -> None:
    """Which six dofs fix the final shape must not matter: its error gradient carries no force and no moment."""
    model = build_model(moved.equilibria, weights_for(moved.at), smoothness_matrix(moved.equilibria.problem), moved.at)
    metric = model.metric
    y = moved.at.final.y
    for spin in np.eye(3):
        turn = np.cross(spin, y).ravel()
        assert np.abs(metric.apply(turn)).max() < 1e-9 * np.abs(metric.weights * turn).max()
    push = np.tile([1.0, 2.0, -1.0], len(y))
    assert np.abs(metric.apply(push)).max() < 1e-9 * np.abs(metric.weights * push).max()


def test_squeezed_tets_are_those_whose_smallest_stretch_is_below_the_least(moved: Moved) -> None:
    """A uniform squeeze that is turned: no tet counts at its own stretch, and all alike below it, by their volume."""
    problem = moved.equilibria.problem
    turn = np.linalg.qr(np.random.default_rng(4).standard_normal((3, 3)))[0]
    x = problem.body.X @ (turn @ np.diag([0.6, 1.3, 1.1]) @ turn.T)
    for least, lacking in ((0.599, None), (0.75, 0.2)):
        weights = ObjectiveWeights(error_scale=1.0, least_stretch=least, lam_squeeze=7.0)
        found = squeeze(problem, weights, x)
        if lacking is None:
            assert not len(found.tets)
        else:
            assert 0.5 * (found.values**2).sum() == pytest.approx(7.0 * lacking**2, rel=1e-12)
    assert not len(squeeze(problem, ObjectiveWeights(error_scale=1.0, least_stretch=0.75), x).tets)


@pytest.mark.parametrize("name", ["lam_SMP", "lam_mat", "lam_round", "lam_smooth"])
def test_gradient_of_each_density_term(name: str) -> None:
    problem = bar((3, 2, 1))
    L, v = smoothness_matrix(problem), problem.volume_fractions
    weights = ObjectiveWeights(error_scale=1.0).replace(**{name: 0.7})
    rho, direction = mixed_density(problem), np.random.default_rng(3).standard_normal(problem.n_tets)

    def value(t: float) -> np.ndarray:
        return np.array([density_terms(weights, v, L, rho + t * direction).value])

    assert best_error(value, np.array([density_terms(weights, v, L, rho).gradient @ direction])) < 1e-9


def test_density_curvature_is_the_positive_part_of_the_second_derivative() -> None:
    problem = bar((3, 2, 1))
    L, v = smoothness_matrix(problem), problem.volume_fractions
    rho = np.linspace(0.0, 1.0, problem.n_tets)
    weights = ObjectiveWeights(error_scale=1.0, lam_SMP=0.3, lam_mat=0.2)
    h = 1e-5
    second = (density_terms(weights, v, L, rho + h).gradient - density_terms(weights, v, L, rho - h).gradient) / (2 * h)
    # 2 lam_SMP is always positive; only what E_mat adds is cut off below zero.
    from_mat = np.maximum(second - 2 * 0.3 * v, 0.0)
    np.testing.assert_allclose(density_terms(weights, v, L, rho).curvature, 2 * 0.3 * v + from_mat, atol=1e-9)


def test_smoothness_sums_squared_jumps_over_interior_faces() -> None:
    problem = bar((3, 2, 1))
    L, rho = smoothness_matrix(problem), mixed_density(problem)
    areas = problem.neighbour_areas
    jumps = rho[problem.neighbours[:, 0]] - rho[problem.neighbours[:, 1]]
    assert float(rho @ L @ rho) == pytest.approx(float(areas @ jumps**2 / areas.sum()), rel=1e-12)
    assert np.abs(L @ np.ones(problem.n_tets)).max() < 1e-15
    assert np.linalg.eigvalsh(L.toarray()).min() > -1e-15


# -- the Gauss-Newton Hessian


def dense_schur(
    moved: Moved, weights: ObjectiveWeights, damping: float, moves: float, held_damping: np.ndarray
) -> np.ndarray:
    """H_rr - H_rc H_cc^-1 H_cr from explicit Jacobians and an explicit projection along the rigid modes."""
    equilibria, at = moved.equilibria, moved.at
    problem, m, k = equilibria.problem, len(at.rho), at.median.forces.size
    lin = linearise(equilibria, at.rho, at.median, at.final)
    model = build_model(equilibria, weights, smoothness_matrix(problem), at)
    columns = []
    for j in range(m + k):
        unit = np.eye(m + k)[j]
        columns.append([d.ravel() for d in lin.forward(unit[:m], unit[m:].reshape(-1, 3))])
    Jx, Jf, Jy = (np.array(part).T for part in zip(*columns, strict=True))
    y, a = at.final.y, problem.area_weights
    modes = np.array([*(np.tile(e, len(y)) for e in np.eye(3)), *(np.cross(e, y).ravel() for e in np.eye(3))]).T
    W = np.diag(2 * np.repeat(a, 3) / weights.error_scale**2)
    P = np.eye(y.size) - modes @ np.linalg.solve(modes.T @ W @ modes, modes.T @ W)
    blocks = (P @ Jy).T @ W @ (P @ Jy) + moves * Jx.T @ Jx
    for rows, J in ((model.force_rows, Jf), (model.shape_rows.toarray(), Jx)):
        blocks += (rows @ J).T @ (rows @ J)
    density = np.diag(model.terms.curvature + damping * problem.volume_fractions)
    blocks[:m, :m] += density + 2 * weights.lam_smooth * model.L.toarray()
    blocks[m:, m:] += held_damping
    return blocks[:m, :m] - blocks[:m, m:] @ np.linalg.solve(blocks[m:, m:], blocks[m:, :m])


def hessian_matrix(model: object, n: int) -> np.ndarray:
    return np.array([model.hessian(e) for e in np.eye(n)])  # type: ignore[attr-defined]


def test_hessian_is_the_schur_complement_of_the_gauss_newton_matrix(moved: Moved) -> None:
    weights, problem = weights_for(moved.at), moved.equilibria.problem
    model = build_model(moved.equilibria, weights, smoothness_matrix(problem), moved.at)
    damping = 0.1
    damped = model.damped(damping, problem.volume_fractions)
    H = hessian_matrix(damped, problem.n_tets)
    np.testing.assert_allclose(H, H.T, atol=1e-10 * np.abs(H).max())
    assert np.linalg.eigvalsh(0.5 * (H + H.T)).min() > 0
    factor, lower = damped.held_factor
    assert not lower
    held_damping = np.triu(factor).T @ np.triu(factor) - model.H_cc - damped.moves * model.moved_cc
    assert np.linalg.eigvalsh(held_damping).min() > 0
    dense = dense_schur(moved, weights, damping, damped.moves, held_damping)
    np.testing.assert_allclose(H, dense, atol=1e-9 * np.abs(dense).max())


def test_hessian_of_the_error_alone_is_positive_semidefinite(moved: Moved) -> None:
    problem = moved.equilibria.problem
    model = build_model(moved.equilibria, ObjectiveWeights(error_scale=0.01), smoothness_matrix(problem), moved.at)
    H = hessian_matrix(model.damped(0.0, problem.volume_fractions), problem.n_tets)
    np.testing.assert_allclose(H, H.T, atol=1e-10 * np.abs(H).max())
    assert np.linalg.eigvalsh(0.5 * (H + H.T)).min() > -1e-10 * np.abs(H).max()


def test_held_step_and_reduced_gradient_solve_the_whole_system(moved: Moved) -> None:
    """The held step of the best density step is where the gradient of the quadratic model vanishes."""
    weights, problem = weights_for(moved.at), moved.equilibria.problem
    model = build_model(moved.equilibria, weights, smoothness_matrix(problem), moved.at)
    damped = model.damped(0.1, problem.volume_fractions)
    drho = -np.linalg.solve(hessian_matrix(damped, problem.n_tets), damped.reduced_gradient())
    assert np.abs(damped.hessian(drho) + damped.reduced_gradient()).max() < 1e-9 * np.abs(model.gradient_rho).max()
    dc = damped.held_step(drho)
    change = model.lin.forward(drho, dc)
    rows = model.force_rows @ change[1].ravel()
    stretched = model.shape_rows @ change[0].ravel()
    pull = (
        model.dy_dc.T @ model.metric.apply(change[2].ravel())
        + model.df_dc.T @ (model.force_rows.T @ rows)
        + model.dx_dc.T @ (model.shape_rows.T @ stretched + damped.moves * change[0].ravel())
    )
    factor, lower = damped.held_factor
    assert not lower
    held_damping = np.triu(factor).T @ np.triu(factor) - model.H_cc - damped.moves * model.moved_cc
    slope = model.gradient_c + pull + held_damping @ dc.ravel()
    assert np.abs(slope).max() < 1e-9 * np.abs(model.gradient_c).max()
