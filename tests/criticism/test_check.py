"""The verdict on a posterior: what it says of good fits and of bad ones."""

from dataclasses import replace
from types import MappingProxyType

import numpy as np
import pytest
import torch

import pyro_dynogp as dgp
from pyro_dynogp.criticism.finding import Finding, apart
from pyro_dynogp.inference.pareto import good_k
from pyro_dynogp.inference.posteriors import Sampled
from tests.conftest import simulate_record

QUIET = {"workers": 1, "progress": False}


@pytest.fixture(scope="module")
def long(one_pair):
    return simulate_record(one_pair, 0.1, n=300, seed=3)


@pytest.fixture(scope="module")
def good(long):
    model = dgp.LinearDynamicGP(inputs=1, pairs=1)
    return dgp.fit(model, long, method="svi", steps=250, restarts=2, **QUIET)


def test_a_good_fit(good):
    found = dgp.check(good)
    text = str(found)
    assert found["posterior k"].value < 0.9
    assert found["ELBO"].good
    assert found["one-step calibration"].good
    assert text.splitlines()[0] == "Check of a fit by svi"
    assert len(text.splitlines()) < 15
    assert found["starts"].value >= 1


def test_an_overconfident_posterior(good):
    guide = good.posterior
    narrow = replace(guide, scale_tril=0.3 * guide.scale_tril)
    found = dgp.check(replace(good, posterior=narrow))
    assert found["posterior k"].good is False
    assert found["posterior k"].value > 0.7
    assert not found.good
    assert "posterior k" in found.verdict


def test_numbers_near_their_limit_are_told_apart():
    assert apart(0.5, 0.62) == ("0.50", "0.62")
    assert apart(0.6203, 0.6157) == ("0.620", "0.616")
    assert apart(0.61572, 0.61571) == ("0.61572", "0.61571")
    assert apart(np.inf, 0.7) == ("inf", "0.70")
    assert apart(0.7, 0.7) == ("0.700000", "0.700000")
    assert Finding("k", 0.6204, False, "", 0.6201).number == "0.6204"
    assert Finding("rise", 12345.6, None, "").number == "1.23e+04"
    assert Finding("none", np.nan, None, "").number == ""


def test_k_at_its_limit_is_printed_so_that_it_is_understood(good, monkeypatch):
    limit = good_k(1000)
    monkeypatch.setattr("pyro_dynogp.criticism.check.psis", lambda ratio: (None, limit + 4e-4))
    found = dgp.check(good)["posterior k"]
    assert found.good is False
    assert found.number == "0.6671"
    assert "k = 0.6671 (good: up to 0.6667)" in found.text
    monkeypatch.setattr("pyro_dynogp.criticism.check.psis", lambda ratio: (None, limit - 4e-4))
    assert dgp.check(good)["posterior k"].good


def test_an_elbo_that_still_rises(good):
    rising = np.linspace(-500.0, 0.0, 300) + np.random.default_rng(0).standard_normal(300)
    found = dgp.check(replace(good, history=rising))
    assert found["ELBO"].good is False
    assert "raise steps" in found["ELBO"].text


def test_noise_that_is_half_of_the_truth(good):
    """Deliberately overconfident predictions are called too narrow."""
    draws = dict(good.draws)
    draws["noise_sd"] = 0.3 * draws["noise_sd"]
    if "g_noise_gain_local_scale" in draws:
        draws["g_noise_gain_local_scale"] = 0.1 * draws["g_noise_gain_local_scale"]
    found = dgp.check(replace(good, draws=MappingProxyType(draws)))
    assert found["one-step calibration"].good is False


def test_chains(good):
    names = list(good.draws)
    diagnostics = {"divergences": 0.0, "chains": 2.0}
    diagnostics |= {f"r_hat {name}": 1.002 for name in names}
    diagnostics |= {f"effective samples {name}": 900.0 for name in names}
    chains = replace(good, posterior=Sampled(good.draws), diagnostics=MappingProxyType(diagnostics))
    found = dgp.check(chains)
    assert found["R-hat"].good
    assert found["effective draws"].good
    assert found["divergences"].good
    bad = diagnostics | {"r_hat offset": 1.2, "effective samples offset": 30.0, "divergences": 9.0}
    found = dgp.check(replace(chains, diagnostics=MappingProxyType(bad)))
    assert [one.name for one in found.findings if one.good is False][:3] == [
        "R-hat", "effective draws", "divergences",
    ]  # fmt: skip
    assert "offset" in found["R-hat"].text


def test_a_cascade_with_trajectories_as_sites(bent):
    options = {"restarts": 1, "steps": 30, "particles": 2, "draws": 60}
    fit = dgp.fit(
        dgp.Wiener(1, pairs=1, inducing=6), bent, guide="gauss-markov", **options, **QUIET
    )
    found = dgp.check(fit)
    assert found["whole-vector k"].good is None
    assert torch.isfinite(torch.tensor(found["posterior k"].value))


def test_without_records(good):
    with pytest.raises(ValueError, match="fit: expected a fit that has its training records"):
        dgp.check(replace(good, records=()))
