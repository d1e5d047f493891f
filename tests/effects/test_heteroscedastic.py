"""Noise whose size depends on something."""

from types import SimpleNamespace

import numpy as np
import pytest

import pyro_dynogp as dgp
from pyro_dynogp.effects.heteroscedastic import HeteroscedasticNoise, heteroscedastic_noise
from tests.discrepancy.made import SETTINGS
from tests.discrepancy.series import residuals
from tests.effects.scenes import growing_with_input, with_noise


class TestHeteroscedasticNoise:
    def test_driver_is_named(self):
        found = [heteroscedastic_noise(growing_with_input(s), SETTINGS, seed=s) for s in range(3)]
        assert all(e.p_value < 1e-4 and e.where["driver"] == "u2" for e in found)

    def test_time_is_named(self):
        r = residuals(0, 500, pole=0.0)
        found = heteroscedastic_noise(
            with_noise(r, r.residual * np.linspace(0.5, 2.0, 500)), SETTINGS
        )
        assert found.p_value < 1e-4
        assert found.where["driver"] == "time"

    def test_heavy_tails_are_no_driver(self):
        series = (residuals(s, draw=lambda g, m: g.standard_t(4.0, m)) for s in range(5))
        assert np.median([heteroscedastic_noise(r, SETTINGS).p_value for r in series]) > 0.05


@pytest.mark.parametrize(
    ("model", "driver", "of"),
    [
        (dgp.LinearDynamicGP(1), "mean", ["output"]),
        (dgp.NonlinearFeedback(1), "u", ["inputs"]),
        (dgp.NonlinearFeedback(1), "mean", []),
        (dgp.LinearDynamicGP(0), "mean", []),
    ],
    ids=["output", "input in feedback", "output in feedback", "no inputs"],
)
def test_noise_that_a_model_cannot_have_is_no_variant(model, driver, of):
    """With feedback noise that follows the output is not defined; `close_loop` goes on without."""
    found = HeteroscedasticNoise().extend(model, SimpleNamespace(where={"driver": driver}), None)
    assert [variant.likelihood.of for variant in found] == of
