"""Optimisers side by side."""

import threading

import numpy as np
import pytest
from scipy.optimize import minimize, rosen, rosen_der

from pyro_dynogp.inference.optimise.lockstep import in_lockstep


def run(start):
    def climb(functions):
        def function(z):
            values, gradients = functions(z[None])
            return values[0], gradients[0]

        found = minimize(function, start, jac=True, method="L-BFGS-B")
        return found.x, found.nfev

    return climb


STARTS = [np.array([-1.2, 1.0]), np.array([0.5, 0.5]), np.array([1.0, 1.0])]


@pytest.mark.parametrize("count", [1, 3])
def test_each_ends_where_it_does_alone(count):
    sizes = []
    threads = threading.active_count()

    def functions(z):
        sizes.append(len(z))
        return np.array([rosen(x) for x in z]), np.array([rosen_der(x) for x in z])

    found = in_lockstep(functions, [run(start) for start in STARTS[:count]])
    for (x, calls), start in zip(found, STARTS[:count], strict=True):
        alone = minimize(lambda z: (rosen(z), rosen_der(z)), start, jac=True, method="L-BFGS-B")
        np.testing.assert_array_equal(x, alone.x)
        assert calls == alone.nfev
    assert len(sizes) == max(calls for _, calls in found)
    assert sum(sizes) == sum(calls for _, calls in found)
    assert threading.active_count() == threads


def test_points_are_in_the_order_of_the_runs():
    def functions(z):
        return z[:, 0], z

    def one(value):
        return lambda functions: [functions(np.full((1, 1), value + k))[0][0] for k in range(20)]

    found = in_lockstep(functions, [one(100.0 * i) for i in range(6)])
    for i, values in enumerate(found):
        assert values == [100.0 * i + k for k in range(20)]


def test_runs_may_ask_for_many_points():
    """Each gets back the values of its own."""
    sizes = []

    def functions(z):
        sizes.append(len(z))
        return z.sum(1), 2.0 * z

    def many(count):
        def climb(functions):
            points = np.arange(2.0 * count).reshape(count, 2)
            values, gradients = functions(points)
            np.testing.assert_array_equal(gradients, 2.0 * points)
            return values

        return climb

    for count, values in zip((3, 1, 5), in_lockstep(functions, [many(3), many(1), many(5)]),
                             strict=True):  # fmt: skip
        np.testing.assert_array_equal(values, 4.0 * np.arange(count) + 1.0)
    assert sizes == [9]


@pytest.mark.parametrize("where", ["function", "run"])
def test_an_error_ends_all_and_is_raised(where):
    def functions(z):
        if where == "function":
            raise RuntimeError("broken")
        return z[:, 0], z

    def ends(functions):
        functions(np.zeros((1, 1)))
        raise RuntimeError("broken")

    def waits(functions):
        for _ in range(1000):
            functions(np.ones((2, 1)))

    threads = threading.active_count()
    with pytest.raises(RuntimeError, match="broken"):
        in_lockstep(functions, [waits, ends, waits])
    assert threading.active_count() == threads
