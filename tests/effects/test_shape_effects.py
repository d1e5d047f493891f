"""Static nonlinearities, limits, dead zones, play: found, located, told from each other."""

import dataclasses

import numpy as np
import pytest

from pyro_dynogp.data import signals
from pyro_dynogp.effects.path_effects import dead_time, unmodelled_dynamics
from pyro_dynogp.effects.shape_effects import (
    dead_zone,
    hysteresis,
    input_nonlinearity,
    output_nonlinearity,
    saturation,
)
from pyro_dynogp.effects.ties import ties_at_the_top

from .made import coloured, lag, null_record, residuals_of, within_chance

N, STEP = 500, 0.1
DETECTORS = [output_nonlinearity, input_nonlinearity, saturation, dead_zone, hysteresis]


def scene(seed, noise=0.1):
    """Two inputs that step, what each gives, noise."""
    rng = np.random.default_rng(seed)
    u = np.repeat(rng.standard_normal((N // 10, 2)), 10, axis=0)
    return u, lag(u[:, 0], 0.5), lag(u[:, 1], 0.8), noise * coloured(rng, N, 0.7)


@pytest.mark.parametrize("detector", DETECTORS)
def test_rejections_under_the_null_are_as_rare_as_promised(detector):
    p = np.array([detector(null_record(seed, 240)).p_value for seed in range(100)])
    assert within_chance((p <= 0.05).sum(), 100, 0.05)
    assert within_chance((p <= 0.3).sum(), 100, 0.3)


def test_output_nonlinearity():
    u, a, b, e = scene(1)
    mean = a + b
    r = residuals_of(mean + 0.2 * mean**2 + e, mean, u)
    found = output_nonlinearity(r)
    assert found.p_value < 1e-6
    assert found.where == {}
    for other in (input_nonlinearity, dead_time, unmodelled_dynamics, hysteresis):
        assert other(r).gain < found.gain
    # The picture is the function.
    np.testing.assert_allclose(found.curve.fitted, found.curve.y, atol=0.1)


@pytest.mark.parametrize("function", [lambda u: u + 0.4 * u**2, lambda u: np.tanh(2 * u)])
def test_input_nonlinearity_of_one_channel(function):
    u, a, _, e = scene(2)
    y = a + lag(function(u[:, 1]), 0.8) + e
    r = residuals_of(y, a + lag(u[:, 1], 0.8, gain=0.8), u)
    found = input_nonlinearity(r)
    assert found.p_value < 1e-4
    assert found.where == {"channel": "v"}
    for other in (output_nonlinearity, dead_time, unmodelled_dynamics, hysteresis):
        assert other(r).gain < found.gain


# Saturation


@pytest.mark.parametrize(("low", "high"), [(-np.inf, 0.9), (-0.8, np.inf), (-0.8, 0.9)])
def test_exact_ties_name_the_limits(low, high):
    u, a, b, e = scene(3)
    found = saturation(residuals_of(np.clip(a + b + e, low, high), a + b, u))
    assert found.p_value < 1e-12
    assert found.where == {"low": low, "high": high}
    assert "samples at exactly that value" in found.sentence


def test_a_limit_below_the_noise_of_the_sensor():
    """No ties: the output is flat where the mean goes on; the fitted gain is too small."""
    u, a, b, e = scene(4)
    y = np.clip(1.2 * (a + b), -np.inf, 0.7) + e
    found = saturation(residuals_of(y, a + b, u))
    assert found.p_value < 1e-6
    assert found.where["low"] == -np.inf
    assert found.where["high"] == pytest.approx(0.7, abs=0.07)


def test_a_convex_output_does_not_saturate():
    u, a, b, e = scene(5)
    mean = a + b
    r = residuals_of(mean + np.maximum(mean - 0.5, 0.0) + np.minimum(mean + 0.5, 0.0) + e, mean, u)
    assert output_nonlinearity(r).p_value < 1e-4
    assert saturation(r).p_value > 0.5


def test_ties_of_a_record_of_few_digits_are_no_limit():
    """A slow output that rests at plateaus, rounded to one twentieth."""
    rejected = 0
    for seed in range(40):
        rng = np.random.default_rng(seed)
        mean = lag(np.repeat(rng.choice([-1.0, 0.0, 1.0], 20), 20), 0.5)
        y = 0.05 * np.round((mean + 0.05 * coloured(rng, 400, 0.7)) / 0.05)
        rejected += ties_at_the_top(y, mean).p_value < 0.05
        clipped = np.minimum(y, 0.6)
        if (y > 0.6).sum() > 40:
            assert ties_at_the_top(clipped, mean).p_value < 0.01
    assert rejected <= 6


# Dead zone and play


@pytest.mark.parametrize(("low", "high"), [(-0.5, 0.4), (0.2, 1.0)])
def test_dead_zone_of_one_channel(low, high):
    u, a, b, e = scene(6, noise=0.05)
    y = a + lag(signals.dead_zone(u[:, 1], low, high), 0.8) + e
    found = dead_zone(residuals_of(y, a + 0.7 * b, u))
    assert found.p_value < 1e-3
    assert found.where["channel"] == "v"
    assert found.where["low"] == pytest.approx(low, abs=0.2)
    assert found.where["high"] == pytest.approx(high, abs=0.2)


def test_an_input_of_two_values_has_no_dead_zone_but_others_may():
    u, _, b, e = scene(6, noise=0.05)
    switch = (u[:, 0] > 0.0).astype(float)
    path = lag(switch, 0.5)
    y = path + lag(signals.dead_zone(u[:, 1], -0.5, 0.4), 0.8) + e
    found = dead_zone(residuals_of(y, path + 0.7 * b, np.column_stack([switch, u[:, 1]])))
    assert found.p_value < 1e-3
    assert found.where["channel"] == "v"
    with pytest.raises(ValueError, match="expected an input of more than two values"):
        dead_zone(residuals_of(path + e, path, np.column_stack([switch, switch])))


def test_an_input_that_saturates_has_no_dead_zone():
    u, a, b, e = scene(7, noise=0.05)
    r = residuals_of(a + lag(np.clip(u[:, 1], -0.7, 0.7), 0.8) + e, a + 0.7 * b, u)
    assert input_nonlinearity(r).p_value < 1e-3
    assert dead_zone(r).p_value > 0.05


def test_play_at_an_input():
    u, a, b, e = scene(8, noise=0.05)
    r = residuals_of(a + lag(signals.play(u[:, 1], 0.8), 0.8) + e, a + b, u)
    found = hysteresis(r)
    assert found.p_value < 1e-3
    assert found.where["channel"] == "v"
    assert found.where["width"] == pytest.approx(0.8, rel=0.2)


def test_play_at_the_output():
    u, a, b, e = scene(9, noise=0.05)
    found = hysteresis(residuals_of(signals.play(a + b, 0.5) + e, a + b, u))
    assert found.p_value < 1e-6
    assert found.where["channel"] == "speed"
    assert found.where["width"] == pytest.approx(0.5, rel=0.1)


def test_a_phase_lag_is_not_play():
    u, a, b, e = scene(10)
    late = residuals_of(
        lag(signals.delayed(u[:, 0], STEP * np.arange(N), 0.2), 0.5) + b + e, a + b, u
    )
    assert dead_time(late).p_value < 1e-6
    assert hysteresis(late).p_value > 0.01


# Records as they come


@pytest.mark.parametrize("detector", DETECTORS)
def test_units_and_the_order_of_channels_do_not_matter(detector):
    u, a, b, e = scene(11, noise=0.4)
    one = residuals_of(a + b + 0.03 * (a + b) ** 2 + e, a + b, u)
    other = dataclasses.replace(
        one,
        time=one.time / 3600.0,
        step=one.step / 3600.0,
        output=1.8 * one.output + 32.0,
        mean=1.8 * one.mean + 32.0,
        deviations=1.8 * one.deviations,
        inputs=1e3 * one.inputs[:, ::-1] - 4.0,
        input_names=("v", "u"),
    )
    a, b = detector(one), detector(other)
    assert a.p_value == pytest.approx(b.p_value, rel=1e-3, abs=0.003)
    assert 1.8 * a.size == pytest.approx(b.size, rel=1e-3)
    assert a.where.get("channel") == b.where.get("channel")


@pytest.mark.parametrize("detector", DETECTORS)
def test_gaps_and_irregular_steps(detector):
    u, a, b, e = scene(12)
    time = np.cumsum(np.random.default_rng(0).uniform(0.08, 0.12, N))
    r = residuals_of(a + b + e, a + b, u, time=time)
    y = r.output.copy()
    y[200:230] = np.nan
    found = detector(dataclasses.replace(r, output=y))
    assert 0.0 < found.p_value <= 1.0
    assert np.isfinite(found.statistic)
    assert found.sentence.endswith(".")
