"""Draws of a posterior that are far less likely than its mode are reported."""

import warnings

import numpy as np
import pytest

import pyro_dynogp as dgp
from pyro_dynogp.inference.methods.base import Problem
from pyro_dynogp.inference.methods.optima import free_sites, warn_of_wide_draws


@pytest.fixture(scope="module")
def fitted():
    rng = np.random.default_rng(0)
    u = np.repeat(rng.standard_normal(30), 4)
    x = np.convolve(u, np.exp(-0.3 * np.arange(20)))[:120]
    y = np.tanh(0.5 * x) + 0.02 * rng.standard_normal(120)
    record = dgp.Record(time=np.arange(120.0), inputs=u, outputs=y)
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        fit = dgp.fit(
            dgp.Wiener(1, pairs=1), record, restarts=2, workers=1, progress=False, method="svi"
        )
    return fit, Problem(fit.model, fit.model.prepare(fit.records)), [str(w.message) for w in said]


def wider(fit, free, factor):
    mode = fit.mode
    return {k: mode[k] + factor * (v - mode[k]) if k in free else v for k, v in fit.draws.items()}


def test_a_usual_fit_says_nothing(fitted):
    fit, _, said = fitted
    assert fit.method == "svi"
    assert not [text for text in said if "too wide" in text]


def test_draws_that_are_too_wide_are_reported_with_their_loss(fitted):
    fit, problem, _ = fitted
    free = free_sites(problem)
    numbers = sum(fit.mode[name].numel() for name in free)
    with pytest.warns(UserWarning, match=f"of {numbers} free numbers. The normal around the mode"):
        warn_of_wide_draws(problem, fit.mode, wider(fit, free, 30.0), free)


def test_draws_that_are_half_as_wide_again_are_not(fitted):
    """They lose about two and a half times as much as the right ones; the rule is ten times."""
    fit, problem, _ = fitted
    free = free_sites(problem)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warn_of_wide_draws(problem, fit.mode, wider(fit, free, 1.5), free)
