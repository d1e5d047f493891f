"""Outliers."""

import dataclasses

import numpy as np
import pytest
from scipy.signal import lfilter

from pyro_dynogp.effects.heavy_tails import heavy_tails, student_t
from tests.discrepancy.made import SETTINGS
from tests.discrepancy.series import residuals
from tests.effects.scenes import with_noise


class TestHeavyTails:
    def test_degrees_of_freedom(self):
        r = residuals(0, 600, draw=lambda g, m: g.standard_t(4.0, m))
        found = heavy_tails(r, SETTINGS)
        assert found.p_value < 1e-4
        assert found.gain > 10.0
        assert 3.0 < found.where["degrees_of_freedom"] < 6.0

    def test_outliers_are_counted(self):
        r = residuals(1, 400)
        v = r.innovations.copy()
        v[[30, 130, 230, 330]] = 8.0, -8.0, 9.0, 7.0
        assert heavy_tails(dataclasses.replace(r, innovations=v), SETTINGS).where["outliers"] == 4

    def test_normal_noise_has_no_student_t(self):
        nu, location, scale, gain = student_t(np.random.default_rng(0).standard_normal(2000))
        assert nu > 30.0
        assert gain < 2.0
        assert location == pytest.approx(0.0, abs=0.1)
        assert scale == pytest.approx(1.0, abs=0.1)

    def test_coloured_noise_does_not_look_heavy(self):
        x = lfilter([1.0], [1.0, -0.95], np.random.default_rng(3).standard_normal(400))
        assert heavy_tails(with_noise(residuals(0, 400), x), SETTINGS).p_value > 0.05
