"""Eight numbers at a time: numpy does the same with each."""

import numpy as np
from numba import njit

from pyro_dynogp.lti.lanes import (
    WIDTH,
    below,
    choose,
    complex_exponential,
    get,
    larger,
    magnitude,
    nearest,
    power_of_two,
    put,
    root,
    splat,
    total,
)


@njit
def _operations(x, y, out):
    a = get(x, 0)
    b = get(y, 0)
    put(out, 0, a + b)
    put(out, 1, a - b)
    put(out, 2, a * b)
    put(out, 3, a / b)
    put(out, 4, root(magnitude(a)))
    put(out, 5, choose(a, b, splat(7.0)))
    put(out, 6, larger(a, b))
    put(out, 7, power_of_two(nearest(b)))
    put(out, 8, get(x, 1))
    put(out, 9, below(b))
    put(out, 10, splat(total(a)))


def test_operations_are_those_of_numpy_to_the_bit():
    rng = np.random.default_rng(0)
    x, y = rng.standard_normal((2, WIDTH)), 10.0 * rng.standard_normal((1, WIDTH))
    out = np.empty((11, WIDTH))
    _operations(x, y, out)
    a, b = x[0], y[0]
    expected = [a + b, a - b, a * b, a / b, np.sqrt(abs(a)), np.where(a > 0, b, 7.0)]
    expected += [np.maximum(a, b), 2.0 ** np.rint(b), x[1], np.floor(b)]
    pairs = a.reshape(4, 2).sum(1).reshape(2, 2).sum(1)
    expected.append(np.full(WIDTH, pairs.sum()))
    np.testing.assert_array_equal(out, expected)


@njit
def _exponentials(a, b, out):
    for k in range(a.shape[0]):
        re, im = complex_exponential(get(a, k), get(b, k))
        put(out, 2 * k, re)
        put(out, 2 * k + 1, im)


def exponentials(a, b):
    out = np.empty((len(a), 2, WIDTH))
    _exponentials(a, b, out)
    return out[:, 0] + 1j * out[:, 1]


def test_complex_exponential():
    rng = np.random.default_rng(1)
    n = 20_000
    a = -np.exp(rng.uniform(-40.0, 6.5, (n, WIDTH)))
    b = rng.choice([-1.0, 1.0], a.shape) * np.exp(rng.uniform(-40.0, 13.8, a.shape))
    exact = np.exp(a + 1j * b)
    assert (np.abs(exponentials(a, b) - exact) / np.abs(exact)).max() < 2.0 * np.finfo(float).eps


def test_complex_exponential_at_the_ends():
    zero = np.zeros((1, WIDTH))
    np.testing.assert_array_equal(exponentials(zero, zero), np.ones_like(zero))
    for a in (-709.0, -1e5, -np.inf):
        np.testing.assert_array_equal(exponentials(zero + a, zero + 1e3), zero)
    quarters = np.pi / 2 * np.arange(-16.0, 16.0).reshape(-1, WIDTH)
    exact = np.exp(1j * quarters)
    np.testing.assert_allclose(exponentials(0.0 * quarters, quarters), exact, rtol=0, atol=3e-16)
    far = exponentials(zero - 1.0, zero + 1e12)
    assert np.abs(far - np.exp(-1.0 + 1e12j)).max() < 1e-3
