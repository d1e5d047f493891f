"""L-BFGS with Hessians: where it ends, how soon, and that it says why."""

from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import rosen, rosen_der, rosen_hess

from pyro_dynogp.inference.optimise.descent import (
    FLAT,
    LEAST,
    WIDEST,
    bounded_root,
    descend,
    hessian,
    newton,
)
from pyro_dynogp.inference.optimise.maximum import _preconditioned


def functions_of(value, gradient):
    """At several points, as a potential has them; counts the points."""

    def functions(z):
        functions.points += len(z)
        return np.array([value(x) for x in z]), np.array([gradient(x) for x in z])

    functions.points = 0
    return functions


def quadratic(seed, d, spread):
    """A convex quadratic, eigenvalues from 1 over `spread` decades, 3 at its random minimum."""
    generator = np.random.default_rng(seed)
    Q, _ = np.linalg.qr(generator.standard_normal((d, d)))
    H = (Q * np.logspace(0.0, spread, d)) @ Q.T
    centre = generator.standard_normal(d)
    return H, centre, functions_of(
        lambda x: 3.0 + 0.5 * (x - centre) @ H @ (x - centre), lambda x: H @ (x - centre)
    )  # fmt: skip


@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), d=st.integers(2, 12), spread=st.floats(0.0, 8.0))
def test_ends_where_less_is_left_than_it_says_however_long_the_ridge(seed, d, spread):
    H, centre, functions = quadratic(seed, d, spread)
    z, history, message = descend(functions, centre + 1.0, 200, every=LEAST, first=0)
    assert message == "nothing left to gain"
    assert 0.5 * (z - centre) @ H @ (z - centre) < d * FLAT**2
    assert len(history) < 60
    assert np.all(np.diff(history) <= 1e-12)


def test_a_curved_ridge_is_followed_to_its_end():
    functions = functions_of(rosen, rosen_der)
    start = np.full(10, -1.0)
    start[::2] = 1.2
    z, history, message = descend(functions, start, 400, every=LEAST)
    assert message == "nothing left to gain"
    # What FLAT leaves, 0.0005 of height, is 0.04 along the valley of curvature 0.5.
    np.testing.assert_allclose(z, 1.0, atol=0.05)
    assert history[-1] < 10 * FLAT**2


@pytest.mark.parametrize("steps", [1, 4, LEAST, 2 * LEAST - 1, 2 * LEAST + 1, 50])
def test_takes_no_more_steps_than_it_is_given_and_all_that_help(steps):
    functions = functions_of(lambda x: 1e3 * rosen(x), lambda x: 1e3 * rosen_der(x))
    _, history, message = descend(functions, np.full(8, -1.0), steps, every=LEAST)
    assert len(history) == steps
    assert message == "all steps used"


def test_first_says_when_the_first_hessian_is_due():
    _, centre, functions = quadratic(0, 6, 2.0)
    descend(functions, centre + 1.0, 1, every=LEAST, first=0)
    assert functions.points >= 7  # the point and six shifted ones, before any step
    _, centre, functions = quadratic(0, 6, 2.0)
    descend(functions, centre + 1.0, 1, every=LEAST)
    assert functions.points < 7


def test_where_there_is_no_hessian_it_ends_at_its_best_point():
    def functions(z):
        far = np.abs(z).max(1) > 0.9999
        return np.where(far, np.inf, 0.5 * (z**2).sum(1)), np.where(far[:, None], np.nan, z)

    z, _, message = descend(functions, np.array([0.99985, 0.5]), 10, every=LEAST, first=0)
    assert message == "no Hessian"
    np.testing.assert_array_equal(z, [0.99985, 0.5])


@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), d=st.integers(2, 6))
def test_hessian_by_differences(seed, d):
    z = np.random.default_rng(seed).uniform(-1.5, 1.5, d)
    functions = functions_of(rosen, rosen_der)
    # Third and fourth derivatives of up to 1e4 over a step of 1e-4, and rounding over it.
    np.testing.assert_allclose(hessian(functions, z), rosen_hess(z), rtol=1e-5, atol=1e-3)
    some = [d - 1, 0]
    part = rosen_hess(z)[np.ix_(some, some)]
    np.testing.assert_allclose(hessian(functions, z, some), part, rtol=1e-5, atol=1e-3)


def test_bounded_root_of_a_definite_hessian_is_that_of_its_inverse():
    H, _, _ = quadratic(3, 5, 4.0)
    root = bounded_root(H)
    np.testing.assert_allclose(root @ root.T, np.linalg.inv(H), rtol=1e-9)
    np.testing.assert_array_equal(root, np.tril(root))


def test_bounded_root_where_a_density_is_flat_or_curves_upwards():
    """Upward curvature says how far the density is what it is here, as downward curvature does."""
    axes = np.linalg.qr(np.random.default_rng(0).standard_normal((4, 4)))[0]
    curvature = np.array([25.0, -25.0, 0.01, -0.01])
    root = bounded_root((axes * curvature) @ axes.T)
    sds = np.sqrt(np.diag(axes.T @ root @ root.T @ axes))
    np.testing.assert_allclose(sds, [0.2, 0.2, WIDEST, WIDEST], rtol=1e-9)


def test_newton_finds_the_minima_of_a_double_well_to_rounding():
    """f = (x^2 - 1)^2 + (y - x)^2 has minima at (1, 1) and (-1, -1) alone."""
    calls = []

    def functions(z):
        calls.append(len(z))
        x, y = z.T
        value = (x**2 - 1.0) ** 2 + (y - x) ** 2
        by_x = 4.0 * x * (x**2 - 1.0) - 2.0 * (y - x)
        return value, np.stack([by_x, 2.0 * (y - x)], 1)

    starts = np.array([[0.3, -0.5], [-2.0, 3.0], [1.0, 1.0]])
    found, values = newton(functions, starts)
    np.testing.assert_allclose(np.abs(found), 1.0, rtol=1e-8)
    np.testing.assert_allclose(found[:, 0], found[:, 1], rtol=1e-8)
    assert found[2, 0] == 1.0
    assert values.max() < 1e-8
    assert calls[0] == 9  # three points each of three starts
    assert len(calls) < 30


def test_newton_steps_back_from_where_there_is_no_value():
    def functions(z):
        with np.errstate(all="ignore"):
            return (z - np.log(z)).sum(1), 1.0 - 1.0 / z

    found, _ = newton(functions, np.array([[3.5], [0.01]]))
    np.testing.assert_allclose(found, 1.0, rtol=1e-7)
    _, values = newton(functions, np.array([[-1.0]]))
    assert values[0] == np.inf


@pytest.mark.parametrize(("steps", "there"), [(4, False), (5, True)])
def test_a_hessian_that_costs_more_than_all_iterations_is_not_taken(steps, there):
    """Forty points, of which eight cost no less than one by itself."""
    sizes, scales = [], np.geomspace(1.0, 1e4, 40)

    def functions(z):
        sizes.append(len(z))
        return 0.5 * (z**2 @ scales), z * scales

    task = SimpleNamespace(steps=steps, goes_on=True)
    _, history, _ = _preconditioned(functions, np.ones(40), task, 2)
    assert (max(sizes) > 40) is there
    assert history[-1] < history[0]
