"""The loop on a flow that carries heat with it: inputs times the output act back."""

import numpy as np
import pytest

import pyro_dynogp as dgp
from pyro_dynogp import effects
from tests.effects.test_nonlinear_feedback import carried


@pytest.fixture(scope="module")
def report():
    record = carried(3, 600)
    fit = dgp.fit(
        dgp.LinearDynamicGP(2, pairs=1), record[:300], method="map", workers=1, progress=False
    )
    tested = (effects.NonlinearFeedbackOfOutput(), effects.InputNonlinearity())
    return dgp.close_loop(fit, record, effects=tested, max_rounds=1, workers=1, progress=False)


def test_products_of_inputs_and_output_are_named(report):
    (effect,) = report.effects
    assert effect.name == "nonlinear feedback"
    assert effect.sentence == "Inputs times 'y' act back on its dynamics."


def test_errors_fall_to_the_noise(report):
    noise = 0.02 * carried(3, 600).outputs.std()
    assert report.before["rmse"] > 3.0 * noise
    assert report.after["rmse"] < 1.3 * noise


def test_numbers_are_those_of_the_plant(report):
    """Rates of 1 - 0.8 u, within three of their standard deviations, which are those of draws."""
    (effect,) = report.effects
    low, high = np.quantile(carried(3, 600)[:450].inputs[:, 1], (0.02, 0.98))
    for (mean, sd), u in zip(effect.parameters.values(), (low, high), strict=True):
        assert 0.0 < sd < 0.2
        assert abs(mean - (1.0 - 0.8 * u)) < 3.0 * sd + 0.03
