"""Levels and gains that drift."""

import numpy as np
import pytest

import pyro_dynogp as dgp
from pyro_dynogp.data.channels import Ramp, RampOfGain, Trend, TrendOfGain
from pyro_dynogp.effects import Drift
from pyro_dynogp.effects.drift import drift
from pyro_dynogp.effects.level_shift import level_shift
from pyro_dynogp.models.variants import with_channel
from pyro_dynogp.statistics.evidence import Evidence
from tests.discrepancy.made import SETTINGS
from tests.discrepancy.series import residuals, share
from tests.effects.scenes import gain_drift, step_at_150, trend


class TestDrift:
    def test_trend_is_found(self):
        found = [drift(residuals(s, 500, effect=trend), SETTINGS, seed=s) for s in range(4)]
        assert np.median([e.p_value for e in found]) < 1e-4
        assert all(e.where["form"] == "additive" for e in found)
        assert 150.0 <= np.median([e.where["time_scale"] for e in found]) <= 250.0
        assert 0.6 < np.median([e.size for e in found]) < 1.2  # 0.87

    def test_drift_of_gain_is_found(self):
        found = [drift(residuals(s, 500, pole=0.5, effect=gain_drift), SETTINGS) for s in range(4)]
        assert np.median([e.p_value for e in found]) < 1e-4
        assert all(e.where["form"] == "gain" for e in found)

    def test_input_whose_gain_drifts_is_named(self):
        def effect(t, mean, u):
            return 0.5 * np.cos(np.pi * t / t[-1]) * share(u[:, 1], 2.0)

        found = drift(residuals(0, 500, pole=0.5, inputs=2, effect=effect), SETTINGS)
        assert found.p_value < 1e-4
        assert found.where["channel"] == "u2"

    def test_step_is_rather_a_level_shift(self):
        for s in range(3):
            r = residuals(s, 500, pole=0.5, effect=step_at_150)
            assert level_shift(r, SETTINGS, seed=s).gain > drift(r, SETTINGS, seed=s).gain + 1.0


class TestExtension:
    MODEL = dgp.LinearDynamicGP(2, pairs=1)
    GAIN = Evidence("drift", 9.0, 1e-9, 9.0, 0.1, {"form": "gain", "channel": "u2"})

    def record(self):
        rng = np.random.default_rng(0)
        u = rng.standard_normal((90, 2)) + np.array([3.0, 0.0])
        return dgp.Record(np.arange(90) + 10.0, u, rng.standard_normal(90))

    def test_a_gain_drifts_along_a_line_or_a_path_with_its_level_or_without(self):
        record = self.record()
        kinds = [
            [type(one) for one in variant.channels]
            for variant in Drift().extend(self.MODEL, self.GAIN, record)
        ]
        line, path = [TrendOfGain] * 2, [RampOfGain] * 8
        assert kinds == [line, [*line, Trend], path, [*path, *[Ramp] * 4]]
        (_, _, path, _) = Drift().extend(self.MODEL, self.GAIN, record)
        own = [one for one in path.channels if one.channel == "u1"]
        assert [one.centre for one in own] == pytest.approx([record.inputs[:, 0].mean()] * 4)
        knots = [own[0].begin, *(one.end for one in own)]
        # Held from two thirds on: the path ends in what the search trains on.
        np.testing.assert_allclose(knots, 10.0 + 89.0 * np.linspace(0.0, 2 / 3, 5))

    @pytest.mark.parametrize("place", range(4))
    def test_a_drift_is_not_added_twice(self, place):
        record = self.record()
        there = Drift().extend(self.MODEL, self.GAIN, record)[place]
        for again in Drift().extend(there, self.GAIN, record):
            new = again.channels[len(there.channels) :]
            kinds = {type(one) for one in there.channels}
            assert not kinds & {type(one) for one in new}
            assert {one.channel for one in new if isinstance(one, (TrendOfGain, RampOfGain))} == {
                "u1", "u2"
            }  # fmt: skip
        level = with_channel(self.MODEL, Trend(0.0, 9.0))
        assert len(Drift().extend(level, self.GAIN, record)) == 3
