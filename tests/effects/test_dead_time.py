"""Delays of one of several inputs, told from other dynamics."""

import dataclasses

import numpy as np
import pytest

from pyro_dynogp.data import signals
from pyro_dynogp.effects.dead_time import dead_time
from pyro_dynogp.effects.dynamics import unmodelled_dynamics
from tests.discrepancy.made import SETTINGS, coloured, lag, null_record, residuals_of
from tests.effects.scenes import first_extra, step_inputs

N = 400
STEP = 0.1
TIME = STEP * np.arange(N)


@pytest.mark.parametrize("delay", [0.04, 0.23, 1.4])
def test_dead_time_of_one_of_two_channels(delay):
    _, u, parts, e = step_inputs(5)
    y = parts[:, 0] + lag(signals.delayed(u[:, 1], TIME, delay), 0.8) + 0.5 * e
    found = dead_time(residuals_of(y, parts.sum(1), u), SETTINGS)
    assert found.p_value < 1e-3
    assert found.where["channel"] == "v"
    assert found.where["delay"] == pytest.approx(delay, abs=0.03)
    assert "s later than the model says" in found.sentence


def test_a_model_that_is_too_late():
    _, u, parts, e = step_inputs(6, inputs=1)
    mean = lag(signals.delayed(u[:, 0], TIME, 0.35), 0.5)
    found = dead_time(residuals_of(parts[:, 0] + e, mean, u), SETTINGS)
    assert found.where["delay"] == pytest.approx(-0.35, abs=0.03)
    assert "earlier" in found.sentence


def test_dead_time_explains_better_than_other_dynamics_and_they_better_than_it():
    """Both fire for either; the right one gains more by fewer columns."""
    _, u, parts, e = step_inputs(7, inputs=1)
    late = residuals_of(lag(signals.delayed(u[:, 0], TIME, 0.3), 0.5) + e, parts[:, 0], u)
    assert dead_time(late, SETTINGS).p_value < unmodelled_dynamics(late, SETTINGS).p_value
    slow = residuals_of(parts[:, 0] + lag(u[:, 0], 2.0, gain=1.5) + e, parts[:, 0], u)
    assert unmodelled_dynamics(slow, SETTINGS).p_value < dead_time(slow, SETTINGS).p_value


def test_irregular_steps_and_gaps():
    rng = np.random.default_rng(10)
    time = np.cumsum(rng.uniform(0.05, 0.15, N))
    u = np.repeat(rng.standard_normal((N // 5, 1)), 5, axis=0)
    # A fine grid gives both responses.
    fine = np.arange(0.0, time[-1], 0.002)
    v = u[np.maximum(np.searchsorted(time, fine, side="right") - 1, 0), 0]
    response = lag(v, 0.5, 0.002)
    at = np.searchsorted(fine, time).clip(0, len(fine) - 1)
    mean, y = response[at], response[np.maximum(at - 150, 0)] + 0.1 * coloured(rng, N, 0.5)
    y[100:120] = np.nan
    w = coloured(rng, N, 0.9)
    r = residuals_of(np.nan_to_num(y), mean, u, {"w": w}, time=time)
    r = dataclasses.replace(r, output=y)
    found = dead_time(r, SETTINGS)
    assert found.p_value < 1e-6
    assert found.where["delay"] == pytest.approx(0.3, abs=0.04)
    assert unmodelled_dynamics(r, SETTINGS).p_value < 1e-3
    assert first_extra(r, SETTINGS).p_value > 0.01


def test_too_short_a_record():
    r = dataclasses.replace(null_record(0), held_out=np.arange(400) >= 380)
    with pytest.raises(ValueError, match="at least 30 samples"):
        dead_time(r, SETTINGS)
