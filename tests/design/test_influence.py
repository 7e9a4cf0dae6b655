"""What whole flips do: local systems against the forces of the materials, predictions against equilibria."""

import numpy as np
import pytest
from bars import TIGHT, bar, held_design, two_patches

from fab4d.design import influence as module
from fab4d.design.equilibria import Equilibria
from fab4d.design.flips import at_interface
from fab4d.design.gauss_newton import Design, equilibrate, held_positions
from fab4d.design.influence import Influence, flip_forces, influence
from fab4d.design.objective import shape_error
from fab4d.design.problem import Problem
from fab4d.design.sensitivity import linearise
from fab4d.elasticity import _kernels as kernels
from fab4d.materials.cards import Moduli

SCALE = 5e-3


def half_smp(problem: Problem) -> np.ndarray:
    X = problem.body.X
    return X[problem.body.elements[:, :4]].mean(axis=1)[:, 2] > 0.5 * X[:, 2].max()


@pytest.fixture(scope="module", params=["linear", "quadratic"])
def state(request: pytest.FixtureRequest) -> tuple[Equilibria, Design, np.ndarray]:
    """A bent bar, its upper half of SMP, and the tets at the interface."""
    problem = bar(cells=(4, 2, 2), degrees=35.0, element=request.param)
    equilibria, smp = two_patches(problem), half_smp(problem)
    design = held_design(equilibria, smp.astype(float), problem.X_temp)
    return equilibria, design, np.flatnonzero(at_interface(problem, smp))


def forces_of(problem: Problem, tets: np.ndarray, dN: np.ndarray, moduli: Moduli, u: np.ndarray) -> np.ndarray:
    """(k, 3nn) of tets with displacements u (k, nn, 3) of their own nodes."""
    k, nn = u.shape[:2]
    out, ones = np.zeros((k, nn, 3)), np.ones(k)
    own = np.arange(k * nn).reshape(k, nn)
    weights = problem.body.weights[tets]
    kernels.element_forces(own, dN, weights, moduli.mu * ones, moduli.kappa * ones, u.reshape(-1, 3), out)
    return out.reshape(k, -1)


def test_flipped_tets_exert_what_their_new_material_does_where_it_moves_them(
    state: tuple[Equilibria, Design, np.ndarray],
) -> None:
    """To first order: with half the compliance a fourth of the difference is left."""
    equilibria, design, tets = state
    problem, x, y = equilibria.problem, design.median.x, design.final.y
    elements, body = problem.body.elements[tets], problem.body
    random = np.random.default_rng(0)
    k, n = len(tets), 3 * elements.shape[1]
    roots = random.normal(size=(2, k, n, n))
    hot, cold = (1e-3 * np.einsum("kij,klj->kil", root, root) for root in roots)
    mixed = 0.1 * random.normal(size=(k, n, n))
    sign = np.where(design.rho[tets] > 0.5, -1.0, 1.0)[:, None]

    def differences(scale: float) -> list[float]:
        f_hot, f_cold = flip_forces(equilibria, design, tets, scale * hot, scale * cold, mixed)
        dx = -scale * np.einsum("kij,kj->ki", hot, f_hot)
        dy = -scale * np.einsum("kij,kj->ki", cold, f_cold + np.einsum("kij,kj->ki", mixed, dx))
        at_x, at_y = x[elements] + dx.reshape(k, -1, 3), y[elements] + dy.reshape(k, -1, 3)
        X, dN = body.X[elements], body.dN[tets]
        exact_hot = sign * sum(
            weight * forces_of(problem, tets, dN, moduli, at_x - X)
            for weight, moduli in ((1, problem.rubbery), (-1, problem.tpe))
        )
        frozen = np.zeros_like(dN)
        own = np.arange(elements.size).reshape(elements.shape)
        kernels.deformed_gradients(own, dN, (at_x - X).reshape(-1, 3), frozen)
        exact_cold = sign * (
            forces_of(problem, tets, frozen, problem.glassy, at_y - at_x)
            - forces_of(problem, tets, dN, problem.tpe, at_y - X)
        )
        return [float(np.linalg.norm(a - b)) for a, b in ((exact_hot, f_hot), (exact_cold, f_cold))]

    for coarse, fine in zip(differences(1e-3), differences(5e-4), strict=True):
        assert coarse == pytest.approx(4 * fine, rel=0.2)


def true_change(equilibria: Equilibria, design: Design, tet: int, found: Influence) -> np.ndarray:
    """Of the error, by the equilibria with the other material in a tet."""
    rho = design.rho.copy()
    rho[tet] = 1 - rho[tet]
    x, f, y = design.median.x, design.median.forces, design.final.y
    after = equilibrate(equilibria, rho, held_positions(equilibria, design.median), x, f, y, TIGHT, 60)
    assert after is not None
    return found.view.error(equilibria.problem, after.final.y) - found.residual


def test_predicted_changes_are_near_those_of_the_equilibria(
    state: tuple[Equilibria, Design, np.ndarray], monkeypatch: pytest.MonkeyPatch
) -> None:
    """In direction, and in size much nearer than the derivative by the density."""
    monkeypatch.setattr(module, "HELD_DAMPING", 1e12)  # nothing follows
    equilibria, design, tets = state
    some = tets[::7]
    found = influence(equilibria, design, some, SCALE)
    lin, problem = linearise(equilibria, design.rho, design.median, design.final), equilibria.problem
    alike, worth, by_derivative = [], [], []
    for k, tet in enumerate(some):
        true, change = true_change(equilibria, design, int(tet), found), found.change[k]
        alike.append((true @ change) / (np.linalg.norm(true) * np.linalg.norm(change)))
        worth.append((true @ change) / (change @ change))
        drho = np.zeros(problem.n_tets)
        drho[tet] = 1 - 2 * design.rho[tet]
        h = 1e-4
        ahead = design.final.y + h * lin.forward_rho(drho).y.reshape(-1, 3)
        slope = (found.view.error(problem, ahead) - found.residual) / h
        by_derivative.append((true @ slope) / (slope @ slope))
    assert np.median(alike) > 0.9
    assert min(alike) > 0.5
    assert 0.5 < np.median(worth) < 2.0
    off, off_by_derivative = (np.abs(np.log(np.maximum(each, 1e-3))).mean() for each in (worth, by_derivative))
    assert off < 0.6 * off_by_derivative


def test_modes_are_measures_of_what_the_surface_shows(
    state: tuple[Equilibria, Design, np.ndarray], monkeypatch: pytest.MonkeyPatch
) -> None:
    equilibria, design, tets = state
    monkeypatch.setattr(module, "HELD_DAMPING", 1e12)  # nothing follows
    whole = influence(equilibria, design, tets, SCALE)
    monkeypatch.setattr(module, "MOST_NUMBERS", 0)
    smooth = influence(equilibria, design, tets, SCALE)
    basis = smooth.view.basis
    assert basis is not None
    np.testing.assert_allclose(smooth.change, whole.change @ basis, atol=1e-7 * np.abs(whole.change).max())
    np.testing.assert_allclose(smooth.residual, whole.residual @ basis, atol=1e-7 * np.abs(whole.residual).max())
    rms = shape_error(equilibria.problem, design.final.y).rms
    for found in (whole, smooth):
        assert np.linalg.norm(found.residual) == pytest.approx(rms, rel=1e-6)


def test_held_positions_take_away_what_they_can(state: tuple[Equilibria, Design, np.ndarray]) -> None:
    equilibria, design, tets = state
    found = influence(equilibria, design, tets[:1], SCALE)
    moves = np.random.default_rng(0).normal(size=len(found.view.by_held))
    moved = moves @ found.view.by_held
    assert np.linalg.norm(found.view.without_held(moved)) < 0.1 * np.linalg.norm(moved)
    assert np.linalg.norm(found.residual) <= shape_error(equilibria.problem, design.final.y).rms * (1 + 1e-9)


def test_what_is_taught_is_predicted(state: tuple[Equilibria, Design, np.ndarray]) -> None:
    equilibria, design, tets = state
    found = influence(equilibria, design, tets, SCALE)
    flipped = np.zeros(len(tets), bool)
    flipped[::3] = True
    # One is worth half of what was thought, the others all of it, and there is something that none explains.
    other = np.zeros_like(found.residual)
    other[:5] = 0.1 * np.linalg.norm(found.residual)
    seen = found.left(flipped) - 0.5 * found.change[0] + other
    taught = found.taught(flipped, seen)
    np.testing.assert_allclose(taught.left(flipped), seen, atol=1e-12 * np.abs(seen).max())
    np.testing.assert_array_equal(taught.change[~flipped], found.change[~flipped])
    again = taught.taught(flipped, seen)
    np.testing.assert_allclose(again.change, taught.change, atol=1e-12 * np.abs(taught.change).max())


def test_only_those_that_promise_most_are_looked_at(state: tuple[Equilibria, Design, np.ndarray]) -> None:
    equilibria, design, tets = state
    whole = influence(equilibria, design, tets, SCALE)
    few = influence(equilibria, design, tets, SCALE, most=5)
    assert len(few.tets) == 5
    rows = np.searchsorted(whole.tets, few.tets)
    np.testing.assert_allclose(few.change, whole.change[rows], atol=1e-9 * np.abs(whole.change).max())
    gains = -(whole.change @ whole.residual)
    assert gains[rows].min() > np.median(gains)
