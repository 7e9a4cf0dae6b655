"""Paths of equilibria from one density to another: where their steps go, and that held positions follow."""

from dataclasses import replace

import numpy as np
import pytest
from bars import bar, held_design, mixed_density, two_patches

from fab4d.design import paths
from fab4d.design.equilibria import Equilibria
from fab4d.design.flips import at_interface, predicted
from fab4d.design.forward import balance
from fab4d.design.gauss_newton import Ahead, Design, held_positions
from fab4d.design.influence import influence
from fab4d.design.objective import ObjectiveWeights, shape_error
from fab4d.design.paths import change_density, follow_density
from fab4d.design.reduced import Search, refit
from fab4d.design.sensitivity import linearise
from fab4d.errors import EquilibriumError
from fab4d.mesh.rigid import best_rigid_motion
from fab4d.mesh.tetmesh import BoolArray
from fab4d.solvers import threads

WEIGHTS = ObjectiveWeights(error_scale=1e-3)
Start = tuple[Equilibria, Design]


@pytest.fixture(scope="module")
def start() -> Start:
    """The upper half of a bar is SMP; what becomes of it at the points held is what is wanted."""
    made = bar(cells=(6, 3, 2), degrees=40.0)
    patches, X = two_patches(made).patches, made.body.X
    smp = X[made.body.elements].mean(axis=1)[:, 2] > 0.5 * X[:, 2].max()
    wanted = held_design(Equilibria(made, patches), smp.astype(float), made.X_temp).final.y
    R, t = best_rigid_motion(wanted[made.clamp], X[made.clamp])
    problem = replace(made, X_temp=wanted @ R.T + t)
    equilibria = Equilibria(problem, patches)
    return equilibria, refit(equilibria, held_design(equilibria, smp.astype(float), made.X_temp), WEIGHTS, unseen)


@pytest.fixture(autouse=True)
def one_core(monkeypatch: pytest.MonkeyPatch) -> None:
    """On several cores some steps are tried for nothing; these tests count those that are needed."""
    monkeypatch.setattr(threads, "usable_cores", lambda: 1)


def unseen(at: Search) -> None:
    """Nobody watches the fit."""


def rms(equilibria: Equilibria, design: Design) -> float:
    return shape_error(equilibria.problem, design.final.y).rms


def other_labels(equilibria: Equilibria, design: Design) -> BoolArray:
    """Every second tet of one side of the interface flipped."""
    labels = design.rho > 0.5
    labels[np.flatnonzero(at_interface(equilibria.problem, labels) & labels)[::2]] = False
    return labels


def ahead_of(equilibria: Equilibria, design: Design, labels: BoolArray) -> Ahead:
    found = influence(equilibria, design, np.arange(len(labels)), WEIGHTS)
    return predicted(found, design.rho > 0.5, labels)


def in_shares(design: Design, n: int) -> Design:
    """The design with a density that tells the share of the way from 0 to 1."""
    return Design(np.zeros(n), design.median, design.final)


def test_held_positions_stay_where_the_density_alone_changes(start: Start) -> None:
    equilibria, design = start
    rho = mixed_density(equilibria.problem)
    changed = change_density(equilibria, design, rho)
    gap = held_positions(equilibria, changed.median) - held_positions(equilibria, design.median)
    assert np.abs(gap).max() < 1e-5
    np.testing.assert_array_equal(changed.rho, rho)


def test_a_step_to_other_densities_that_failed_is_not_tried_again_soon(
    start: Start, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Shares of the way that are aimed at where steps of more than a sixteenth lead nowhere at first."""
    equilibria, design = start
    tried, at, n = list[float](), [0.0], equilibria.problem.n_tets

    def equilibrate(_: Equilibria, rho: np.ndarray, *__: object, **___: object) -> Design | None:
        aim = float(rho[0])
        tried.append(aim)
        if aim - at[0] > 1 / 16 + 1e-12 and at[0] < 0.25:
            return None
        at[0] = aim
        return Design(rho, design.median, design.final)

    monkeypatch.setattr(paths, "equilibrate", equilibrate)
    found = change_density(equilibria, in_shares(design, n), np.ones(n))
    np.testing.assert_array_equal(found.rho, 1.0)
    sixteenths = [16, 8, 4, 2, 1, 2, 3, 5, 4, 5, 6, 8, 12, 16]
    np.testing.assert_allclose(16 * np.array(tried), sixteenths)


def test_held_positions_move_as_predicted_where_that_leads_all_the_way(start: Start) -> None:
    equilibria, design = start
    labels = other_labels(equilibria, design)
    ahead, rho = ahead_of(equilibria, design, labels), labels.astype(float)
    found = follow_density(equilibria, design, rho, WEIGHTS, ahead)
    np.testing.assert_array_equal(found.rho, rho)
    moves = held_positions(equilibria, found.median) - held_positions(equilibria, design.median)
    np.testing.assert_allclose(moves, ahead.moves, atol=1e-6)


def test_held_positions_follow_so_that_the_error_stays_low(start: Start, monkeypatch: pytest.MonkeyPatch) -> None:
    """From halfway on: in equilibrium, and nearly as near as a fit comes."""
    equilibria, design = start
    labels = other_labels(equilibria, design)
    ahead, rho = ahead_of(equilibria, design, labels), labels.astype(float)
    half = change_density(equilibria, design, 0.5 * (design.rho + rho))
    monkeypatch.setattr(paths, "_at_once", lambda *_: (half, 0.5))
    found = follow_density(equilibria, design, rho, WEIGHTS, ahead)
    np.testing.assert_array_equal(found.rho, rho)
    assert balance(equilibria, rho, found.median, found.final).final < 1e-5
    still = change_density(equilibria, design, rho)
    fitted, moved, unmoved = (
        rms(equilibria, each) for each in (refit(equilibria, found, WEIGHTS, unseen), found, still)
    )
    assert fitted < 0.9 * unmoved
    assert moved - fitted < 0.2 * (unmoved - fitted)


def stays(equilibria: Equilibria, design: Design, moves: np.ndarray) -> Ahead:
    """A change that moves the held positions and nothing else."""
    none = np.zeros_like(design.final.y)
    return Ahead(
        moves, none, np.zeros_like(moves), none, linearise(equilibria, design.rho, design.median, design.final)
    )


@pytest.mark.parametrize(
    ("predicted_to", "by_models_to"), [(1.0, 1.0), (0.5, 1.0), (0.5, 0.75), (0.0, 1.0), (0.0, 0.0)]
)
def test_models_lead_on_from_what_is_predicted_and_unloading_from_there(
    start: Start, monkeypatch: pytest.MonkeyPatch, predicted_to: float, by_models_to: float
) -> None:
    """Each goes on where the one before ends; what is left of the predicted moves goes with unloading."""
    equilibria, design = start
    n, done = equilibria.problem.n_tets, list[tuple[str, float]]()
    moves = np.array([[0.01, -0.02, 0.03], [0.0, 0.01, 0.0]])
    held = held_positions(equilibria, design.median)

    def led(how: str, rho: np.ndarray, farthest: float) -> Design | None:
        aim = float(rho[0])
        if aim > farthest:
            return None
        done.append((how, aim))
        return Design(rho, design.median, design.final)

    def equilibrate(_: Equilibria, rho: np.ndarray, at: np.ndarray, *__: object, **how: object) -> Design | None:
        assert how["stay"]
        if how.get("by_unloading"):
            # The median of these designs does not move: all of what is left is made in the last step.
            if rho[0] == 1.0:
                np.testing.assert_allclose(at, held + (1 - by_models_to) * moves, atol=1e-12)
            return led("unloading", rho, 1.0)
        assert how["near"] is ahead.near
        np.testing.assert_allclose(at, held + float(rho[0]) * moves, atol=1e-12)
        return led("predicted", rho, predicted_to)

    monkeypatch.setattr(paths, "equilibrate", equilibrate)
    monkeypatch.setattr(paths, "build_model", lambda *_: None)
    monkeypatch.setattr(paths, "prescribed_step", lambda *given: led("model", given[3], by_models_to))
    ahead = stays(equilibria, design, moves)
    found = follow_density(equilibria, in_shares(design, n), np.ones(n), WEIGHTS, ahead)
    np.testing.assert_array_equal(found.rho, 1.0)
    expected = [("predicted", predicted_to), ("model", by_models_to), ("unloading", 1.0)]
    reached = [0.0, predicted_to, by_models_to]
    np.testing.assert_equal(done, [each for each, before in zip(expected, reached, strict=True) if each[1] > before])


def test_what_fails_is_tried_with_half_of_it_and_more_damping(start: Start, monkeypatch: pytest.MonkeyPatch) -> None:
    """By the model of the same design; the next design has its own, damped as the first was."""
    equilibria, design = start
    n, tried, models = equilibria.problem.n_tets, list[tuple[float, float]](), list[Design]()

    def step(_: Equilibria, __: None, at: Design, rho: np.ndarray, damping: float) -> Design | None:
        tried.append((float(rho[0]), damping))
        return Design(rho, design.median, design.final) if rho[0] - at.rho[0] <= 0.25 else None

    half = Design(np.full(n, 0.5), design.median, design.final)
    monkeypatch.setattr(paths, "_at_once", lambda *_: (half, 0.5))
    monkeypatch.setattr(paths, "build_model", lambda *given: models.append(given[3]))
    monkeypatch.setattr(paths, "prescribed_step", step)
    ahead = stays(equilibria, design, np.zeros((2, 3)))
    follow_density(equilibria, in_shares(design, n), np.ones(n), WEIGHTS, ahead)
    first = paths.FIRST_DAMPING
    np.testing.assert_allclose(tried, [(1.0, first), (0.75, paths.STIFFER * first), (1.0, first)])
    assert [each.rho[0] for each in models] == [0.5, 0.75]


def test_steps_of_models_come_down_to_a_part_of_the_smallest(start: Start, monkeypatch: pytest.MonkeyPatch) -> None:
    equilibria, design = start
    n, tried = equilibria.problem.n_tets, list[float]()
    half = Design(np.full(n, 0.5), design.median, design.final)
    monkeypatch.setattr(paths, "_at_once", lambda *_: (half, 0.5))
    monkeypatch.setattr(paths, "build_model", lambda *_: None)
    monkeypatch.setattr(paths, "prescribed_step", lambda *given: tried.append(float(given[3][0])))
    monkeypatch.setattr(paths, "equilibrate", lambda *_, **__: None)
    ahead = stays(equilibria, design, np.zeros((2, 3)))
    with pytest.raises(EquilibriumError):
        follow_density(equilibria, in_shares(design, n), np.ones(n), WEIGHTS, ahead)
    np.testing.assert_allclose(np.array(tried) - 0.5, [1 / 2, 1 / 4, 1 / 8, 1 / 16, 1 / 32])
    assert tried[-1] - 0.5 == paths.SMALLEST_STEP / paths.FINER


def test_a_path_that_ends_before_is_refused(start: Start, monkeypatch: pytest.MonkeyPatch) -> None:
    equilibria, design = start
    for step in ("equilibrate", "prescribed_step"):
        monkeypatch.setattr(paths, step, lambda *_, **__: None)
    ahead = stays(equilibria, design, np.zeros((2, 3)))
    with pytest.raises(EquilibriumError, match="no equilibrium"):
        follow_density(equilibria, design, 1 - design.rho, WEIGHTS, ahead)
    with pytest.raises(EquilibriumError, match="no equilibrium"):
        change_density(equilibria, design, 1 - design.rho)


@pytest.mark.parametrize("ahead_fails", [False, True])
def test_steps_that_are_tried_at_once_lead_to_the_same_design(
    start: Start, monkeypatch: pytest.MonkeyPatch, ahead_fails: bool
) -> None:
    """To the last bit, where the whole way is found at once and where models lead on from halfway."""
    equilibria, design = start
    labels = other_labels(equilibria, design)
    ahead, rho = ahead_of(equilibria, design, labels), labels.astype(float)
    if ahead_fails:
        half = change_density(equilibria, design, 0.5 * (design.rho + rho))
        monkeypatch.setattr(paths, "_at_once", lambda *_: (half, 0.5))
    found = list[Design]()
    for cores in (1, 2):
        monkeypatch.setattr(threads, "usable_cores", lambda cores=cores: cores)
        found.append(follow_density(equilibria, design, rho, WEIGHTS, ahead))
    np.testing.assert_array_equal(found[0].final.y, found[1].final.y)
    np.testing.assert_array_equal(found[0].median.x, found[1].median.x)
