"""Dynamics that a model lacks: slow parts and resonances."""

import pytest
from scipy.signal import cont2discrete, lfilter

from pyro_dynogp.effects.dynamics import unmodelled_dynamics
from tests.discrepancy.made import SETTINGS, lag, residuals_of
from tests.effects.scenes import step_inputs

STEP = 0.1


def test_a_missing_slow_part():
    _, u, parts, e = step_inputs(8, inputs=1)
    y = parts[:, 0] + lag(u[:, 0], 2.0, gain=2.0) + e
    found = unmodelled_dynamics(residuals_of(y, parts[:, 0], u), SETTINGS)
    assert found.p_value < 1e-4
    assert 1.0 < found.where["time_constant"] < 4.0


def test_a_missing_resonance_is_located():
    _, u, parts, e = step_inputs(9)
    system = cont2discrete(([0.3 * 36.0], [1.0, 2 * 0.05 * 6.0, 36.0]), STEP)
    y = parts.sum(1) + lfilter(system[0].ravel(), system[1], u[:, 1]) + e
    found = unmodelled_dynamics(residuals_of(y, parts.sum(1), u), SETTINGS)
    assert found.p_value < 1e-4
    assert found.where["frequency"] == pytest.approx(6.0, rel=0.05)
    assert found.where["time_constant"] == pytest.approx(1 / 0.3, rel=0.5)
    assert "channel 'v'" in found.sentence
