"""Steps of the level."""

import dataclasses

import numpy as np
import pytest

import pyro_dynogp as dgp
from pyro_dynogp.data.channels import Step, StepInput
from pyro_dynogp.effects import LevelShift
from pyro_dynogp.effects.drift import drift
from pyro_dynogp.effects.level_shift import level_shift
from pyro_dynogp.models.variants import with_channel
from tests.discrepancy.made import SETTINGS, coloured, lag
from tests.discrepancy.series import residuals
from tests.effects.scenes import step_at_150, trend


class TestLevelShift:
    def test_step_is_found(self):
        found = [
            level_shift(residuals(s, 500, effect=step_at_150), SETTINGS, seed=s) for s in range(5)
        ]
        assert max(e.p_value for e in found) < 1e-3
        assert np.median([abs(e.where["time"] - 150.0) for e in found]) <= 1.0
        assert np.median([e.where["size"] for e in found]) == pytest.approx(2.0, abs=0.4)

    def test_trend_is_rather_a_drift(self):
        gains = [
            drift(r, SETTINGS, seed=s).gain - level_shift(r, SETTINGS, seed=s).gain
            for s in range(3)
            for r in [residuals(s, 500, pole=0.5, effect=trend)]
        ]
        assert min(gains) > 3.0

    def test_missing_samples(self):
        r = residuals(1, 500, effect=step_at_150)
        output = r.output.copy()
        output[100:180] = np.nan
        output[::17] = np.nan
        found = level_shift(dataclasses.replace(r, output=output), SETTINGS)
        assert found.p_value < 0.01
        assert found.where["time"] == pytest.approx(150.0, abs=5.0)
        assert np.isfinite(found.curve.y).all()

    def test_where_a_disturbance_begins_is_found_behind_slow_dynamics(self):
        """With a time constant of 5 samples; a jump fits best later."""
        step = (np.arange(500) >= 300).astype(float)
        response = 15.0 * lag(step, 2.5, 0.5)
        found = []
        for seed in range(5):
            r = residuals(seed, 500, pole=0.3, effect=lambda t, m, u: response)
            r = dataclasses.replace(r, poles=np.array([-1.0 / 2.5 + 0.0j, -2.0 + 1.0j]))
            found.append(level_shift(r, SETTINGS, seed=seed).where)
        late = [one["time"] - 150.0 for one in found]
        off = [abs(one["begin"] - 150.0) for one in found]
        assert np.median(late) >= 1.0  # two samples
        assert np.median(off) <= 0.5  # one sample
        assert max(off) <= 2.5

    def test_nothing_is_refined_where_nothing_is_found_or_no_pole_is_known(self):
        quiet = level_shift(residuals(0, 300), SETTINGS)
        assert quiet.p_value > SETTINGS.noticed
        assert quiet.where["begin"] == quiet.where["time"]
        r = dataclasses.replace(residuals(0, 500, effect=step_at_150), poles=np.zeros(0))
        found = level_shift(r, SETTINGS)
        assert found.where["begin"] == found.where["time"]


def leaking(seed, direct):
    """A lag of 20 samples, and from sample 290 on a leak: behind the lag, or in the sensor."""
    rng = np.random.default_rng(seed)
    u, leak = coloured(rng, 600, 0.8), (np.arange(600) >= 290).astype(float)
    y = lag(u, 10.0, 0.5) - leak if direct else lag(u - leak, 10.0, 0.5)
    y += 0.05 * rng.standard_normal(600)
    return dgp.Record(0.5 * np.arange(600), u[:, None], y[:, None], input_names=("flow",))


class TestBlock:
    @pytest.mark.parametrize("direct", [False, True])
    def test_a_leak_acts_through_the_dynamics_and_a_sensor_at_once(self, direct):
        record = leaking(4, direct)
        model = dgp.LinearDynamicGP(1, pairs=1)
        fit = dgp.fit(model, record[:250], seed=0, workers=1, progress=False, method="map")
        # Block B is from 250 to 425; the sensor's zero jumps, and the leak begins, in it.
        report = dgp.close_loop(fit, record, seed=0, workers=1, progress=False)
        assert [one.name for one in report.effects] == ["level shift"]
        (channel,) = report.fit.model.channels
        assert type(channel) is (Step if direct else StepInput)
        # A sample is 0.5: a jump is seen within one, a response of 20 samples within three.
        assert channel.at == pytest.approx(145.0, abs=0.5 if direct else 1.5)
        assert report.after["rmse"] < 1.1 * 0.05
        (effect,) = report.effects
        if direct:
            assert effect.sentence == "The level of 'y' steps down by 1 at time 145 s."
        else:
            assert effect.sentence == (
                "The level of 'y' moves down about time 152 s, as the dynamics respond to an "
                "earlier step of a disturbance."
            )
            ((label, (gain, sd)), _) = effect.parameters.items()
            assert label.startswith("steady-state gain of disturbance from 14")
            assert abs(gain + 1.0) < 4.0 * sd  # a leak of one, of a lag whose gain is one
            assert 0.0 < sd < 0.05

    def test_behind_a_function_of_the_inputs_the_level_jumps(self):
        record = leaking(4, False)
        found = level_shift(residuals(0, 500, effect=step_at_150), SETTINGS)
        for model, kinds in (
            (dgp.LinearDynamicGP(1), [Step, StepInput]),
            (dgp.Wiener(1), [Step, StepInput]),
            (dgp.Hammerstein(1), [Step]),
        ):
            variants = LevelShift().extend(model, found, record)
            assert [type(one.channels[-1]) for one in variants] == kinds
            assert [one.direct for one in variants] == [1, 0][: len(kinds)]

    def test_the_instant_of_a_disturbance_is_moved_within_the_record(self):
        record, model, effect = leaking(4, False), dgp.LinearDynamicGP(1), LevelShift()
        assert effect.refine(with_channel(model, Step(145.0)), record, 0) == []
        for at, moved in ((145.0, [142.0, 148.0, 143.5, 146.5]), (1.0, [4.0, 2.5])):
            near = effect.refine(with_channel(model, StepInput(at)), record, 0)
            assert [one.channels[-1].at for one in near] == moved
