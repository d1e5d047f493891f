"""One layer of linear dynamics is one model, by whichever name it is made."""

from types import SimpleNamespace

import numpy as np
import pytest
import torch

import pyro_dynogp as dgp
from pyro_dynogp.effects import CATALOGUE
from tests.conftest import simulate_record

QUICK = {"restarts": 2, "steps": 60, "workers": 1, "progress": False}


@pytest.fixture(scope="module")
def both():
    """The same data fitted as a linear model and as a cascade of one dynamic layer."""
    modes = dgp.Modes([-0.5 + 2.0j], [[0.6 - 0.2j]], [1.0], [[0.05]])
    record = simulate_record(modes, 0.05, n=140)
    y = record.outputs.copy()
    y[[5, 6, 30]] = np.nan
    record = record.with_outputs(y)
    options = {"method": "svi", "draws": 20, **QUICK}
    return SimpleNamespace(
        record=record,
        linear=dgp.fit(dgp.LinearDynamicGP(1, pairs=1), record[:100], **options),
        cascade=dgp.fit(dgp.Cascade(1, (dgp.Dynamic(pairs=1),)), record[:100], **options),
    )


def equal(a, b):
    np.testing.assert_allclose(np.asarray(a), np.asarray(b), rtol=1e-12, atol=1e-12)


def test_fits_are_equal(both):
    equal(both.linear.start_energies, both.cascade.start_energies)
    for name, draws in both.linear.draws.items():
        equal(draws, both.cascade.draws[name])


VERBS = {
    "log_likelihood": lambda fit, record: fit.log_likelihood(record[:100]),
    "log_joint": lambda fit, record: fit.log_joint(record[:100]),
    "simulate": lambda fit, record: fit.simulate(record).samples,
    "predict": lambda fit, record: fit.predict(record, horizon=3).variance,
    "forecast": lambda fit, record: fit.forecast(record[:100], record[100:]).mean,
    "forecast samples": lambda fit, record: fit.forecast(record[:100], record[100:]).samples,
    "layers": lambda fit, record: fit.layers(record)["g"].mean,
    "innovations": lambda fit, record: fit.innovations(record),
    "modes": lambda fit, record: fit.modes.poles,
    "noise_sd": lambda fit, record: fit.noise_sd,
}


@pytest.mark.parametrize("verb", VERBS)
def test_verbs(both, verb):
    a, b = (VERBS[verb](fit, both.record) for fit in (both.linear, both.cascade))
    if torch.is_tensor(a):
        a, b = a.numpy(), b.numpy()
    np.testing.assert_allclose(a, b, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("target", ["missing sample", "forecast"])
def test_loo(both, target):
    a, b = (
        dgp.loo(fit, target=target, refits=0, draws=100, progress=False, workers=1)
        for fit in (both.linear, both.cascade)
    )
    equal(a.elpd_loo, b.elpd_loo)
    equal(a.loo_i, b.loo_i)


def test_arviz(both):
    a, b = (fit.to_arviz(samples=3, prior_samples=3) for fit in (both.linear, both.cascade))
    assert a.groups() == b.groups()
    for group in ("posterior", "prior", "log_likelihood", "posterior_predictive"):
        assert set(a[group]) == set(b[group])
        for name in a[group]:
            equal(a[group][name], b[group][name])


def test_close_loop(both):
    options = {"max_rounds": 1, "workers": 1, "progress": False}
    effects = [effect for effect in CATALOGUE if effect.name == "drift"]
    modes = dgp.Modes([-0.5 + 2.0j], [[0.6 - 0.2j]], [1.0])
    record = simulate_record(modes, 0.05, n=360)
    drifting = record.with_outputs(record.outputs + 0.002 * np.arange(360)[:, None])
    reports = [
        dgp.close_loop(
            dgp.fit(model, drifting[:180], **QUICK, method="map"),
            drifting,
            effects=effects,
            **options,
        )
        for model in (dgp.LinearDynamicGP(1, pairs=1), dgp.Cascade(1, (dgp.Dynamic(pairs=1),)))
    ]
    names = [[effect.name for effect in report.effects] for report in reports]
    assert names[0] == names[1] == ["drift"]
    equal(reports[0].after["rmse"], reports[1].after["rmse"])


def test_a_linear_plant_takes_every_likelihood():
    modes = dgp.Modes([-0.5 + 2.0j], [[0.6 - 0.2j]], [1.0], [[0.05]])
    record = simulate_record(modes, 0.05, n=100)
    for likelihood in (dgp.StudentT(), dgp.Heteroscedastic(4), dgp.Heteroscedastic(4, of="output")):
        model = dgp.Cascade(1, (dgp.Dynamic(pairs=1),), likelihood)
        fit = dgp.fit(
            model, record[:70], restarts=1, steps=3, workers=1, progress=False, method="map"
        )
        assert fit.method == "map"
        same = dgp.LinearDynamicGP(1, pairs=1, likelihood=likelihood)
        again = dgp.fit(
            same, record[:70], restarts=1, steps=3, workers=1, progress=False, method="map"
        )
        equal(fit.start_energies, again.start_energies)
        forecast = fit.forecast(record[:70], record[70:])
        assert np.isfinite(forecast.sd).all()
        assert forecast.samples.shape[1:] == (30, 1)
