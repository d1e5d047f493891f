"""Filters of residuals, against scipy's."""

import numpy as np
import pytest
from scipy.signal import lfilter

from pyro_dynogp.statistics.autoregression import Whitener


@pytest.mark.parametrize("order", [0, 1, 7, 24])
@pytest.mark.parametrize("shape", [(40,), (700, 1), (300, 5), (60, 2, 3), (24, 90)])
def test_columns_are_filtered_as_scipy_filters_them(order, shape):
    generator = np.random.default_rng(order)
    a, x = generator.standard_normal(order), generator.standard_normal(shape)
    expected = lfilter(np.concatenate([[1.0], -a]), [1.0], x, axis=0)[order:]
    np.testing.assert_allclose(Whitener(a)(x), expected, rtol=0, atol=1e-12)
    np.testing.assert_allclose(Whitener(a)(x.T.copy().T), expected, rtol=0, atol=1e-12)


def test_a_missing_sample_is_missing_wherever_it_counts():
    x = np.arange(50.0)
    x[[9, 30]] = np.nan
    w = Whitener(np.array([0.5, 0.0, -0.2]))(x)
    assert set(np.flatnonzero(np.isnan(w)) + 3) == {9, 10, 11, 12, 30, 31, 32, 33}
    assert w[4] == 7.0 - 0.5 * 6.0 + 0.2 * 4.0
    assert x[0] == 0.0
