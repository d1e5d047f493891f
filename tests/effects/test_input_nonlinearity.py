"""A function of one input, told from other effects."""

import numpy as np
import pytest

from pyro_dynogp.effects.dead_time import dead_time
from pyro_dynogp.effects.dynamics import unmodelled_dynamics
from pyro_dynogp.effects.hysteresis import hysteresis
from pyro_dynogp.effects.input_nonlinearity import input_nonlinearity
from pyro_dynogp.effects.output_nonlinearity import output_nonlinearity
from tests.discrepancy.made import SETTINGS, lag, residuals_of
from tests.effects.scenes import two_paths


@pytest.mark.parametrize("function", [lambda u: u + 0.4 * u**2, lambda u: np.tanh(2 * u)])
def test_input_nonlinearity_of_one_channel(function):
    u, a, _, e = two_paths(2)
    y = a + lag(function(u[:, 1]), 0.8) + e
    r = residuals_of(y, a + lag(u[:, 1], 0.8, gain=0.8), u)
    found = input_nonlinearity(r, SETTINGS)
    assert found.p_value < 1e-4
    assert found.where == {"channel": "v"}
    for other in (output_nonlinearity, dead_time, unmodelled_dynamics, hysteresis):
        assert other(r, SETTINGS).gain < found.gain
