"""Levels and gains that drift."""

import numpy as np

from pyro_dynogp.effects.drift import drift
from pyro_dynogp.effects.level_shift import level_shift
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
