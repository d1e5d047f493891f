"""A periodic disturbance as refits find it, whatever harmonic the residual has shown."""

from __future__ import annotations

import numpy as np
import pytest

import pyro_dynogp as dgp
from pyro_dynogp import effects
from pyro_dynogp.data.channels import Sinusoid
from pyro_dynogp.discrepancy.refits import quick_fit
from pyro_dynogp.discrepancy.trials import Trial, run
from tests.discrepancy.made import coloured
from tests.discrepancy.plant_dynamics import System, response
from tests.discrepancy.test_decision import spoken_for

N, STEP, PERIOD = 400, 0.5, 18.3
MODEL = dgp.LinearDynamicGP(1, pairs=1)


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
    base = quick_fit(MODEL, training, 0)
    tried = run(Trial(variants, record, (np.arange(N) >= 300,), base, 0, "forecast", effect.refine))
    (channel,) = tried.model.channels
    assert isinstance(channel, Sinusoid)
    assert abs(channel.period - PERIOD) < 0.05 * PERIOD**2 / training.duration
    assert channel.harmonics >= shown
    sentence = effect.sentence(found.evidence, tried.model)
    assert f"'y' with a period of {channel.period:.4g} s" in sentence
    assert (f"{channel.harmonics} harmonics" in sentence) == (channel.harmonics > 1)
