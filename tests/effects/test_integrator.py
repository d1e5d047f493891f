"""A pole at zero: its test, its block and its rate; and what inputs of two values cannot show."""

import dataclasses
from types import SimpleNamespace

import numpy as np
import pytest

import pyro_dynogp as dgp
from pyro_dynogp.effects.drift import drift
from pyro_dynogp.effects.hysteresis import hysteresis
from pyro_dynogp.effects.input_nonlinearity import input_nonlinearity
from pyro_dynogp.effects.integrator import Integrator, integrator
from pyro_dynogp.statistics.evidence import Evidence
from tests.discrepancy.made import SETTINGS, coloured, lag, residuals_of

STEP, RATE = 0.1, 0.25
EFFECT = Integrator()


def inputs(seed, n=400):
    rng = np.random.default_rng(seed)
    return np.repeat(rng.standard_normal((n // 10, 2)), 10, axis=0), 0.1 * coloured(rng, n, 0.5)


def level(u):
    """Integral (n,) of a held input."""
    return STEP * np.concatenate([[0.0], np.cumsum(u)[:-1]])


class TestDetection:
    def test_the_integral_of_an_input_is_found(self):
        u, e = inputs(0)
        mean = lag(u[:, 0], 0.5) + lag(u[:, 1], 0.8)
        found = integrator(residuals_of(mean + RATE * level(u[:, 1]) + e, mean, u), SETTINGS)
        assert found.p_value < 1e-4
        assert found.where == {"channel": "v"}
        assert found.sentence.startswith("'speed' integrates channel 'v'")

    def test_a_trend_is_none(self):
        u, e = inputs(1)
        mean = lag(u[:, 0], 0.5)
        r = residuals_of(mean + 0.02 * np.arange(400) + e, mean, u)
        assert integrator(r, SETTINGS).p_value > 0.05
        assert drift(r, SETTINGS).p_value < 0.05

    def test_without_inputs_there_is_none(self):
        u, e = inputs(1)
        r = residuals_of(e, 0.0 * e + lag(u[:, 0], 0.5), u)
        alone = dataclasses.replace(r, inputs=u[:, :0], input_names=())
        with pytest.raises(ValueError, match="no inputs"):
            integrator(alone, SETTINGS)


class TestBlock:
    def test_the_last_dynamic_layer_has_a_pole_at_zero(self):
        (model,) = EFFECT.extend(dgp.LinearDynamicGP(1, pairs=2), None, None)
        assert model.dynamic[0][1].integrators == 1
        (deep,) = EFFECT.extend(dgp.WienerHammerstein(1), None, None)
        assert [layer.integrators for _, layer in deep.dynamic] == [0, 1]

    def test_where_there_is_one_there_is_no_other(self):
        assert EFFECT.extend(dgp.LinearDynamicGP(1, integrators=1), None, None) == []
        assert EFFECT.extend(dgp.LinearDynamicGP(0, pairs=2), None, None) == []


def test_inputs_of_two_values_show_no_function():
    """Every function of such an input is a line, and play another gain and level."""
    rng = np.random.default_rng(0)
    u = np.repeat(rng.choice([-1.0, 3.0], 40), 10)[:, None]
    mean = lag(u[:, 0], 0.5)
    r = residuals_of(mean + 0.3 * lag(u[:, 0] > 0, 2.0) + 0.1 * coloured(rng, 400, 0.5), mean, u)
    with pytest.raises(ValueError, match="more than two values"):
        input_nonlinearity(r, SETTINGS)
    assert hysteresis(r, SETTINGS).where["channel"] == "speed"
    both = dataclasses.replace(
        r, inputs=np.column_stack([u, rng.standard_normal(400)]), input_names=("u", "v")
    )
    assert input_nonlinearity(both, SETTINGS).where["channel"] == "v"


@pytest.fixture(scope="module")
def tank():
    """A level that integrates its inflow less the outflow, 0.002 m for each litre."""
    rng = np.random.default_rng(1)
    n, step = 360, 10.0
    u = 50.0 + 5.0 * np.repeat(rng.choice([-1.0, 0.2, 1.0], n // 12), 12)
    y = 1.5 + 0.002 * step * np.concatenate([[0.0], np.cumsum(u - 50.0)[:-1]])
    return dgp.Record(time=step * np.arange(n), inputs=u, outputs=y + 0.02 * rng.standard_normal(n),
                      input_names=("flow",), output_names=("h",), input_units=("l/s",),
                      output_units=("m",), time_unit="s")  # fmt: skip


def test_the_loop_names_an_integrator_and_its_rate(tank):
    linear = dgp.fit(dgp.LinearDynamicGP(1, pairs=1), tank[:200], workers=1, progress=False)
    report = dgp.close_loop(linear, tank, max_rounds=1, workers=1, progress=False)
    (effect,) = report.effects
    assert effect.name == "integrator"
    ((label, (rate, sd)),) = effect.parameters.items()
    assert label == "rate per unit of flow [m/(l/s s)]"
    assert abs(rate - 0.002) < 4.0 * sd
    assert 0.0 < sd < 2e-5
    assert report.after["rmse"] < 0.024  # noise 0.02
    assert report.after["rmse"] < report.before["rmse"]


def test_what_the_residual_shows_of_it_is_not_its_size():
    found = Evidence("integrator", 1.0, 0.5, 1.0, 1.0, {}, "'y' integrates channel 'u', about 2 m.")
    assert EFFECT.sentence(found, dgp.LinearDynamicGP(1)) == "'y' integrates channel 'u'."


def test_no_rate_without_units():
    wiener = SimpleNamespace(model=dgp.Wiener(1), scaling=None)
    assert EFFECT.parameters(wiener, None, None) == {}
