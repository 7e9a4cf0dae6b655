"""The forward simulation from the permanent shape, the way the rig does it."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from bars import bar, held_design, two_patches

from fab4d.design.equilibria import Equilibria, Final, Median
from fab4d.design.forward import balance, program
from fab4d.design.gauss_newton import Design, equilibrate, held_positions
from fab4d.design.paths import change_density
from fab4d.design.problem import Problem
from fab4d.mesh.rigid import best_rigid_motion
from fab4d.solvers.newton import Status


def layered(problem: Problem) -> np.ndarray:
    """SMP in the upper half."""
    z = problem.body.X[problem.body.elements[:, :4]][:, :, 2].mean(axis=1)
    return (z > 0.5 * problem.body.X[:, 2].max()).astype(np.float64)


def designed(degrees: float, element: str = "linear") -> tuple[Equilibria, Design]:
    problem = bar(degrees=degrees, element=element)
    equilibria = two_patches(problem)
    return equilibria, held_design(equilibria, layered(problem), problem.X_temp)


@pytest.mark.parametrize(("degrees", "element"), [(30, "linear"), (30, "quadratic"), (170, "linear"), (250, "linear")])
def test_loading_from_the_permanent_shape_reaches_the_design(degrees: float, element: str) -> None:
    equilibria, design = designed(degrees, element)
    done = program(equilibria, design.rho, design.median.x, design.median.forces)
    assert (done.loaded, done.unloaded) == (1.0, 1.0)
    assert done.load_steps >= 5
    np.testing.assert_allclose(done.median.x, design.median.x, atol=1e-9)
    scale = np.abs(design.median.forces).max()
    np.testing.assert_allclose(done.median.forces, design.median.forces, atol=1e-7 * scale)
    R, t = best_rigid_motion(done.final.y, design.final.y)
    np.testing.assert_allclose(done.final.y @ R.T + t, design.final.y, atol=1e-8)


def test_the_clamp_stays_where_it_is_in_the_permanent_shape() -> None:
    equilibria, design = designed(30)
    problem = equilibria.problem
    done = program(equilibria, design.rho, design.median.x, design.median.forces)
    np.testing.assert_array_equal(done.median.x[problem.clamp], problem.body.X[problem.clamp])


def test_balance_finds_the_forces_of_the_state_and_nothing_else() -> None:
    equilibria, design = designed(30)
    done = program(equilibria, design.rho, design.median.x, design.median.forces)
    found = balance(equilibria, design.rho, done.median, done.final)
    assert found.median < 1e-10
    assert found.final < 1e-10
    assert 0.3 < found.min_det_F <= 1.0


def test_balance_sees_a_force_that_is_not_told() -> None:
    equilibria, design = designed(30)
    half = design.median.forces.copy()
    half[0] *= 0.5
    told = replace(design.median, forces=half)
    assert balance(equilibria, design.rho, told, design.final).median > 0.01


def test_balance_sees_a_vertex_that_is_out_of_place() -> None:
    equilibria, design = designed(30)
    y = design.final.y.copy()
    y[0, 0] += 1e-6
    found = balance(equilibria, design.rho, design.median, replace(design.final, y=y))
    assert found.final > 1e-6


def test_a_shape_that_is_no_equilibrium_is_not_reached() -> None:
    """Another bend with the same means at the patches: the simulation ends where the physics says."""
    equilibria, design = designed(30)
    problem = equilibria.problem
    wrong = design.median.x + 0.01 * np.sin(20 * problem.body.X[:, [2, 0, 1]])
    wrong[problem.clamp] = problem.body.X[problem.clamp]
    done = program(equilibria, design.rho, wrong, design.median.forces)
    assert np.abs(done.median.x - wrong).max() > 1e-3
    assert balance(equilibria, design.rho, done.median, done.final).median < 1e-10


@pytest.mark.parametrize("degrees", [90.0, 280.0])
def test_pure_tpe_unloads_to_its_permanent_shape(degrees: float) -> None:
    """The straight part lies far from the wanted shape, in which its six fixed dofs were chosen."""
    problem = bar(degrees=degrees)
    equilibria, rho, x = two_patches(problem), np.zeros(problem.n_tets), problem.X_temp
    median = equilibria.solve_median(rho, equilibria.patches.mean(x), x, np.zeros((2, 3)), 1e-9, 60)
    done = program(equilibria, rho, median.x, median.forces)
    assert (done.loaded, done.unloaded) == (1.0, 1.0)
    R, t = best_rigid_motion(done.final.y, problem.body.X)
    np.testing.assert_allclose(done.final.y @ R.T + t, problem.body.X, atol=1e-9)


class Ending(Equilibria):
    """Equilibria whose median shapes end where the first force is larger than `largest`."""

    largest = np.inf

    def solve_median(self, *args: Any, **options: Any) -> Median:
        median = super().solve_median(*args, **options)
        if np.linalg.norm(median.forces[0]) <= self.largest:
            return median
        return replace(median, solution=replace(median.solution, status=Status.NO_STEP))


class Near(Equilibria):
    """Equilibria whose final shapes are found from a guess near them alone."""

    def solve_final(self, rho: np.ndarray, median: Median, y: np.ndarray, *args: Any, **options: Any) -> Final:
        final = super().solve_final(rho, median, y, *args, **options)
        R, t = best_rigid_motion(y, final.y)
        if np.abs(y @ R.T + t - final.y).max() < 0.02:
            return final
        return replace(final, solution=replace(final.solution, status=Status.UNSTABLE))


@pytest.mark.parametrize("element", ["linear", "quadratic"])
def test_a_final_shape_far_from_its_guess_is_found_by_unloading(element: str) -> None:
    """The other half becomes SMP; the bar, bent before, lies straight in the guess."""
    equilibria, design = designed(60, element)
    rho, near = 1 - design.rho, Near(equilibria.problem, equilibria.patches)
    x, f, held = design.median.x, design.median.forces, held_positions(equilibria, design.median)
    guess = equilibria.problem.body.X
    assert equilibrate(near, rho, held, x, f, guess) is None
    found = equilibrate(near, rho, held, x, f, guess, by_unloading=True)
    assert found is not None
    np.testing.assert_array_equal(found.rho, rho)
    assert balance(equilibria, rho, found.median, found.final).final < 1e-6
    followed = change_density(near, replace(design, final=replace(design.final, y=guess)), rho, 1.0)
    R, t = best_rigid_motion(followed.final.y, found.final.y)
    np.testing.assert_allclose(followed.final.y @ R.T + t, found.final.y, atol=1e-5)


def test_a_final_shape_that_unloading_does_not_come_to_is_none() -> None:
    equilibria, design = designed(60)
    held, none = held_positions(equilibria, design.median), Never(equilibria.problem, equilibria.patches)
    x, f, y = design.median.x, design.median.forces, design.final.y
    assert equilibrate(none, design.rho, held, x, f, y, by_unloading=True) is None


class Never(Equilibria):
    """Equilibria whose final shapes are found only while most of the TPE is taken as stress-free."""

    def solve_final(self, *args: Any, **options: Any) -> Final:
        final = super().solve_final(*args, **options)
        unloaded = args[5] if len(args) > 5 else options.get("unloaded", 1.0)
        return final if unloaded < 0.5 else replace(final, solution=replace(final.solution, status=Status.UNSTABLE))


def test_loading_that_cannot_go_on_tells_how_far_it_came() -> None:
    equilibria, design = designed(30)
    ending = Ending(equilibria.problem, equilibria.patches)
    ending.largest = 0.5 * float(np.linalg.norm(design.median.forces[0]))
    done = program(ending, design.rho, design.median.x, design.median.forces)
    assert 0.2 < done.loaded < 0.8
    assert np.linalg.norm(done.median.forces[0]) == pytest.approx(ending.largest, rel=0.02)
    # What was reached is unloaded all the same: it is the state that is told.
    assert done.unloaded == 1.0
    assert balance(ending, design.rho, done.median, done.final).final < 1e-10
