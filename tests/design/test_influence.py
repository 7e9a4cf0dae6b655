"""What whole flips do: local systems against the forces of the materials, predictions against equilibria."""

from dataclasses import replace

import numpy as np
import pytest
from bars import TIGHT, bar, held_design, two_patches

from fab4d.design import influence as module
from fab4d.design.equilibria import Equilibria
from fab4d.design.flip_loads import cold_forces, hot_forces
from fab4d.design.flips import at_interface
from fab4d.design.gauss_newton import Design, equilibrate, guessed, held_positions
from fab4d.design.influence import FlipEnergy, Influence, influence
from fab4d.design.objective import ObjectiveWeights, shape_error, squeeze, stretch_excess
from fab4d.design.problem import Problem
from fab4d.design.sensitivity import linearise
from fab4d.elasticity import _kernels as kernels
from fab4d.materials.cards import Moduli

WEIGHTS = ObjectiveWeights(error_scale=5e-3)


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
        f_hot = hot_forces(equilibria, design, tets, scale * hot)
        dx = -scale * np.einsum("kij,kj->ki", hot, f_hot)
        followed = -scale * np.einsum("kij,kj->ki", cold, np.einsum("kij,kj->ki", mixed, dx))
        f_cold = cold_forces(equilibria, design, tets, dx, followed, scale * cold)
        dy = followed - scale * np.einsum("kij,kj->ki", cold, f_cold)
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


def flipped_design(equilibria: Equilibria, design: Design, tet: int) -> Design:
    """The equilibria with the other material in a tet."""
    rho = design.rho.copy()
    rho[tet] = 1 - rho[tet]
    x, f, y = design.median.x, design.median.forces, design.final.y
    after = equilibrate(equilibria, rho, held_positions(equilibria, design.median), x, f, y, TIGHT, 60)
    assert after is not None
    return after


def true_change(equilibria: Equilibria, design: Design, tet: int, found: Influence) -> np.ndarray:
    """Of the error, by the equilibria with the other material in a tet."""
    y = flipped_design(equilibria, design, tet).final.y
    return found.view.error(equilibria.problem, y) - found.residual


def test_predicted_changes_are_near_those_of_the_equilibria(
    state: tuple[Equilibria, Design, np.ndarray], monkeypatch: pytest.MonkeyPatch
) -> None:
    """In direction, and in size much nearer than the derivative by the density."""
    monkeypatch.setattr(module, "HELD_DAMPING", 1e12)  # nothing follows
    equilibria, design, tets = state
    some = tets[::7]
    found = influence(equilibria, design, some, WEIGHTS)
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
    assert np.median(alike) > 0.95
    assert min(alike) > 0.8
    assert 0.85 < np.median(worth) < 1.1
    off, off_by_derivative = (np.abs(np.log(np.maximum(each, 1e-3))).mean() for each in (worth, by_derivative))
    assert off < 0.3 * off_by_derivative


def test_measures_of_the_surface_lose_what_probes_tell(
    state: tuple[Equilibria, Design, np.ndarray], monkeypatch: pytest.MonkeyPatch
) -> None:
    """As many sums of flips as flips span all that these do; fewer leave something out."""
    equilibria, design, tets = state
    whole = influence(equilibria, design, tets, WEIGHTS)
    fields = whole.shape_change @ whole.view.basis.T
    size = np.linalg.norm(fields, axis=1)
    assert (np.sqrt(whole.unseen) < 1e-6 * size).all()
    monkeypatch.setattr(module, "SAMPLES", 4)
    monkeypatch.setattr(module, "PROBES", 400)
    coarse = influence(equilibria, design, tets, WEIGHTS)
    seen, rms = fields @ coarse.view.basis, shape_error(equilibria.problem, design.final.y).rms
    np.testing.assert_allclose(coarse.shape_change, seen, atol=1e-6 * size.max())
    lost = size**2 - np.linalg.norm(seen, axis=1) ** 2
    assert lost.sum() > 0.01 * (size**2).sum()
    np.testing.assert_allclose(coarse.unseen, lost, rtol=0.3, atol=1e-6 * size.max() ** 2)
    assert np.linalg.norm(coarse.shape) == pytest.approx(rms, rel=1e-6)
    moved = whole.view.shape_by_held @ whole.view.basis.T
    np.testing.assert_allclose(coarse.view.shape_by_held, moved @ coarse.view.basis, atol=1e-6 * np.abs(moved).max())
    assert np.linalg.norm(coarse.view.shape_by_held) == pytest.approx(np.linalg.norm(moved))


def test_held_positions_take_away_what_they_can(state: tuple[Equilibria, Design, np.ndarray]) -> None:
    equilibria, design, tets = state
    found = influence(equilibria, design, tets[:1], WEIGHTS)
    by_held = found.view.shape_by_held
    moved = np.random.default_rng(0).normal(size=len(by_held)) @ by_held
    assert np.linalg.norm(found.view.without_held(moved)) < 0.1 * np.linalg.norm(moved)
    assert np.linalg.norm(found.residual) <= shape_error(equilibria.problem, design.final.y).rms * (1 + 1e-9)


@pytest.mark.parametrize("damping", [0.03, 1e12])
def test_equilibria_are_near_where_flips_are_predicted_to_lead(
    state: tuple[Equilibria, Design, np.ndarray], monkeypatch: pytest.MonkeyPatch, damping: float
) -> None:
    """One flip, the held positions moved along or left where they are."""
    monkeypatch.setattr(module, "HELD_DAMPING", damping)
    equilibria, design, tets = state
    found, problem = influence(equilibria, design, tets, WEIGHTS), equilibria.problem
    for k in (0, 7):
        flipped = np.arange(len(tets)) == k
        ahead, rho = found.ahead(flipped, found.after(flipped).moves), design.rho.copy()
        rho[tets[k]] = 1 - rho[tets[k]]
        held = held_positions(equilibria, design.median) + ahead.moves
        true = equilibrate(equilibria, rho, held, *guessed(equilibria, design, rho, ahead))
        assert true is not None
        moved = true.median.x - design.median.x
        assert np.linalg.norm(moved - ahead.x) < 0.4 * np.linalg.norm(moved)
        start, end, guess = (
            shape_error(problem, y).e for y in (design.final.y, true.final.y, design.final.y + ahead.y)
        )
        assert np.linalg.norm(guess - end) < 0.7 * np.linalg.norm(end - start)
        assert (np.abs(ahead.moves).max() > 1e-3) == (damping < 1)


def test_what_is_taught_is_predicted(state: tuple[Equilibria, Design, np.ndarray]) -> None:
    equilibria, design, tets = state
    found = influence(equilibria, design, tets, limiting(equilibria, design))
    flipped = np.zeros(len(tets), bool)
    flipped[::3] = True
    # One is worth half of what was thought, the others all of it, and there is something that none explains.
    other = np.zeros_like(found.shape)
    other[:5] = 0.1 * np.linalg.norm(found.shape)
    shape = found.shape + found.shape_change[flipped].sum(axis=0) - 0.5 * found.shape_change[0] + other
    beyond = found.beyond + 2 * found.limit_change[flipped].sum(axis=0)
    taught = found.taught(flipped, shape, beyond)
    size = np.abs(shape).max()
    np.testing.assert_allclose(taught.shape + taught.shape_change[flipped].sum(axis=0), shape, atol=1e-12 * size)
    np.testing.assert_allclose(taught.beyond + taught.limit_change[flipped].sum(axis=0), beyond, atol=1e-12)
    np.testing.assert_array_equal(taught.change[~flipped], found.change[~flipped])
    again = taught.taught(flipped, shape, beyond)
    np.testing.assert_allclose(again.change, taught.change, atol=1e-12 * np.abs(taught.change).max())


# -- limits


def limiting(equilibria: Equilibria, design: Design) -> ObjectiveWeights:
    """Limits that some tets of the design are beyond, and more are near."""
    F = np.einsum("mai,maj->mij", design.median.x[equilibria.problem.body.elements], equilibria.problem.body.dN.mean(1))
    stretches = np.linalg.svd(F)[1]
    most, least = np.quantile(stretches[:, 0], 0.97), np.quantile(stretches[:, 2], 0.03)
    return WEIGHTS.replace(limit=0.1, smp_max_stretch=most, tpe_max_stretch=most, least_stretch=least, lam_squeeze=10.0)


def test_the_length_of_all_measures_is_the_objective(state: tuple[Equilibria, Design, np.ndarray]) -> None:
    equilibria, design, tets = state
    weights = limiting(equilibria, design)
    found = influence(equilibria, design, tets[:1], weights)
    assert (found.beyond > 0).any()
    assert (found.beyond < 0).any()
    problem, x = equilibria.problem, design.median.x
    beyond = (stretch_excess(problem, weights, design.rho, x), squeeze(problem, weights, x))
    error = shape_error(problem, design.final.y).rms ** 2
    penalties = 0.5 * weights.error_scale**2 * sum(float((each.values**2).sum()) for each in beyond)
    assert penalties > 0
    squared = float((found.shape**2).sum() + (np.maximum(found.beyond, 0) ** 2).sum())
    assert squared == pytest.approx(error + penalties)


def test_predicted_limits_are_near_those_of_the_equilibria(state: tuple[Equilibria, Design, np.ndarray]) -> None:
    equilibria, design, tets = state
    some = tets[::7]
    found = influence(equilibria, design, some, limiting(equilibria, design))
    alike = []
    for k, tet in enumerate(some):
        after = flipped_design(equilibria, design, int(tet))
        true, change = found.view.limits.at(after.median) - found.beyond, found.limit_change[k]
        alike.append((true @ change) / (np.linalg.norm(true) * np.linalg.norm(change)))
    assert np.median(alike) > 0.9


def test_held_positions_settle_where_shape_and_limits_together_are_least(
    state: tuple[Equilibria, Design, np.ndarray],
) -> None:
    """No other moves do better, and limits cost more where they are not free to follow."""
    equilibria, design, tets = state
    found = influence(equilibria, design, tets, limiting(equilibria, design))
    view, squared = found.view, float(found.shape @ found.shape)
    at = found.settled(squared, view.shape_by_held @ found.shape, found.beyond)

    def objective(moves: np.ndarray) -> float:
        shape, beyond = found.shape + moves @ view.shape_by_held, found.beyond + moves @ view.limits_by_held
        cost = moves @ (view.gram - view.shape_by_held @ view.shape_by_held.T) @ moves
        return float(shape @ shape + (np.maximum(beyond, 0) ** 2).sum() + cost)

    assert at.squared == pytest.approx(objective(at.moves), rel=1e-9)
    random = np.random.default_rng(0)
    for size in (1e-5, 1e-4, 1e-3):
        assert objective(at.moves + size * random.normal(size=len(at.moves))) >= at.squared * (1 - 1e-9)
    assert found.left(np.zeros(len(tets), bool)) == pytest.approx(np.sqrt(at.squared))


def energy_of(energy: FlipEnergy, flipped: np.ndarray) -> float:
    error = energy.error + energy.changes[flipped].sum(axis=0)
    beyond = energy.beyond + energy.limit_changes[flipped].sum(axis=0)
    return float(error @ error + (np.maximum(beyond, 0) ** 2).sum() + energy.doubts[flipped].sum())


def test_the_energy_of_flips_is_that_of_their_error_where_held_positions_follow(
    state: tuple[Equilibria, Design, np.ndarray],
) -> None:
    """Whatever is flipped already. Where other limits hold the positions back it can only be larger."""
    equilibria, design, tets = state
    found = influence(equilibria, design, tets, limiting(equilibria, design))
    random, none = np.random.default_rng(0), np.zeros(len(tets), bool)
    free = replace(found, beyond=found.beyond - 1e3)
    assert found.after(none).active.any()
    assert not free.after(none).active.any()
    for share in (0.0, 0.1, 0.5):
        flipped = random.random(len(tets)) < share
        doubt = found.doubts[flipped].sum()
        for each in (found, free):
            energy, taken_back = each.energy(flipped, 1e-3), each.left(none) ** 2 - doubt
            # The damping of the held positions counts in the settled error only.
            assert energy_of(energy, none) + doubt == pytest.approx(each.left(flipped) ** 2, rel=0.05)
            assert energy.price == pytest.approx(1e-3 * energy_of(energy, none))
            assert energy_of(energy, flipped) >= 0.95 * taken_back
        assert energy_of(energy, flipped) == pytest.approx(taken_back, rel=0.05)


def test_the_energy_of_a_flip_is_that_along_the_limits_that_hold_the_positions_back(
    state: tuple[Equilibria, Design, np.ndarray],
) -> None:
    """Each flip by itself, so small that it changes none of them."""
    equilibria, design, tets = state
    found = influence(equilibria, design, tets, limiting(equilibria, design))
    shape_change, limit_change = 1e-4 * found.shape_change, 1e-4 * found.limit_change
    small = replace(found, shape_change=shape_change, limit_change=limit_change, unseen=0 * found.unseen)
    energy, none = small.energy(np.zeros(len(tets), bool), 0.0), np.zeros(len(tets), bool)
    rises, true = [], []
    for k in range(len(tets)):
        flipped = np.arange(len(tets)) == k
        rises.append(energy_of(energy, flipped) - energy_of(energy, none))
        true.append(small.after(flipped).squared - small.after(none).squared)
    np.testing.assert_allclose(rises, true, atol=0.05 * np.abs(true).max())


def test_flips_that_should_cancel_leave_more_than_they_promise(state: tuple[Equilibria, Design, np.ndarray]) -> None:
    """The expected squared error is the mean of those of flips that each come out by a random share otherwise."""
    equilibria, design, tets = state
    found = influence(equilibria, design, tets, WEIGHTS)
    random, flipped = np.random.default_rng(0), np.zeros(len(tets), bool)
    flipped[::3] = True
    share = 1 + found.doubt * random.normal(size=(4000, int(flipped.sum())))
    errors = found.residual + share @ found.change[flipped]
    certain = replace(found, doubt=0.0)
    followed = certain.after(flipped).squared - float(((found.residual + found.change[flipped].sum(axis=0)) ** 2).sum())
    assert followed < 0.05 * certain.after(flipped).squared
    assert found.after(flipped).squared - followed == pytest.approx((errors**2).sum(axis=1).mean(), rel=0.02)
    assert found.left(flipped) > certain.left(flipped)


def test_only_those_that_promise_most_are_looked_at(state: tuple[Equilibria, Design, np.ndarray]) -> None:
    equilibria, design, tets = state
    whole = influence(equilibria, design, tets, WEIGHTS)
    few = influence(equilibria, design, tets, WEIGHTS, most=5)
    assert len(few.tets) == 5
    rows = np.searchsorted(whole.tets, few.tets)
    fields, expected = few.change @ few.view.basis.T, whole.change[rows] @ whole.view.basis.T
    np.testing.assert_allclose(fields, expected, atol=1e-6 * np.abs(expected).max())
    gains = -(whole.change @ whole.residual)
    assert gains[rows].min() > np.median(gains)
