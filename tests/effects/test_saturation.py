"""Limits of a sensor: exact ties, or an output that flattens."""

import numpy as np
import pytest

from pyro_dynogp.effects import saturation as module
from pyro_dynogp.effects.output_nonlinearity import output_nonlinearity
from pyro_dynogp.effects.saturation import saturation, ties_at_the_top
from tests.discrepancy.made import SETTINGS, coloured, lag, residuals_of
from tests.effects.scenes import two_paths


@pytest.mark.parametrize(("low", "high"), [(-np.inf, 0.9), (-0.8, np.inf), (-0.8, 0.9)])
def test_exact_ties_name_the_limits(low, high):
    u, a, b, e = two_paths(3)
    found = saturation(residuals_of(np.clip(a + b + e, low, high), a + b, u), SETTINGS)
    assert found.p_value < 1e-12
    assert found.where == {"low": low, "high": high}
    assert "samples at exactly that value" in found.sentence


def test_a_limit_below_the_noise_of_the_sensor():
    """No ties: the output is flat where the mean goes on; the fitted gain is too small."""
    u, a, b, e = two_paths(4)
    y = np.clip(1.2 * (a + b), -np.inf, 0.7) + e
    found = saturation(residuals_of(y, a + b, u), SETTINGS)
    assert found.p_value < 1e-6
    assert found.where["low"] == -np.inf
    assert found.where["high"] == pytest.approx(0.7, abs=0.07)


def test_a_convex_output_does_not_saturate():
    u, a, b, e = two_paths(5)
    mean = a + b
    r = residuals_of(mean + np.maximum(mean - 0.5, 0.0) + np.minimum(mean + 0.5, 0.0) + e, mean, u)
    assert output_nonlinearity(r, SETTINGS).p_value < 1e-4
    assert saturation(r, SETTINGS).p_value > 0.5


def test_ties_of_a_record_of_few_digits_are_no_limit():
    """A slow output that rests at plateaus, rounded to one twentieth."""
    rejected = 0
    for seed in range(40):
        rng = np.random.default_rng(seed)
        mean = lag(np.repeat(rng.choice([-1.0, 0.0, 1.0], 20), 20), 0.5)
        y = 0.05 * np.round((mean + 0.05 * coloured(rng, 400, 0.7)) / 0.05)
        rejected += ties_at_the_top(y, mean, SETTINGS).p_value < 0.05
        clipped = np.minimum(y, 0.6)
        if (y > 0.6).sum() > 40:
            assert ties_at_the_top(clipped, mean, SETTINGS).p_value < 0.01
    assert rejected <= 6


@pytest.mark.parametrize(("low", "high", "there"), [(-0.5, 0.5, True), (0.9, 0.8, False)])
def test_limits_that_cross_are_none(monkeypatch, low, high, there):
    monkeypatch.setattr(module, "_flat_limits", lambda *_: (low, high, 0.1))
    u, a, b, e = two_paths(6)
    mean = a + b
    found = saturation(residuals_of(np.clip(mean, -0.5, 0.5) + e, mean, u), SETTINGS)
    assert found.where == {"low": low, "high": high}
    assert (found.p_value < 0.01) is there
