"""Draws of all parameters of models with functions: densities, moments, which way is taken."""

import dataclasses
import warnings

import numpy as np
import pytest
import torch

import pyro_dynogp as dgp
from pyro_dynogp.inference import function_sampling
from pyro_dynogp.inference.cascade_coordinates import StraightPotential
from pyro_dynogp.inference.function_sampling import (
    CHAINS,
    DOUBT,
    Island,
    NoDrawsError,
    sample_functions,
    shares,
)
from pyro_dynogp.inference.log_joint import log_joint_of
from pyro_dynogp.inference.methods import importance
from pyro_dynogp.inference.methods.annealed import Annealed, Joint
from pyro_dynogp.inference.methods.base import Problem
from pyro_dynogp.inference.run import Run
from tests.inference.cascades import wiener, wiener_record

QUICK = {"restarts": 1, "workers": 1, "progress": False}


@pytest.fixture(scope="module")
def record():
    return wiener_record(60)


@pytest.fixture(scope="module")
def fit(record):
    return dgp.fit(wiener(), record, **QUICK)


def arguments(fit):
    return fit.model.collapsed, tuple(fit.model.prepare(fit.records)), [dict(fit.mode)]


def test_the_default_draws_every_site(fit):
    assert fit.method == "importance"
    assert fit.posterior.kind == (
        f"{CHAINS} chains annealed from Student-t around the mode and from the prior"
    ) or fit.posterior.kind.startswith(f"{CHAINS} chains annealed from Student-t around")
    for name, draws in fit.draws.items():
        assert len(draws) == 300, name
        assert bool((draws.reshape(300, -1).std(0) > 0.0).all()), name
    assert fit.diagnostics["independent draws"] == pytest.approx(CHAINS)
    assert fit.diagnostics["r_hat"] > 1.0
    text = fit.summary()
    assert f"Pareto k {fit.diagnostics['pareto_k']:.2f} of the proposal" in text
    assert f"R-hat {fit.diagnostics['r_hat']:.2f}" in text


def test_draws_have_the_density_that_is_said(fit):
    source = fit.posterior.source
    records = tuple(fit.model.prepare(fit.records))
    again = log_joint_of(fit.model.collapsed, (records,), source.values, 60)
    np.testing.assert_allclose(source.log_p, again, atol=1e-6)
    assert source.log_q is None
    np.testing.assert_array_equal(np.unique(source.ancestor), np.arange(CHAINS))


def test_moments_are_those_of_a_longer_run(fit):
    """Four times as many particles and moves: the noise's mean within one posterior sd."""
    long, _ = sample_functions(*arguments(fit), seed=5, times=4)
    one, other = fit.posterior.source.values["noise_sd"], long.draws.values["noise_sd"]
    assert bool(((one.mean(0) - other.mean(0)).abs() < other.std(0)).all())
    assert bool((one.std(0) < 3.0 * other.std(0)).all())
    assert bool((one.std(0) > other.std(0) / 3.0).all())


def island(log_evidence, level=0.0):
    z = torch.full((8, 2), level, dtype=torch.float64)
    return Island(Annealed(z, log_evidence, (1.0,), (0.8,), np.arange(8)), None, None)


def test_runs_that_found_more_evidence_begin_more_chains():
    more = DOUBT * np.log(3.0)
    assert shares([island(-3.0), island(-3.0 + more)]) == [CHAINS // 4, 3 * CHAINS // 4]
    assert shares([island(-80.0), island(0.0)]) == [0, CHAINS]


class TestWays:
    def test_good_ratios_are_enough(self, fit, monkeypatch):
        def never(*args, **options):
            raise AssertionError("annealed")

        monkeypatch.setattr(function_sampling, "enough_draws", lambda found: True)
        monkeypatch.setattr(function_sampling, "run_of", never)
        found, r_hat = sample_functions(*arguments(fit))
        assert found.trusted
        assert not found.annealed
        assert r_hat == 1.0
        draws = found.draws
        potential = StraightPotential(fit.model.collapsed, (arguments(fit)[1],), fit.mode)
        target = Joint(potential, 60).log_prob(potential.pack(draws.values))
        plain = target - potential.log_jacobian(potential.pack(draws.values)).detach().numpy()
        np.testing.assert_allclose(draws.log_p, plain, atol=1e-6)
        assert draws.log_q is not None

    def test_longer_records_do_not_begin_at_the_prior(self, fit, monkeypatch):
        monkeypatch.setattr(function_sampling, "SHORT", 59)
        found, _ = sample_functions(*arguments(fit))
        assert found.draws.kind == f"{CHAINS} chains annealed from Student-t around the mode"

    def test_flat_priors_are_no_start(self, fit, monkeypatch):
        def never(*args):
            raise AssertionError("began at the prior")

        monkeypatch.setattr(function_sampling, "from_prior", never)
        model, records, optima = arguments(fit)
        flat = dataclasses.replace(model, priors="paper")
        sites = {site.name for site in flat.all_sites(records[0].scaling, 1)}
        if sites <= set(optima[0]):
            sample_functions(flat, records, optima)

    def test_where_no_run_gets_to_the_posterior(self, fit, record, monkeypatch):
        """The posterior that `Normal` gives, and a warning."""
        monkeypatch.setattr(function_sampling, "run_of", lambda *args: [])
        monkeypatch.setattr(function_sampling, "from_prior", lambda *args: [])
        with pytest.raises(NoDrawsError):
            sample_functions(*arguments(fit))
        with pytest.warns(UserWarning, match="fit: no draws got to the posterior of all"):
            found = dgp.fit(wiener(), record, steps=3, **QUICK)
        assert found.method == "svi"
        assert np.isfinite(found.diagnostics["pareto_k"])

    def test_along_long_records_functions_alone_have_draws(self, record):
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            method = dgp.Importance(draws=20, longest=59)
            found = dgp.fit(wiener(), record, method=method, steps=30, **QUICK)
        assert found.method == "svi"
        assert "hyperparameters at each optimum" in found.posterior.kind
        assert len(found.draws["noise_sd"]) == 20


def test_bands_hold_where_those_of_functions_alone_do_not():
    """A Wiener plant of 100 samples, by the present and the former default."""
    from tests.benchmarks.coverage import CASES, linear_record

    shares_of = {"importance": [], "svi": []}
    crps = {"importance": [], "svi": []}
    for seed in (5009,):
        make, bent = CASES["wiener"]
        train, test = linear_record(seed, 100, **bent)
        for method in shares_of:
            one = dgp.fit(make(), train, method=method, restarts=4, workers=1, progress=False)
            found = dgp.scores(one.forecast(train, test), test)
            shares_of[method].append(found["coverage_95"])
            crps[method].append(found["crps"])
    assert np.mean(shares_of["importance"]) > 0.8 > np.mean(shares_of["svi"])
    assert np.mean(crps["importance"]) < 0.9 * np.mean(crps["svi"])


@pytest.mark.parametrize(
    ("make", "samples", "longest", "drawn"),
    [
        (dgp.NonlinearFeedback, 150, None, True),
        (dgp.NonlinearFeedback, 151, None, False),
        (dgp.NonlinearFeedback, 151, 151, True),
        (dgp.Wiener, 1000, None, True),
        (dgp.Wiener, 1001, None, False),
        (dgp.Wiener, 60, 59, False),
    ],
)
def test_how_long_records_may_be_for_draws_of_all_parameters(
    monkeypatch, make, samples, longest, drawn
):
    """With feedback fewer samples: normals around kernels by the evidence do as well there."""

    class ChosenError(Exception):
        pass

    def choose(name):
        def stop(*args, **options):
            raise ChosenError(name)

        return stop

    monkeypatch.setattr(importance, "sample_functions", choose("draws"))
    monkeypatch.setattr(importance.Normal, "around", choose("normals"))
    u = np.random.default_rng(0).standard_normal(samples)
    problem = Problem.of(make(1, pairs=1), dgp.Record(time=np.arange(samples), inputs=u, outputs=u))
    with pytest.raises(ChosenError, match="draws" if drawn else "normals"):
        importance.with_draws_around(problem, [], Run(0, workers=1), 10, longest)
