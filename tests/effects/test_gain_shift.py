"""Steps of a gain."""

import dataclasses

import numpy as np
import pytest

import pyro_dynogp as dgp
from pyro_dynogp.data.channels import Delayed, Ramp, RampOfGain, Step, StepOfGain
from pyro_dynogp.effects import Drift, GainShift, LevelShift
from pyro_dynogp.effects.drift import drift
from pyro_dynogp.effects.gain_shift import gain_shift
from pyro_dynogp.effects.level_shift import level_shift
from pyro_dynogp.statistics.evidence import Evidence
from tests.discrepancy.made import SETTINGS, lag
from tests.discrepancy.series import residuals, share
from tests.effects.scenes import step_at_150


def weaker(t, mean, u):
    """From 300 samples on, a quarter of what the input contributed before."""
    return np.where(np.arange(len(t)) >= 300, -0.75, 0.0) * mean


class TestTest:
    def test_it_is_found_with_its_instant_and_size(self):
        """In noise as large as what the gain changes by: within a few samples and a tenth."""
        found = [
            gain_shift(residuals(s, 500, pole=0.5, effect=weaker), SETTINGS, seed=s)
            for s in range(5)
        ]
        assert max(e.p_value for e in found) < 1e-3
        assert np.median([abs(e.where["time"] - 150.0) for e in found]) <= 3.0
        assert np.median([e.where["ratio"] for e in found]) == pytest.approx(0.25, abs=0.1)
        assert all(e.where["channel"] == "speed" for e in found)
        assert "steps down to 0." in found[0].sentence

    def test_the_instant_is_that_of_the_input_rather_than_of_the_response(self):
        """The response is slow: it begins to differ by time constants later."""
        rng = np.random.default_rng(3)
        u = np.repeat(rng.standard_normal(50), 10)
        mean = lag(u, 2.0)
        less = lag(np.where(np.arange(500) < 250, u - u.mean(), 0.4 * (u - u.mean())), 2.0)
        r = residuals(0, 500, effect=lambda t, m, v: less - m, pole=0.3)
        r = dataclasses.replace(
            r, mean=mean, output=less + 0.02 * rng.standard_normal(500), inputs=u[:, None],
            time=0.1 * np.arange(500), step=0.1, deviations=1e-3 * r.deviations,
        )  # fmt: skip
        found = gain_shift(r, SETTINGS)
        # One sample, of 0.1 s, and what noise of 0.02 makes of a ratio.
        assert found.where["time"] == pytest.approx(25.0, abs=0.11)
        assert found.where["ratio"] == pytest.approx(0.4, abs=0.03)

    def test_the_unit_of_the_input_does_not_matter(self):
        r = residuals(2, 500, pole=0.5, effect=weaker)
        one = gain_shift(r, SETTINGS)
        other = gain_shift(dataclasses.replace(r, inputs=1e-9 * r.inputs + 3e-9), SETTINGS)
        assert other.where["time"] == one.where["time"]
        assert other.where["ratio"] == pytest.approx(one.where["ratio"], rel=1e-4)

    def test_the_input_is_named(self):
        def effect(t, mean, u):
            return np.where(np.arange(len(t)) >= 300, -0.6, 0.0) * share(u[:, 1], 2.0)

        found = gain_shift(residuals(0, 500, pole=0.5, inputs=2, effect=effect), SETTINGS)
        assert found.p_value < 1e-4
        assert found.where["channel"] == "u2"

    def test_other_changes_are_rather_something_else(self):
        for s in range(3):
            r = residuals(s, 500, pole=0.5, effect=weaker)
            own = gain_shift(r, SETTINGS, seed=s).gain
            assert own > max(one(r, SETTINGS, seed=s).gain for one in (drift, level_shift)) + 3.0
            step = residuals(s, 500, effect=step_at_150)
            assert level_shift(step, SETTINGS).gain > gain_shift(step, SETTINGS).gain + 3.0

    def test_gaps_do_not_matter(self):
        r = residuals(1, 500, pole=0.5, effect=weaker)
        output = r.output.copy()
        output[100:180] = np.nan
        output[::17] = np.nan
        found = gain_shift(dataclasses.replace(r, output=output), SETTINGS)
        assert found.p_value < 0.01
        assert found.where["time"] == pytest.approx(150.0, abs=5.0)
        assert np.isfinite(found.curve.y).all()

    def test_nothing_moves(self):
        r = residuals(0, 200)
        with pytest.raises(ValueError, match="a mean that moves"):
            gain_shift(dataclasses.replace(r, mean=np.zeros(200)), SETTINGS)


@pytest.mark.parametrize(("channel", "inputs"), [("u2", ["u2"]), ("y", ["u1", "u2"])])
def test_the_inputs_act_otherwise_from_the_instant_on(channel, inputs):
    rng = np.random.default_rng(0)
    u = rng.standard_normal((90, 2)) + np.array([3.0, 0.0])
    record = dgp.Record(np.arange(90) + 10.0, u, rng.standard_normal(90))
    found = Evidence("gain shift", 9.0, 1e-9, 9.0, 0.1, {"time": 40.0, "channel": channel})
    alone, with_level, *slow = GainShift().extend(dgp.LinearDynamicGP(2, pairs=1), found, record)
    assert alone.channels == tuple(StepOfGain(name, 0.0, 40.0) for name in inputs)
    *gains, level = with_level.channels
    assert [(one.channel, one.at) for one in gains] == [(name, 40.0) for name in inputs]
    centre = dict(zip(("u1", "u2"), u.mean(0), strict=True))
    assert [one.centre for one in gains] == pytest.approx([centre[name] for name in inputs])
    assert level == Step(40.0)
    # Within the record, which is of the times 10 to 99.
    ends = [(35.55, 44.45), (28.875, 51.125), (17.75, 62.25)]
    for (begin, end), variant in zip(ends, slow, strict=True):
        *ramps, level = variant.channels
        assert [type(one) for one in variant.channels] == [RampOfGain] * len(inputs) + [Ramp]
        assert [one.channel for one in ramps] == inputs
        assert [one.centre for one in ramps] == pytest.approx([centre[name] for name in inputs])
        assert {(one.begin, one.end) for one in variant.channels} == {(level.begin, level.end)}
        assert (level.begin, level.end) == pytest.approx((begin, end))
    early = dataclasses.replace(found, where={"time": 14.0, "channel": channel})
    *_, slowest = GainShift().extend(dgp.LinearDynamicGP(2, pairs=1), early, record)
    assert (slowest.channels[-1].begin, slowest.channels[-1].end) == (10.0, 36.25)


def test_it_is_told_how_long_a_change_takes():
    r = residuals(1, 500, pole=0.5, effect=weaker)
    found = gain_shift(r, SETTINGS)
    record = dgp.Record(r.time, r.inputs, r.output, input_names=r.input_names)
    step, _, ramp, *_ = GainShift().extend(dgp.LinearDynamicGP(1, pairs=1), found, record)
    assert GainShift().sentence(found, step) == found.sentence
    told = GainShift().sentence(found, ramp)
    assert told.startswith("The gain of 'speed' changes down to 0.")
    assert told.endswith("It takes 24.9 s about then.")


def test_an_input_that_is_late_and_one_whose_gain_has_stepped_can_step_again():
    rng = np.random.default_rng(0)
    record = dgp.Record(np.arange(90) + 10.0, rng.standard_normal(90), rng.standard_normal(90))
    model = dgp.LinearDynamicGP(1, pairs=1, channels=(Delayed("u", 2.0),))
    found = Evidence("gain shift", 9.0, 1e-9, 9.0, 0.1, {"time": 40.0, "channel": "y"})
    once, *_ = GainShift().extend(model, found, record)
    assert once.channels[1:] == (StepOfGain("u delayed", 0.0, 40.0),)
    again = dataclasses.replace(found, where={"time": 60.0, "channel": "y"})
    twice, *_ = GainShift().extend(once, again, record)
    assert twice.channels[2:] == (StepOfGain("u delayed", 0.0, 60.0),)


@pytest.mark.parametrize(("at", "offset"), [(250, 2.0), (565, 0.0)])
def test_a_loop_names_it_and_forecasts_are_right_again(at, offset):
    """Also where hardly any known data, 600 of 800 samples, come after it."""
    rng = np.random.default_rng(1)
    u = np.repeat(rng.standard_normal(80), 10)
    x = np.zeros(800)
    for k in range(799):
        x[k + 1] = 0.85 * x[k] + 0.15 * (0.5 if k >= at else 1.0) * u[k]
    record = dgp.Record(np.arange(800.0), u + offset, x + 0.01 * rng.standard_normal(800))
    quick = {"workers": 1, "progress": False}
    fit = dgp.fit(dgp.LinearDynamicGP(1, pairs=1), record[:400], **quick)
    looked_for = (GainShift(), LevelShift(), Drift())
    report = dgp.close_loop(fit, record, effects=looked_for, **quick)
    (effect,) = report.effects
    assert effect.name == "gain shift"
    assert report.outcome == "effects added"
    assert report.before["rmse"] > 0.05
    assert report.after["rmse"] < 0.013
    assert [type(one) for one in report.fit.model.channels] == [
        StepOfGain, *([Step] if offset else [])
    ]  # fmt: skip
    (instant,) = [v for name, v in effect.parameters.items() if name.startswith("instant")]
    assert instant[0] == pytest.approx(at - 0.5, abs=1.0)


def test_a_gain_that_changes_for_a_while_is_followed():
    rng = np.random.default_rng(1)
    u = np.repeat(rng.standard_normal(80), 10)
    gain = 1.0 - 0.5 * np.clip((np.arange(800) - 150) / 300.0, 0.0, 1.0)
    x = np.zeros(800)
    for k in range(799):
        x[k + 1] = 0.85 * x[k] + 0.15 * gain[k] * u[k]
    record = dgp.Record(np.arange(800.0), u, x + 0.02 * rng.standard_normal(800))
    quick = {"workers": 1, "progress": False}
    fit = dgp.fit(dgp.LinearDynamicGP(1, pairs=1), record[:400], **quick)
    report = dgp.close_loop(fit, record, effects=(GainShift(), Drift()), max_rounds=1, **quick)
    (effect,) = report.effects
    assert effect.name == "gain shift"
    assert "changes down to 0." in effect.sentence
    assert " s about then." in effect.sentence
    assert report.before["rmse"] > 0.1
    assert report.after["rmse"] < 0.04  # the noise is 0.02, and how long it takes a coarse guess
