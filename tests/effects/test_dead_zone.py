"""A dead zone of one input."""

import numpy as np
import pytest

from pyro_dynogp.data import signals
from pyro_dynogp.effects.dead_zone import dead_zone
from pyro_dynogp.effects.input_nonlinearity import input_nonlinearity
from tests.discrepancy.made import SETTINGS, lag, residuals_of
from tests.effects.scenes import two_paths


@pytest.mark.parametrize(("low", "high"), [(-0.5, 0.4), (0.2, 1.0)])
def test_dead_zone_of_one_channel(low, high):
    u, a, b, e = two_paths(6, noise=0.05)
    y = a + lag(signals.dead_zone(u[:, 1], low, high), 0.8) + e
    found = dead_zone(residuals_of(y, a + 0.7 * b, u), SETTINGS)
    assert found.p_value < 1e-3
    assert found.where["channel"] == "v"
    assert found.where["low"] == pytest.approx(low, abs=0.2)
    assert found.where["high"] == pytest.approx(high, abs=0.2)


def test_an_input_of_two_values_has_no_dead_zone_but_others_may():
    u, _, b, e = two_paths(6, noise=0.05)
    switch = (u[:, 0] > 0.0).astype(float)
    path = lag(switch, 0.5)
    y = path + lag(signals.dead_zone(u[:, 1], -0.5, 0.4), 0.8) + e
    found = dead_zone(residuals_of(y, path + 0.7 * b, np.column_stack([switch, u[:, 1]])), SETTINGS)
    assert found.p_value < 1e-3
    assert found.where["channel"] == "v"
    with pytest.raises(ValueError, match="expected an input of more than two values"):
        dead_zone(residuals_of(path + e, path, np.column_stack([switch, switch])), SETTINGS)


def test_an_input_that_saturates_has_no_dead_zone():
    u, a, b, e = two_paths(7, noise=0.05)
    r = residuals_of(a + lag(np.clip(u[:, 1], -0.7, 0.7), 0.8) + e, a + 0.7 * b, u)
    assert input_nonlinearity(r, SETTINGS).p_value < 1e-3
    assert dead_zone(r, SETTINGS).p_value > 0.05
