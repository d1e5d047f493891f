"""One-step errors that depend on earlier ones."""

import dataclasses

import numpy as np
import pytest
from scipy.signal import lfilter

from pyro_dynogp.effects.process_noise import process_noise
from tests.discrepancy.made import SETTINGS
from tests.discrepancy.series import check_rate, residuals
from tests.effects.scenes import growing_with_input, with_noise


class TestProcessNoise:
    def test_time_constant(self):
        decay = np.exp(-0.5 / 1.5)
        x = lfilter([1.0], [1.0, -decay], np.random.default_rng(0).standard_normal(600))
        found = process_noise(with_noise(residuals(0, 600), x), SETTINGS)
        assert found.p_value < 1e-4
        assert found.where["time_constant"] == pytest.approx(1.5, rel=0.35)

    def test_changing_size_does_not_look_coloured(self):
        check_rate(
            [process_noise(growing_with_input(s), SETTINGS, seed=s).p_value for s in range(40)]
        )

    def test_missing_samples(self):
        x = lfilter([1.0], [1.0, -0.7], np.random.default_rng(1).standard_normal(400))
        r = with_noise(residuals(0, 400), x)
        v = r.innovations.copy()
        v[::7] = np.nan
        assert process_noise(dataclasses.replace(r, innovations=v), SETTINGS).p_value < 1e-4
