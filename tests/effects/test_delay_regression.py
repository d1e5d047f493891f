"""Delays by regressions."""

import numpy as np
import pytest
from scipy.signal import lfilter

from pyro_dynogp.effects.delay_regression import likely_delays


@pytest.mark.parametrize("delay", [0, 7, 38])
def test_regressions_find_the_delay_that_poles_hide(delay):
    rng = np.random.default_rng(delay)
    u = lfilter([1.0], [1.0, -0.8], rng.standard_normal((800, 2)), axis=0)
    late = np.concatenate([np.zeros(delay), u[: len(u) - delay, 1]])
    y = lfilter([0.0, 0.5], [1.0, -1.5, 0.8], late) + lfilter([0.0, 1.0], [1.0, -0.7], u[:, 0])
    y = y + 0.05 * y.std() * rng.standard_normal(800)
    y[100:110] = np.nan
    assert abs(likely_delays(y, u, [1], 80)[0] - delay) <= 1
    assert likely_delays(y[:60], u[:60], [1], 50) == []
