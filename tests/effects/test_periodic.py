"""A disturbance of unknown period: as tests and as refits find it."""

import dataclasses

import numpy as np
import pytest

import pyro_dynogp as dgp
from pyro_dynogp import effects
from pyro_dynogp.data.channels import Sinusoid
from pyro_dynogp.discrepancy.trials import Trial, run
from pyro_dynogp.effects.periodic import periodic_disturbance
from tests.discrepancy.made import SETTINGS, coloured, fitted_mode
from tests.discrepancy.plant_dynamics import System, response
from tests.discrepancy.series import residuals
from tests.discrepancy.test_decision import spoken_for
from tests.effects.scenes import sine

N, STEP, PERIOD = 400, 0.5, 18.3
MODEL = dgp.LinearDynamicGP(1, pairs=1)


class TestPeriodicDisturbance:
    @pytest.mark.parametrize("size", [0.5, 2.0, 8.0])
    def test_strong_lines_are_found_as_well_as_weak_ones(self, size):
        """A filter of high order makes white what is left of a line between two frequencies."""

        def line(t, mean, u):
            angle = 2.0 * np.pi * t / 11.83
            return size * (np.sin(angle) + 0.4 * np.sin(2.0 * angle + 1.0))

        found = periodic_disturbance(residuals(7, 750, pole=0.0, effect=line), SETTINGS)
        assert found.p_value < 1e-9
        assert found.gain > 0.3 * 375 * np.log(1.0 + 0.58 * size**2)
        assert found.where["period"] == pytest.approx(11.83, rel=2e-3)

    def test_period_is_found(self):
        found = [
            periodic_disturbance(residuals(s, 500, effect=sine), SETTINGS, seed=s)
            for s in range(2, 6)
        ]
        assert np.median([e.p_value for e in found]) < 0.01
        # Half of 1 / duration at this period is 0.35 s.
        assert np.median([abs(e.where["period"] - 13.3) for e in found]) < 0.15
        assert np.median([e.size for e in found]) == pytest.approx(0.9 / np.sqrt(2.0), abs=0.2)

    def test_harmonics_are_named(self):
        def saw(t, mean, u):
            return 3.0 * ((t / 16.7) % 1.0)

        found = periodic_disturbance(residuals(0, 600, pole=0.0, effect=saw), SETTINGS)
        assert found.p_value < 1e-6
        assert found.where["period"] == pytest.approx(16.7, rel=0.005)
        assert "harmonics 2" in found.sentence

    def test_only_what_is_held_out_is_looked_at(self):
        def early(t, mean, u):
            return 3.0 * np.sin(t) * (t < 100.0)

        held = np.arange(500) >= 200
        found = periodic_disturbance(residuals(0, 500, effect=early, held_out=held), SETTINGS)
        assert found.p_value > 0.01

    def test_rows_that_are_not_there(self):
        r = residuals(2, 500, effect=sine)
        kept = np.arange(500) % 11 != 3
        fewer = dataclasses.replace(
            r,
            **{
                k: getattr(r, k)[kept]
                for k in ("time", "output", "mean", "innovations", "inputs", "held_out")
            },
            deviations=r.deviations[:, kept],
        )
        assert periodic_disturbance(fewer, SETTINGS).where["period"] == pytest.approx(13.3, abs=0.2)
        crooked = dataclasses.replace(fewer, time=fewer.time**1.01)
        with pytest.raises(ValueError, match="equal steps"):
            periodic_disturbance(crooked, SETTINGS)


@pytest.mark.parametrize(("shown", "off"), [(1, 0.0), (1, 0.12), (2, 0.03), (3, -0.02)])
def test_the_period_is_that_of_the_fundamental(shown: int, off: float) -> None:
    """`shown` is the harmonic that the test has seen, `off` in shares of its resolution."""
    rng = np.random.default_rng(0)
    time, u = STEP * np.arange(N), coloured(rng, N, 0.8)
    y = response(System(np.array([-0.25 + 0.3j]), np.array([[0.3 - 0.2j]])), u[:, None])
    angle = 2.0 * np.pi * time / PERIOD
    wave = 0.2 * np.sin(angle) + (0.15 * np.cos(shown * angle) if shown > 1 else 0.0)
    y = y / y.std() + wave + 0.05 * rng.standard_normal(N)
    record = dgp.Record(time, u, y, input_names=("u",))
    training = record[:300]
    seen = PERIOD / shown
    seen += off * seen**2 / training.duration
    effect = effects.PeriodicDisturbance()
    found = spoken_for(effect, 0.001, 0.01, period=seen, output="y", time_unit="s")
    variants = tuple(effect.extend(MODEL, found.evidence, training))
    base = fitted_mode(MODEL, training)
    tried = run(
        Trial(
            variants, record, (np.arange(N) >= 300,), base, 0, SETTINGS, "forecast", effect.refine
        )
    )
    (channel,) = tried.model.channels
    assert isinstance(channel, Sinusoid)
    assert abs(channel.period - PERIOD) < 0.05 * PERIOD**2 / training.duration
    assert channel.harmonics >= shown
    sentence = effect.sentence(found.evidence, tried.model)
    assert f"'y' with a period of {channel.period:.4g} s" in sentence
    assert (f"{channel.harmonics} harmonics" in sentence) == (channel.harmonics > 1)
