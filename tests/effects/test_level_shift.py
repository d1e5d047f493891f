"""Steps of the level."""

import dataclasses

import numpy as np
import pytest

from pyro_dynogp.effects.drift import drift
from pyro_dynogp.effects.level_shift import level_shift
from tests.discrepancy.made import SETTINGS
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
