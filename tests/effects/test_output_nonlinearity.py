"""A function of the output, told from other effects."""

import numpy as np

from pyro_dynogp.effects.dead_time import dead_time
from pyro_dynogp.effects.dynamics import unmodelled_dynamics
from pyro_dynogp.effects.hysteresis import hysteresis
from pyro_dynogp.effects.input_nonlinearity import input_nonlinearity
from pyro_dynogp.effects.output_nonlinearity import output_nonlinearity
from tests.discrepancy.made import SETTINGS, residuals_of
from tests.effects.scenes import two_paths


def test_output_nonlinearity():
    u, a, b, e = two_paths(1)
    mean = a + b
    r = residuals_of(mean + 0.2 * mean**2 + e, mean, u)
    found = output_nonlinearity(r, SETTINGS)
    assert found.p_value < 1e-6
    assert found.where == {}
    for other in (input_nonlinearity, dead_time, unmodelled_dynamics, hysteresis):
        assert other(r, SETTINGS).gain < found.gain
    # The picture is the function.
    np.testing.assert_allclose(found.curve.fitted, found.curve.y, atol=0.1)
