"""Autocorrelations with gaps are those of statsmodels."""

import numpy as np
from statsmodels.tsa.stattools import acf

from pyro_dynogp.statistics.serial import autocorrelation


def test_autocorrelation_with_gaps():
    rng = np.random.default_rng(0)
    x = np.cumsum(rng.normal(size=(3, 400)), axis=1)
    x[:, rng.uniform(size=400) < 0.15] = np.nan
    found, pairs = autocorrelation(x, 30)
    for own, series in zip(found, x, strict=True):
        expected = acf(series, nlags=30, missing="conservative", adjusted=True, fft=True)
        np.testing.assert_allclose(own, expected[1:], atol=1e-12)
    there = np.isfinite(x[0])
    counted = [int((there[k:] & there[:-k]).sum()) for k in range(1, 31)]
    assert pairs.tolist() == counted
