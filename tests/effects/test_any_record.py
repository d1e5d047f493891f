"""Units, the order of channels, gaps and irregular steps do not matter to tests."""

import dataclasses

import numpy as np
import pytest

from pyro_dynogp.data import signals
from pyro_dynogp.effects.clock_shift import clock_shift
from pyro_dynogp.effects.dead_time import dead_time
from pyro_dynogp.effects.dead_zone import dead_zone
from pyro_dynogp.effects.drift import drift
from pyro_dynogp.effects.dynamics import unmodelled_dynamics
from pyro_dynogp.effects.feedback import feedback
from pyro_dynogp.effects.gain_shift import gain_shift
from pyro_dynogp.effects.heavy_tails import heavy_tails
from pyro_dynogp.effects.heteroscedastic import heteroscedastic_noise
from pyro_dynogp.effects.hysteresis import hysteresis
from pyro_dynogp.effects.input_nonlinearity import input_nonlinearity
from pyro_dynogp.effects.integrator import integrator
from pyro_dynogp.effects.level_shift import level_shift
from pyro_dynogp.effects.nonlinear_feedback import nonlinear_feedback
from pyro_dynogp.effects.output_nonlinearity import output_nonlinearity
from pyro_dynogp.effects.periodic import periodic_disturbance
from pyro_dynogp.effects.process_noise import process_noise
from pyro_dynogp.effects.saturation import saturation
from tests.discrepancy.made import FEW, SETTINGS, coloured, lag, residuals_of
from tests.discrepancy.series import in_other_units, residuals
from tests.effects.scenes import (
    first_extra,
    gain_drift,
    growing_with_input,
    of_the_week,
    stamps,
    step_inputs,
    two_paths,
)

N = 400
STEP = 0.1
TIME = STEP * np.arange(N)

DETECTORS = [
    output_nonlinearity, input_nonlinearity, nonlinear_feedback, saturation, dead_zone, hysteresis,
]  # fmt: skip


def test_units_and_the_order_of_channels_do_not_matter_of_paths():
    _, u, parts, e = step_inputs(11)
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
    for detector in (first_extra, dead_time, unmodelled_dynamics, integrator):
        a, b = detector(one, SETTINGS), detector(other, SETTINGS)
        assert a.p_value == pytest.approx(b.p_value, rel=1e-3, abs=0.003)
        assert 1.8 * a.size == pytest.approx(b.size, rel=1e-3)
    assert 60 * dead_time(one, SETTINGS).where["delay"] == pytest.approx(
        dead_time(other, SETTINGS).where["delay"]
    )


@pytest.mark.parametrize("detector", DETECTORS)
def test_units_and_the_order_of_channels_do_not_matter_of_shapes(detector):
    u, a, b, e = two_paths(11, noise=0.4)
    one = residuals_of(a + b + 0.03 * (a + b) ** 2 + e, a + b, u)
    other = dataclasses.replace(
        one,
        time=one.time / 3600.0,
        step=one.step / 3600.0,
        poles=one.poles * 3600.0,
        output=1.8 * one.output + 32.0,
        mean=1.8 * one.mean + 32.0,
        deviations=1.8 * one.deviations,
        inputs=1e3 * one.inputs[:, ::-1] - 4.0,
        input_names=("v", "u"),
    )
    a, b = detector(one, SETTINGS), detector(other, SETTINGS)
    assert a.p_value == pytest.approx(b.p_value, rel=1e-3, abs=0.003)
    assert 1.8 * a.size == pytest.approx(b.size, rel=1e-3)
    assert a.where.get("channel") == b.where.get("channel")


@pytest.mark.parametrize("detector", [heavy_tails, heteroscedastic_noise, process_noise, feedback])
def test_units_and_order_do_not_matter_of_noise(detector):
    r = growing_with_input(0)
    one, other = detector(r, SETTINGS), detector(in_other_units(r), SETTINGS)
    one, other = (one, other[::-1]) if isinstance(one, list) else ([one], [other])
    for a, b in zip(one, other, strict=True):
        assert b.p_value == pytest.approx(a.p_value, rel=1e-6)
        assert b.size == pytest.approx(1e-3 * a.size, rel=1e-5)
        for key, value in a.where.items():
            scale = 60.0 if key == "time_constant" else 1.0
            assert b.where[key] == (
                value if isinstance(value, str) else pytest.approx(scale * value, rel=1e-6)
            )


@pytest.mark.parametrize(
    "detector", [drift, level_shift, gain_shift, periodic_disturbance, of_the_week, clock_shift]
)
def test_units_and_order_do_not_matter_of_time(detector):
    r = residuals(0, 400, inputs=2, step=1.0, stamps=stamps(400), deviation=0.02, effect=gain_drift)
    one, other = detector(r, FEW), detector(in_other_units(r), FEW)
    assert other.p_value == pytest.approx(one.p_value, rel=1e-6)
    assert other.size == pytest.approx(1e-3 * one.size, rel=1e-6)
    for key, value in one.where.items():
        if key in ("time", "begin", "shift", "period", "time_scale"):
            assert other.where[key] == pytest.approx(60.0 * value, rel=1e-6)
        elif key == "size":
            assert other.where[key] == pytest.approx(1e-3 * value, rel=1e-6)
        elif key == "ratio":
            assert other.where[key] == pytest.approx(value, rel=1e-6)
        elif key == "time_unit":
            assert (value, other.where[key]) == ("s", "min")
        else:
            assert other.where[key] == value


@pytest.mark.parametrize("detector", DETECTORS)
def test_gaps_and_irregular_steps(detector):
    u, a, b, e = two_paths(12)
    time = np.cumsum(np.random.default_rng(0).uniform(0.08, 0.12, 500))
    r = residuals_of(a + b + e, a + b, u, time=time)
    y = r.output.copy()
    y[200:230] = np.nan
    found = detector(dataclasses.replace(r, output=y), SETTINGS)
    assert 0.0 < found.p_value <= 1.0
    assert np.isfinite(found.statistic)
    assert found.sentence.endswith(".")


@pytest.mark.parametrize("detector", [drift, level_shift, gain_shift, of_the_week, clock_shift])
def test_irregular_steps_and_gaps(detector):
    generator = np.random.default_rng(0)
    r = residuals(0, 400, step=1.0, stamps=stamps(400))
    output = np.where(generator.random(400) < 0.1, np.nan, r.output)
    time = r.time + 0.3 * generator.random(400)
    found = detector(dataclasses.replace(r, output=output, time=time), FEW)
    assert 0.0 < found.p_value <= 1.0
    assert np.isfinite(found.gain)


@pytest.mark.parametrize("detector", [drift, level_shift, periodic_disturbance, of_the_week])
def test_records_without_inputs_and_without_noise(detector):
    r = residuals(0, 400, step=1.0, stamps=stamps(400))
    free = dataclasses.replace(r, inputs=r.inputs[:, :0], input_names=(), mean=np.zeros(400))
    assert detector(free, FEW).p_value > 0.0
    assert detector(dataclasses.replace(r, output=r.mean.copy()), FEW).p_value > 0.05


def test_too_few_samples_are_refused():
    r = residuals(0)
    few = dataclasses.replace(r, held_out=np.arange(300) < 20)
    for detector in (heavy_tails, heteroscedastic_noise, process_noise, feedback):
        with pytest.raises(ValueError, match="30"):
            detector(few, SETTINGS)
