"""Without an effect tests reject as rarely as promised."""

import numpy as np
import pandas as pd
import pytest

from pyro_dynogp.effects.calendar import calendar
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
from tests.discrepancy.made import FEW, SETTINGS, null_record, within_chance
from tests.discrepancy.series import check_rate, residuals
from tests.effects.scenes import first_extra, of_the_week, stamps

DETECTORS = [
    output_nonlinearity, input_nonlinearity, nonlinear_feedback, saturation, dead_zone, hysteresis,
]  # fmt: skip


@pytest.mark.parametrize("detector", [first_extra, dead_time, unmodelled_dynamics, integrator])
def test_level_of_paths(detector):
    p = np.array([detector(null_record(seed, 240), SETTINGS).p_value for seed in range(100)])
    assert within_chance((p <= 0.05).sum(), 100, 0.05)
    assert within_chance((p <= 0.3).sum(), 100, 0.3)


@pytest.mark.parametrize("detector", DETECTORS)
def test_level_of_shapes(detector):
    p = np.array([detector(null_record(seed, 240), SETTINGS).p_value for seed in range(100)])
    assert within_chance((p <= 0.05).sum(), 100, 0.05)
    assert within_chance((p <= 0.3).sum(), 100, 0.3)


class TestNoise:
    def test_level_is_kept_by_tails_and_process_noise(self):
        series = [residuals(s) for s in range(100)]
        for detector in (heavy_tails, process_noise):
            check_rate([detector(r, SETTINGS, seed=s).p_value for s, r in enumerate(series)])

    def test_level_is_kept_by_sizes(self):
        check_rate(
            [heteroscedastic_noise(residuals(s, 150), FEW, seed=s).p_value for s in range(100)]
        )

    def test_level_is_kept_by_feedback(self):
        series = (residuals(s, deviation=0.02) for s in range(100))
        check_rate([feedback(r, SETTINGS, seed=s)[0].p_value for s, r in enumerate(series)])


class TestTime:
    @pytest.mark.parametrize(
        "detector", [drift, level_shift, gain_shift, periodic_disturbance, clock_shift]
    )
    def test_level_is_kept(self, detector):
        check_rate(
            [detector(residuals(s, 150, deviation=0.02), FEW, seed=s).p_value for s in range(100)]
        )

    def test_level_is_kept_for_the_calendar(self):
        clock = stamps(160, "3h")
        series = (residuals(s, 160, step=1.0, stamps=clock) for s in range(100))
        check_rate([of_the_week(r, FEW, seed=s).p_value for s, r in enumerate(series)])

    def test_level_is_kept_for_the_year(self):
        clock = pd.date_range("2020-01-01", periods=600, freq="D", tz="UTC")
        series = (residuals(s, 600, step=1.0, stamps=clock) for s in range(60))
        check_rate([calendar(r, FEW, seed=s)[1].p_value for s, r in enumerate(series)])
