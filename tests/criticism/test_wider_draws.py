"""Draws that `loo` takes of normals around optima: wider ones, unless these do not describe it."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

import pyro_dynogp as dgp
from pyro_dynogp.criticism import subjects
from pyro_dynogp.criticism.left_out import Base, missing_sample
from pyro_dynogp.criticism.posterior_draws import draws_of, wider_draws
from pyro_dynogp.criticism.subjects import FitSubject
from pyro_dynogp.inference.pareto import effective, good_k, psis

QUIET = {"workers": 1, "progress": False}
COUNT = 1000


@pytest.fixture(scope="module")
def fit(bent):
    model = dgp.Wiener(1, pairs=1, inducing=5, process_noise=False)
    return dgp.fit(model, bent[:80], method="svi", restarts=1, **QUIET)


def latent(fit, draws):
    """Unconstrained vectors (S, d) of the free sites, whitened by the fit's normal."""
    parts = [site.transform.inv(draws.values[site.name]) for site in fit.posterior.sites]
    z = torch.cat([part.reshape(len(draws), -1) for part in parts], -1)
    off = (z - fit.posterior.loc[draws.group]).unsqueeze(-1)
    roots = fit.posterior.scale_tril[draws.group]
    return torch.linalg.solve_triangular(roots, off, upper=False).squeeze(-1).numpy()


def test_their_spread_and_density(fit):
    found = wider_draws(fit, 4000, 0)
    white = latent(fit, found)
    d = white.shape[1]
    factor = 1.0 + d**-0.5
    variances = white.var(0)
    np.testing.assert_allclose(variances, factor, atol=5.0 * factor * math.sqrt(2.0 / 4000))
    plain = fit.posterior.log_prob(found.values).numpy() - found.log_q
    expected = 0.5 * (d * math.log(factor) - (1.0 - 1.0 / factor) * (white**2).sum(1))
    np.testing.assert_allclose(plain, expected, atol=1e-8)
    # Of 4000 draws the standard deviation of such a share is 0.004.
    share = effective(plain - np.logaddexp.reduce(plain)) / 4000
    assert share == pytest.approx((math.sqrt(2.0 * factor - 1.0) / factor) ** d, abs=0.02)


def test_loo_takes_them(fit):
    found = FitSubject(fit, fit.records, COUNT, 0).draws
    assert np.array_equal(found.log_q, wider_draws(fit, COUNT, 0).log_q)
    assert found.kind == fit.posterior.kind


def test_not_where_normals_do_not_describe_the_posterior(fit):
    """A third of the width: the draws of the fit, whose ratios are not used then."""
    posterior = replace(fit.posterior, scale_tril=fit.posterior.scale_tril / 3.0)
    narrow = replace(fit, posterior=posterior)
    assert psis(wider_draws(narrow, COUNT, 0).log_ratio)[1] > good_k(COUNT)
    subject = FitSubject(narrow, narrow.records, COUNT, 0)
    assert np.array_equal(subject.draws.log_q, draws_of(narrow, count=COUNT, seed=0).log_q)
    assert not Base.of(subject).corrected


def test_fewer_samples_need_a_fit(fit, monkeypatch):
    """And the densities are the same."""

    def scored():
        each = [FitSubject(fit, fit.records, COUNT, seed) for seed in range(4)]
        found = [missing_sample(one, 0, 1, False) for one in each]
        return np.sum([x.left for x in found]), np.mean([x.elpd for x in found], 0)

    few, wider = scored()
    monkeypatch.setattr(subjects, "wider_draws", lambda *given: None)
    many, plain = scored()
    assert few < many
    # Monte Carlo errors of four times 1000 draws, of single samples and of their sum.
    np.testing.assert_allclose(wider, plain, atol=0.1)
    assert wider.sum() == pytest.approx(plain.sum(), abs=1.0)


@pytest.mark.parametrize("method", ["map", "importance"])
def test_none_of_other_posteriors(bent, method):
    model = dgp.LinearDynamicGP(1, pairs=1)
    assert wider_draws(dgp.fit(model, bent[:40], method=method, **QUIET), 10, 0) is None
