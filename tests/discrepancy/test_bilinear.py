"""The loop on a flow that carries heat with it: inputs times the output act back."""

from types import SimpleNamespace

import numpy as np
import pytest

import pyro_dynogp as dgp
from pyro_dynogp import effects
from pyro_dynogp.data.channels import Product
from pyro_dynogp.discrepancy import residuals
from pyro_dynogp.effects import bilinear
from pyro_dynogp.effects.base import centre_of
from pyro_dynogp.effects.bilinear import with_products_of_inputs
from pyro_dynogp.effects.nonlinear_feedback import NonlinearFeedbackOfOutput, nonlinear_feedback
from pyro_dynogp.models.feedback_variants import with_products
from tests.discrepancy.made import SETTINGS
from tests.effects.heated import carried


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


def mixed(n=600):
    """Flow, and temperatures of what flows in and out: x' = flow (warm - x) / 10 - 0.024 (x - 18).

    Noise of 0.1, Euler steps of a twentieth of 2 s.
    """
    rng = np.random.default_rng(0)
    flow = np.repeat(rng.uniform(0.2, 1.0, n // 20), 20)
    warm = np.repeat(rng.uniform(40.0, 70.0, n // 30), 30)
    x, y = 35.0, np.empty(n)
    for k in range(n):
        y[k] = x
        for _ in range(20):
            x += 0.1 * (0.1 * flow[k] * (warm[k] - x) - 0.024 * (x - 18.0))
    return dgp.Record(
        2.0 * np.arange(n), np.column_stack([flow, warm]), y + 0.1 * rng.standard_normal(n),
        input_names=("flow", "warm"),
    )  # fmt: skip


@pytest.fixture(scope="module")
def mixture():
    record = mixed()
    model = dgp.LinearDynamicGP(2, pairs=1)
    return record, dgp.fit(model, record[:300], method="map", workers=1, progress=False)


def test_flow_times_a_difference_is_named(mixture):
    record, fit = mixture
    report = dgp.close_loop(
        fit, record, effects=(effects.NonlinearFeedbackOfOutput(), effects.InputNonlinearity()),
        max_rounds=1, workers=1, progress=False,
    )  # fmt: skip
    (effect,) = report.effects
    assert effect.sentence == (
        "Inputs times 'y' act back on its dynamics. Products of inputs drive them as well."
    )
    assert report.before["rmse"] > 3.0 * 0.1
    assert report.after["rmse"] < 1.2 * 0.1
    # Of the inputs, not of their product, which is another one where one of them is.
    assert all("at low flow" in x or "at high flow" in x for x in effect.parameters)


def test_products_of_inputs_are_looked_for_beside_those_of_the_output(mixture, monkeypatch):
    record, fit = mixture
    r = residuals.residuals_of(fit, record, settings=SETTINGS)
    found = nonlinear_feedback(r, SETTINGS)
    assert found.where["products"] == 1.0
    assert found.p_value < 1e-5
    monkeypatch.setattr(bilinear, "MOST_INPUTS", 1)
    assert nonlinear_feedback(r, SETTINGS).where["products"] < 0.9


def test_variants_with_products_of_inputs(mixture, monkeypatch):
    record, _ = mixture
    plain = dgp.LinearDynamicGP(2, pairs=1)
    extended = with_products_of_inputs(plain, record)
    centres = [centre_of(record, name) for name in ("flow", "warm")]
    assert extended.channels == (Product("flow", "warm", *centres),)
    assert extended.wires[1].name == with_products(plain).wires[1].name
    assert with_products_of_inputs(extended, record) is None  # it has them
    assert extended in NonlinearFeedbackOfOutput().extend(
        plain, SimpleNamespace(where={"output": "y", "products": 0.6}), record
    )
    monkeypatch.setattr(bilinear, "MOST_INPUTS", 1)
    assert with_products_of_inputs(plain, record) is None
