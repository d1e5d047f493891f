"""The climb to a mode: round coordinates, where they pay, and that linear fits arrive."""

import numpy as np
import pytest
from scipy.optimize import minimize

import pyro_dynogp as dgp
from pyro_dynogp.inference import maximum
from pyro_dynogp.inference.potential import Potential


def counted(function):
    """Values and gradients of many points, and how many were asked for each time."""
    sizes = []

    def functions(z):
        sizes.append(len(z))
        found = [function(point) for point in z]
        return np.array([v for v, _ in found]), np.array([g for _, g in found])

    return functions, sizes


def valley(seed=0, d=12):
    """A quadratic whose axes are nine orders of magnitude apart."""
    rng = np.random.default_rng(seed)
    axes = np.linalg.qr(rng.standard_normal((d, d)))[0]
    A = axes @ np.diag(np.logspace(0, 9, d)) @ axes.T
    return (lambda z: (0.5 * z @ A @ z, A @ z)), rng.standard_normal(d)


def test_a_valley_is_crossed_in_a_few_steps():
    function, start = valley()
    functions, _ = counted(function)
    z, history, _ = maximum._lbfgs(functions, start, 40, 0.0, price=4)
    plain = minimize(function, start, jac=True, method="L-BFGS-B", options={"maxiter": 40})
    assert function(z)[0] < 1e-3
    assert plain.fun > 1.0
    assert history[-1] == pytest.approx(function(z)[0], abs=1e-9)


def test_a_saddle_is_left():
    def function(z):
        x, y = z
        return 0.25 * x**4 - 0.5 * x**2 + 50.0 * y**2, np.array([x**3 - x, 100.0 * y])

    functions, _ = counted(function)
    z, _, _ = maximum._lbfgs(functions, np.array([1e-3, 1.0]), 60, 0.0, price=2)
    np.testing.assert_allclose(z, [1.0, 0.0], atol=1e-2)


def test_a_hessian_that_costs_more_than_half_of_what_is_left_is_not_made():
    function, start = valley()
    functions, sizes = counted(function)
    maximum._lbfgs(functions, start, 30, 0.0, price=15.5)
    assert set(sizes) == {1}
    functions, sizes = counted(function)
    maximum._lbfgs(functions, start, 70, 0.0, price=35.0)
    assert sizes.count(len(start) + 1) == 1


def test_nothing_is_asked_for_after_it_has_arrived():
    functions, sizes = counted(lambda z: (0.5 * z @ z, z))
    z, history, _ = maximum._lbfgs(functions, np.ones(3), 500, 0.0, price=1)
    np.testing.assert_allclose(z, 0.0, atol=1e-3)
    assert len(history) < 10
    assert len(sizes) < 15


def test_linear_fits_arrive(record):
    """No direction is left in which the density rises by a hundredth of a nat."""
    fit = dgp.fit(dgp.LinearDynamicGP(1, pairs=2), record[:200], workers=1, progress=False)
    potential = Potential(fit.model, (fit.records[0],), fit.mode)
    z = potential.pack(fit.mode).numpy()
    gradient = potential.value_and_gradient(z)[1]
    H = np.array([
        potential.value_and_gradient(z + e)[1] - potential.value_and_gradient(z - e)[1]
        for e in 1e-4 * np.eye(len(z))
    ]) / 2e-4  # fmt: skip
    eigenvalues, vectors = np.linalg.eigh(0.5 * (H + H.T))
    along = vectors.T @ gradient
    assert np.sum(along**2 / np.maximum(eigenvalues, 1.0)) < 0.02
