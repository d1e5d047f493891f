"""Functions in feedback that make predictions run away, where the loop looks at residuals."""

import re
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch

import pyro_dynogp as dgp
from pyro_dynogp.discrepancy import residuals
from pyro_dynogp.lti.roots import root_of
from pyro_dynogp.lti.semiseparable import NotPositiveDefiniteError
from pyro_dynogp.report.last_tests import last_tests
from pyro_dynogp.statistics.settings import LoopSettings
from pyro_dynogp.support.frozen import FrozenMapping

SETTINGS = LoopSettings()


@pytest.fixture(scope="module")
def record():
    return dgp.datasets.load("gas_furnace").train[:120]


@pytest.fixture(scope="module")
def fit(record):
    layer = dgp.Dynamic(pairs=2, hidden=2, feedback=("past",))
    past = dgp.Form("hysteresis", sees=("g_hidden",), name="past")
    model = dgp.Cascade(1, (layer, past), output="g")
    return dgp.fit(model, record, method="map", restarts=1, steps=3, workers=1, progress=False)


def explosive(fit, draws):
    """The fit with so many draws, of which all but the first half act back with huge gains."""
    values = {k: v.expand(draws, *v.shape[1:]).clone() for k, v in fit.draws.items()}
    values["g_input_gain"][draws // 2 :, :, 1] = 1e4
    mode = FrozenMapping({name: value[-1] for name, value in values.items()})
    return replace(fit.with_draws(values), mode=mode)


def test_roots_of_covariances():
    x = torch.randn(3, 2, dtype=torch.float64)
    covariance = x @ x.mT
    torch.testing.assert_close(root_of(covariance) @ root_of(covariance).mT, covariance)
    with pytest.raises(NotPositiveDefiniteError, match="make predictions run away"):
        root_of(covariance * torch.nan)


def test_a_forecast_from_there_is_refused_with_a_sentence(fit, record):
    with pytest.raises(ValueError, match=re.escape("functions in feedback make predictions run")):
        explosive(fit, 1).forecast(record[:60], record[60:])


def test_free_runs_are_of_the_draws_that_hold(fit, record):
    """Half of them do; of none there are no runs."""
    held_out = np.arange(len(record)) >= 60
    given = explosive(fit, 4)
    runs = residuals._runs(given, record[:60], record[60:], 4, 0)
    assert runs.shape == (4, 60, 1)
    assert np.isfinite(runs).all()
    alone = explosive(fit, 1)
    assert residuals._runs(alone, record[:60], record[60:], 4, 0).shape == (0, 60, 1)
    found = residuals.free_run_of(alone, record, held_out=held_out, seed=0, settings=SETTINGS)
    assert not np.isfinite(found.mean[-1])


def test_effects_of_a_model_that_runs_away_are_not_tested_on_the_last_block(fit, record):
    """Nor does that end the report."""
    effect = SimpleNamespace(name="anything", detect=lambda part, settings, seed: part())
    other = SimpleNamespace(name="another", detect=lambda part, settings, seed: [
        SimpleNamespace(p_value=0.25)])  # fmt: skip

    def nothing():
        raise ValueError("residuals: expected at least 30 samples to look at, got 0.")

    parts = iter([[lambda: [SimpleNamespace(p_value=0.5)]], [nothing]])
    rounds = SimpleNamespace(
        settings=SETTINGS, seed=0, workers=1, progress=False, residuals=lambda *_: next(parts)
    )
    found = [SimpleNamespace(effect=effect), SimpleNamespace(effect=other)]
    sealed = np.zeros(len(record), dtype=bool)
    assert last_tests(found, (fit, fit), record, sealed, rounds) == {"another": (0.25, 0.25)}
    assert last_tests([], (fit, fit), record, sealed, rounds) == {}


HELD_OUT = np.arange(120) >= 90


def test_before_the_first_sample_that_counts_predictions_take_the_place_of_runs(
    fit, record, monkeypatch
):
    """From an unknown first state they run away here; the filter of the outputs does not."""
    given = {"held_out": HELD_OUT, "seed": 0, "settings": SETTINGS}
    plain = residuals.free_run_of(fit, record, **given)
    begin, simulate = plain.begin, residuals.simulate
    assert 0 < begin < 60

    def exploding(*arguments, **options):
        found = simulate(*arguments, **options)
        found.component_mean[:, begin // 2 :] = np.inf
        return found

    monkeypatch.setattr(residuals, "simulate", exploding)
    found = residuals.free_run_of(fit, record, **given)
    ahead = fit.predict(record[:begin]).mean
    np.testing.assert_allclose(found.mean[:begin], ahead)
    # All draws are alike; rounding is left of their mean, at outputs of 50 %.
    np.testing.assert_allclose(found.deviations[:, :begin], 0.0, atol=1e-10)
    np.testing.assert_allclose(found.mean[begin:], plain.mean[begin:])


def test_draws_that_run_away_are_no_spread(fit, record, monkeypatch):
    given = {"held_out": HELD_OUT, "seed": 0, "settings": SETTINGS}
    runs = residuals._runs

    def exploding(*arguments):
        found = runs(*arguments).copy()
        found[: len(found) // 4, -1] = 1e80
        return found

    monkeypatch.setattr(residuals, "_runs", exploding)
    found = residuals.free_run_of(fit, record, **given)
    assert len(found.deviations) == SETTINGS.draws
    assert np.abs(found.deviations).max() < 1e3


def test_from_where_a_run_leaves_the_range_the_output_counts_as_missing(fit, record):
    run = residuals.free_run_of(fit, record, held_out=HELD_OUT, seed=0, settings=SETTINGS)
    mean = run.mean.copy()
    mean[100] += 10.0 * np.ptp(record.outputs)  # and what comes after it, where it returns
    mean[110:] = np.nan
    found = residuals.residuals_of(
        fit, record, held_out=HELD_OUT, settings=SETTINGS, run=replace(run, mean=mean)
    )
    there = np.flatnonzero(np.isfinite(found.residual))
    assert (there[0], there[-1]) == (run.begin, 99)
    assert np.isfinite(found.mean).all()
