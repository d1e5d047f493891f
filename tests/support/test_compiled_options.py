"""The option by which leaf functions leave out the counting of references; see `BORROWING`."""

import time

import numpy as np
from numba import njit

from pyro_dynogp.support.compiled import BORROWING, OPTIONS, accepted


def leaf(S, x, out):
    for i in range(x.shape[0]):
        total = 0.0
        for j in range(x.shape[0]):
            total += S[i, j] * x[j]
        out[i] = total


def best(function, *args):
    times = []
    for _ in range(5):
        start = time.perf_counter()
        function(*args)
        times.append(time.perf_counter() - start)
    return min(times)


def test_numba_has_the_option_and_the_results_are_the_same():
    """Where this fails after an update of numba, raise its bound in pyproject.toml with care."""
    assert accepted(_nrt=False)
    assert BORROWING == {**OPTIONS, "_nrt": False}
    rng = np.random.default_rng(0)
    S, x = rng.standard_normal((12, 12)), rng.standard_normal(12)
    results = {}
    for name, options in (("counting", OPTIONS), ("borrowing", BORROWING)):
        inner = njit(**(options | {"cache": False}))(leaf)

        @njit(nogil=True, error_model="numpy")
        def many(S, x, out, inner=inner):
            for _ in range(20_000):
                inner(S, x, out)

        out = np.empty(12)
        many(S, x, out)
        results[name] = out
        print(f"{name}: {best(many, S, x, out) / 20_000 * 1e9:.0f} ns a call")
    np.testing.assert_array_equal(results["counting"], results["borrowing"])


def test_an_unknown_option_is_refused_without_compiling():
    start = time.perf_counter()
    assert not accepted(no_such_option=True)
    print(f"asked in {1e3 * (time.perf_counter() - start):.2f} ms")
