"""Missing channels, delays and dynamics: found, located, and not seen where there are none."""

import dataclasses

import numpy as np
import pytest
from scipy.signal import cont2discrete, lfilter

from pyro_dynogp.data import signals
from pyro_dynogp.effects.delay_regression import likely_delays
from pyro_dynogp.effects.path_effects import dead_time, extra_input, unmodelled_dynamics

from .made import coloured, lag, null_record, residuals_of, within_chance

N, STEP = 400, 0.1
TIME = np.arange(N) * STEP


def scene(seed, inputs=2):
    """Inputs that step, what they give, noise, and a generator."""
    rng = np.random.default_rng(seed)
    u = np.repeat(rng.standard_normal((N // 5, inputs)), 5, axis=0)
    parts = np.column_stack([lag(u[:, j], 0.5 + 0.3 * j) for j in range(inputs)])
    return rng, u, parts, 0.15 * coloured(rng, N, 0.7)


def first_extra(residuals, seed=0):
    return extra_input(residuals, seed=seed)[0]


@pytest.mark.parametrize("detector", [first_extra, dead_time, unmodelled_dynamics])
def test_rejections_under_the_null_are_as_rare_as_promised(detector):
    p = np.array([detector(null_record(seed, 240)).p_value for seed in range(100)])
    assert within_chance((p <= 0.05).sum(), 100, 0.05)
    assert within_chance((p <= 0.3).sum(), 100, 0.3)


# An extra input


@pytest.mark.parametrize(
    ("form", "function"),
    [
        ("linear", lambda w, u: 0.6 * w),
        ("square", lambda w, u: 0.3 * w**2),
        ("absolute", lambda w, u: 0.7 * np.abs(w)),
        ("product with v", lambda w, u: 0.4 * w * u[:, 1]),
    ],
)
def test_a_missing_channel_is_found_with_its_form(form, function):
    rng, u, parts, e = scene(1)
    w, other = coloured(rng, (2, N), 0.0), coloured(rng, N, 0.9)
    w = lag(w[0], 0.5) * 3.0
    y = parts.sum(1) + e + lag(function(w, u), 0.3)
    r = residuals_of(y, parts.sum(1), u, {"ambient": 20.0 + 3.0 * w, "other": other})
    found, none = extra_input(r)
    assert found.p_value < 1e-4
    assert found.where == {"channel": "ambient", "form": form, "delay": 0.0}
    assert none.p_value > 0.01
    assert found.sentence.startswith("Channel 'ambient' acts on 'speed'")
    assert found.sentence.endswith("rpm (rms).")


def test_the_delay_of_a_missing_channel():
    rng, u, parts, e = scene(2)
    w = coloured(rng, N, 0.7)
    y = parts.sum(1) + e + 0.8 * lag(signals.delayed(w, TIME, 1.25), 0.3)
    found = first_extra(residuals_of(y, parts.sum(1), u, {"w": w}))
    assert found.p_value < 1e-4
    assert found.where["delay"] == pytest.approx(1.25, abs=0.1)


def test_what_used_inputs_explain_is_not_ascribed_to_a_candidate():
    """The candidate goes with an input whose dynamics are wrong."""
    rng, u, parts, e = scene(3)
    y = parts.sum(1) + e + lag(u[:, 0], 2.0, gain=1.5)
    w = u[:, 0] + 0.3 * coloured(rng, N, 0.5)
    r = residuals_of(y, parts.sum(1), u, {"w": w})
    assert unmodelled_dynamics(r).p_value < 1e-3
    assert first_extra(r).p_value > 0.05


def test_a_candidate_with_gaps_and_no_candidates():
    rng, u, parts, e = scene(4)
    w = coloured(rng, N, 0.8)
    y = parts.sum(1) + e + lag(w, 0.3)
    w[rng.random(N) < 0.05] = np.nan
    assert first_extra(residuals_of(y, parts.sum(1), u, {"w": w})).p_value < 1e-4
    assert extra_input(residuals_of(y, parts.sum(1), u)) == []


# Dead time


@pytest.mark.parametrize("delay", [0.04, 0.23, 1.4])
def test_dead_time_of_one_of_two_channels(delay):
    _, u, parts, e = scene(5)
    y = parts[:, 0] + lag(signals.delayed(u[:, 1], TIME, delay), 0.8) + 0.5 * e
    found = dead_time(residuals_of(y, parts.sum(1), u))
    assert found.p_value < 1e-3
    assert found.where["channel"] == "v"
    assert found.where["delay"] == pytest.approx(delay, abs=0.03)
    assert "s later than the model says" in found.sentence


def test_a_model_that_is_too_late():
    _, u, parts, e = scene(6, inputs=1)
    mean = lag(signals.delayed(u[:, 0], TIME, 0.35), 0.5)
    found = dead_time(residuals_of(parts[:, 0] + e, mean, u))
    assert found.where["delay"] == pytest.approx(-0.35, abs=0.03)
    assert "earlier" in found.sentence


def test_dead_time_explains_better_than_other_dynamics_and_they_better_than_it():
    """Both fire for either; the right one gains more by fewer columns."""
    _, u, parts, e = scene(7, inputs=1)
    late = residuals_of(lag(signals.delayed(u[:, 0], TIME, 0.3), 0.5) + e, parts[:, 0], u)
    assert dead_time(late).p_value < unmodelled_dynamics(late).p_value
    slow = residuals_of(parts[:, 0] + lag(u[:, 0], 2.0, gain=1.5) + e, parts[:, 0], u)
    assert unmodelled_dynamics(slow).p_value < dead_time(slow).p_value


# Dynamics


def test_a_missing_slow_part():
    _, u, parts, e = scene(8, inputs=1)
    y = parts[:, 0] + lag(u[:, 0], 2.0, gain=2.0) + e
    found = unmodelled_dynamics(residuals_of(y, parts[:, 0], u))
    assert found.p_value < 1e-4
    assert 1.0 < found.where["time_constant"] < 4.0


def test_a_missing_resonance_is_located():
    _, u, parts, e = scene(9)
    system = cont2discrete(([0.3 * 36.0], [1.0, 2 * 0.05 * 6.0, 36.0]), STEP)
    y = parts.sum(1) + lfilter(system[0].ravel(), system[1], u[:, 1]) + e
    found = unmodelled_dynamics(residuals_of(y, parts.sum(1), u))
    assert found.p_value < 1e-4
    assert found.where["frequency"] == pytest.approx(6.0, rel=0.05)
    assert found.where["time_constant"] == pytest.approx(1 / 0.3, rel=0.5)
    assert "channel 'v'" in found.sentence


# Records as they come


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
    found = dead_time(r)
    assert found.p_value < 1e-6
    assert found.where["delay"] == pytest.approx(0.3, abs=0.04)
    assert unmodelled_dynamics(r).p_value < 1e-3
    assert first_extra(r).p_value > 0.01


def test_units_and_the_order_of_channels_do_not_matter():
    _, u, parts, e = scene(11)
    y = parts[:, 0] + lag(signals.delayed(u[:, 1], TIME, 0.03), 0.8) + e
    w = coloured(np.random.default_rng(0), N, 0.9)
    one = residuals_of(y, parts.sum(1), u, {"w": w})
    other = dataclasses.replace(
        one,
        time=60.0 * one.time + 7.0,
        step=60.0 * one.step,
        output=1.8 * one.output + 32.0,
        mean=1.8 * one.mean + 32.0,
        deviations=1.8 * one.deviations,
        inputs=1e3 * one.inputs[:, ::-1] - 4.0,
        input_names=("v", "u"),
        candidates={"w": 0.01 * w + 1.0},
    )
    for detector in (first_extra, dead_time, unmodelled_dynamics):
        a, b = detector(one), detector(other)
        assert a.p_value == pytest.approx(b.p_value, rel=1e-3, abs=0.003)
        assert 1.8 * a.size == pytest.approx(b.size, rel=1e-3)
    assert 60 * dead_time(one).where["delay"] == pytest.approx(dead_time(other).where["delay"])


def test_too_short_a_record():
    r = dataclasses.replace(null_record(0), held_out=np.arange(400) >= 380)
    with pytest.raises(ValueError, match="at least 30 samples"):
        dead_time(r)


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
