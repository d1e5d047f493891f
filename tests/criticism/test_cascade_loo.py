"""The hook on default fits of models with functions: all parameters count, against brute force."""

import pickle
from dataclasses import replace

import numpy as np
import pytest

import pyro_dynogp as dgp
from pyro_dynogp.criticism.left_out import monte_carlo_error
from pyro_dynogp.criticism.subjects import FitSubject
from tests.benchmarks.cascade_loo import exact
from tests.inference.cascades import wiener, wiener_record

QUIET = {"workers": 1, "progress": False}
CHOSEN = [5, 17, 26]


@pytest.fixture(scope="module")
def fit():
    return dgp.fit(wiener(process_noise=False), wiener_record(36), restarts=2, **QUIET)


@pytest.fixture(scope="module")
def left_out(fit):
    return dgp.loo(fit, target="missing sample", refits=4, **QUIET)


def test_single_samples_against_a_sampler_that_never_saw_them():
    """Of 60 samples: with 36 errors are 0.2 to 0.9 nats, by the seed."""
    fit = dgp.fit(wiener(process_noise=False), wiener_record(60), restarts=2, **QUIET)
    left_out = dgp.loo(fit, target="missing sample", refits=4, **QUIET)
    real, own_error = exact(fit, CHOSEN, times=6)
    ours = left_out.loo_i.values[CHOSEN]
    subject = FitSubject(fit, fit.records, 0, 0)
    density = subject.pointwise("missing sample")[:, CHOSEN]
    ratio = -density.T
    log_weights = ratio - np.logaddexp.reduce(ratio, axis=1, keepdims=True)
    error = monte_carlo_error(log_weights, density, ours, subject.draws.ancestor)
    both = np.hypot(error, own_error)
    assert both < 0.25
    assert np.abs(ours - real).max() < 3.0 * both


def test_a_posterior_of_functions_alone_flatters(fit, left_out):
    """It keeps poles, gains and noise where all samples put them."""
    alone = dgp.fit(fit.model, fit.records[0], method="svi", start=fit, restarts=0, **QUIET)
    flattered = dgp.loo(alone, target="missing sample", refits=0, **QUIET)
    assert flattered.elpd_loo > left_out.elpd_loo + 2.0
    assert flattered["drawn"] == "inducing values and first states alone"
    assert "Draws of inducing values and first states alone (SVI" in str(flattered)


def test_what_was_counted_is_said(fit, left_out):
    assert left_out["drawn"] == "all parameters"
    assert left_out["draws_from"] == fit.posterior.kind
    assert "Draws of all parameters (24 chains annealed from" in str(left_out)
    again = pickle.loads(pickle.dumps(left_out))
    assert str(again) == str(left_out)
    mode = dgp.loo(fit, target="missing sample", parameters="mode", refits=0, **QUIET)
    assert "no parameter: all are at the mode" in str(mode)


def test_draws_are_moved_on_without_a_sample():
    """To the posterior given fewer data: the noise is known less well, and not another one.

    Of 60 samples: with 36 the posterior has a tail of little noise, and chains of other seeds
    differ by more than is looked for here.
    """
    fit = dgp.fit(wiener(process_noise=False), wiener_record(60), restarts=2, **QUIET)
    subject = FitSubject(fit, fit.records, 0, 0)
    assert subject.carries
    assert not replace(subject, parameters="mode").carries
    assert not replace(subject, fit=fit.at_mode()).carries
    other = subject.carried(np.arange(60) >= 54)
    assert len(other.fit.records[0]) == 54
    before = subject.draws.values["noise_sd"]
    after = other.draws.values["noise_sd"]
    assert len(after) == len(before)
    sd = float(after.log().std())
    assert abs(float(after.log().mean() - before.log().mean())) < 1.5 * sd


def test_forecasts_fit_once_and_move_draws_on(fit):
    found = dgp.loo(fit, target="forecast", begin=30, refits=3, **QUIET)
    assert found.n_data_points == 6
    assert found["refits"] >= 1
    assert np.isfinite(found.elpd_loo)
    assert found["drawn"] == "all parameters"
