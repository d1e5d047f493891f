"""Play at an input and at the output."""

import numpy as np
import pytest

import pyro_dynogp as dgp
from pyro_dynogp import effects
from pyro_dynogp.data import signals
from pyro_dynogp.data.channels import Play
from pyro_dynogp.effects.dead_time import dead_time
from pyro_dynogp.effects.hysteresis import hysteresis
from pyro_dynogp.models.variants import with_channel
from pyro_dynogp.statistics.evidence import Evidence
from tests.discrepancy.made import SETTINGS, lag, residuals_of
from tests.effects.scenes import two_paths

N = 500
STEP = 0.1


def test_play_at_an_input():
    u, a, b, e = two_paths(8, noise=0.05)
    r = residuals_of(a + lag(signals.play(u[:, 1], 0.8), 0.8) + e, a + b, u)
    found = hysteresis(r, SETTINGS)
    assert found.p_value < 1e-3
    assert found.where["channel"] == "v"
    assert found.where["width"] == pytest.approx(0.8, rel=0.2)
    refitted = with_channel(dgp.LinearDynamicGP(inputs=2, pairs=1), Play("v", 9.0))
    assert "with play, 9 wide, about" in effects.Hysteresis().sentence(found, refitted)


def test_play_at_the_output():
    u, a, b, e = two_paths(9, noise=0.05)
    found = hysteresis(residuals_of(signals.play(a + b, 0.5) + e, a + b, u), SETTINGS)
    assert found.p_value < 1e-6
    assert found.where["channel"] == "speed"
    assert found.where["width"] == pytest.approx(0.5, rel=0.1)


def test_a_phase_lag_is_not_play():
    u, a, b, e = two_paths(10)
    late = residuals_of(
        lag(signals.delayed(u[:, 0], STEP * np.arange(N), 0.2), 0.5) + b + e, a + b, u
    )
    assert dead_time(late, SETTINGS).p_value < 1e-6
    assert hysteresis(late, SETTINGS).p_value > 0.01


def test_play_is_told_as_refits_have_it():
    model = with_channel(dgp.LinearDynamicGP(inputs=1, pairs=1), Play("u", 0.6))
    said = "'y' follows channel 'u' with play, 0.5 wide, about 1 V (rms)."
    where = {"channel": "u", "width": 0.5}
    found = Evidence("hysteresis", 1.0, 0.01, 1.0, 1.0, where, said, None)
    told = effects.Hysteresis().sentence(found, model)
    assert told == "'y' follows channel 'u' with play, 0.6 wide, about 1 V (rms)."
