"""The potential that draws a body to a surface: its derivatives, and its bounds."""

import numpy as np
import pytest
from scipy.sparse import csc_array

from fab4d.elasticity.elements import discretise
from fab4d.elasticity.pattern import build_pattern
from fab4d.elasticity.projection import Bounds, DrawnBody

KAPPA = 6.07


def drawn(bodies, rng: np.random.Generator, bounds: Bounds, strength: float) -> DrawnBody:
    X, tets = bodies.irregular_box((2, 2, 2), rng)
    return DrawnBody(discretise(X, tets), KAPPA, rng.random(len(X)), X + 0.1, bounds, strength)


def deformed(body: DrawnBody, rng: np.random.Generator) -> np.ndarray:
    X = body.body.X
    return X @ (np.eye(3) + 0.25 * rng.standard_normal((3, 3))) + 0.02 * rng.standard_normal(X.shape)


def full(body: DrawnBody, x: np.ndarray, spd: bool) -> np.ndarray:
    pattern = build_pattern(body.body.elements, len(x))
    lower = csc_array((body.hessian(x, pattern, spd), pattern.indices, pattern.indptr)).toarray()
    return lower + np.tril(lower, -1).T


# Below: where nothing is beyond the bounds, where stretches are, where volumes are.
BOUNDS = [Bounds(0.01, 9.0), Bounds(0.01, 1.05), Bounds(1.2, 9.0), Bounds(1.2, 1.02)]


@pytest.mark.parametrize("bounds", BOUNDS, ids=str)
def test_the_gradient_is_that_of_the_value(bodies, bounds: Bounds) -> None:
    rng = np.random.default_rng(0)
    body = drawn(bodies, rng, bounds, 7.0)
    x, direction = deformed(body, rng), rng.standard_normal(body.wanted.shape)
    slope = np.vdot(body.value_and_gradient(x)[1], direction)

    def value(step: float) -> float:
        return body.value_and_gradient(x + step * direction)[0]

    errors = [abs((value(h) - value(-h)) / (2 * h) - slope) / abs(slope) for h in (1e-4, 1e-5, 1e-6, 1e-7)]
    assert min(errors) < 1e-7


@pytest.mark.parametrize("bounds", BOUNDS[:2], ids=str)
def test_the_hessian_is_exact_within_the_bounds_and_for_stretches_beyond(bodies, bounds: Bounds) -> None:
    """Stretched more along each direction than the bound: then no part of its Hessian is negative and left out."""
    rng = np.random.default_rng(1)
    body = drawn(bodies, rng, bounds, 7.0)
    x = body.body.X @ (np.diag([1.2, 1.3, 1.45]) + 0.02 * rng.standard_normal((3, 3)))
    h, direction = 1e-6, rng.standard_normal(x.shape)
    change = (body.value_and_gradient(x + h * direction)[1] - body.value_and_gradient(x - h * direction)[1]) / (2 * h)
    product = full(body, x, spd=False) @ direction.ravel()
    np.testing.assert_allclose(product, change.ravel(), rtol=0, atol=2e-7 * np.abs(product).max())


@pytest.mark.parametrize("bounds", BOUNDS, ids=str)
def test_the_safe_hessian_has_no_negative_eigenvalue(bodies, bounds: Bounds) -> None:
    rng = np.random.default_rng(2)
    body = drawn(bodies, rng, bounds, 1e4)
    assert np.linalg.eigvalsh(full(body, deformed(body, rng), spd=True)).min() > 0


def test_within_the_bounds_they_cost_nothing(bodies) -> None:
    rng = np.random.default_rng(3)
    free, bound = (drawn(bodies, np.random.default_rng(3), BOUNDS[0], strength) for strength in (0.0, 1e6))
    x = deformed(free, rng)
    assert free.value_and_gradient(x)[0] == bound.value_and_gradient(x)[0]
    tight = drawn(bodies, np.random.default_rng(3), BOUNDS[1], 1e6)
    assert tight.value_and_gradient(x)[0] > 10 * free.value_and_gradient(x)[0]


def test_an_inverted_tet_is_outside(bodies) -> None:
    body = drawn(bodies, np.random.default_rng(4), BOUNDS[0], 1.0)
    x = body.body.X * [1, 1, -1]
    assert body.value_and_gradient(x)[0] == np.inf
