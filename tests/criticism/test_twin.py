"""A twin beside NUTS: gaps of known size, a real run, refusals."""

from dataclasses import replace

import numpy as np
import pyro
import pytest
import torch

import pyro_dynogp as dgp
from pyro_dynogp.criticism import twin
from pyro_dynogp.criticism.twin import Effort, Gap, _judged, _rms, _sites, twin_findings
from pyro_dynogp.inference.density import Potential
from pyro_dynogp.inference.laplace import laplace
from pyro_dynogp.inference.log_joint import log_joint_of
from pyro_dynogp.inference.methods.nuts import Chains
from pyro_dynogp.inference.pareto import psis
from pyro_dynogp.inference.posteriors import Mixture, Sampled
from pyro_dynogp.inference.refit import refit
from tests.conftest import simulate_record

QUIET = {"workers": 1, "progress": False}
EFFORT = Effort(chains=2, draws=200, warmup=0)


def exact(model, argument, values, *, chains, draws, **options):
    """The posterior in place of NUTS's chains: Laplace's draws, resampled by their ratios."""
    del options
    potential = Potential(model, (argument,), values)
    centre, root = laplace(potential, values)
    guide = Mixture.normal(potential, torch.as_tensor(centre), torch.as_tensor(root))
    generator = torch.Generator().manual_seed(0)
    z = torch.randn(4000, len(centre), generator=generator, dtype=torch.float64)
    found = guide.at_latent(guide.loc[0] + z @ guide.scale_tril[0].mT)
    ratio = log_joint_of(model, (argument,), found) - guide.log_prob(found).numpy()
    weights = np.exp(psis(ratio)[0])
    chosen = np.random.default_rng(0).choice(4000, chains * draws, p=weights / weights.sum())
    drawn = {name: x[chosen].reshape(chains, draws, *x.shape[1:]) for name, x in found.items()}
    return Chains(drawn, {}, {}, 0)


@pytest.fixture(scope="module")
def fit():
    """Without process noise the posterior is near a normal."""
    quiet = dgp.Modes([-0.5 + 2.0j], [[1.0 + 0.3j]], [1.0], [[1e-4]])
    record = simulate_record(quiet, 0.1, n=60, seed=2)
    model = dgp.LinearDynamicGP(inputs=1, pairs=1, process_noise=False)
    return dgp.fit(model, record, method="svi", steps=20, restarts=1, **QUIET)


@pytest.fixture(scope="module")
def small(fit):
    """The twin."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("pyro_dynogp.inference.refit.SVI_STEPS", 200)
        return refit(fit, fit.records[0][:40])


@pytest.fixture(scope="module")
def posterior(small):
    return exact(small.model, small.records[0], small.mode, chains=2, draws=EFFORT.draws)


@pytest.fixture
def chains(small, posterior, monkeypatch):
    """No time for NUTS, nor for a twin in every test."""
    monkeypatch.setattr(twin, "refit", lambda fit, records: small)
    monkeypatch.setattr(twin, "sample_posterior", lambda *args, **options: posterior)
    monkeypatch.setattr(twin, "Effort", lambda: EFFORT)


def names(findings):
    return {one.name: one for one in findings}


def test_a_good_fit_is_near_nuts(fit, chains):
    found = names(twin_findings(fit, 40))
    assert found["twin"].value == 40
    assert found["twin"].good is None
    assert "2 x 200 draws of NUTS" in found["twin"].text
    for what in ("sites", "predictions"):
        for number in ("means", "sds"):
            assert found[f"twin {what}, {number}"].good, found[f"twin {what}, {number}"]


def test_an_overconfident_posterior_is_called_too_narrow(fit, small, chains, monkeypatch):
    guide = small.posterior
    shrunk = replace(guide, scale_tril=0.3 * guide.scale_tril)
    narrow = replace(small, posterior=shrunk)
    monkeypatch.setattr(twin, "refit", lambda fit, records: narrow)
    found = dgp.check(fit, twin=40, **QUIET)
    sds = found["twin sites, sds"]
    assert sds.good is False
    assert sds.value == pytest.approx(1 / 0.3, rel=0.5)
    assert "too narrow" in sds.text
    assert "(good: up to 1.50)" in sds.text
    assert "twin sites, sds" in found.verdict
    assert str(found).count("twin") >= 5


def test_a_wrong_noise_spoils_predictions(fit, small, chains, monkeypatch):
    loud = replace(small, draws={**small.draws, "noise_sd": 2.0 * small.draws["noise_sd"]})
    monkeypatch.setattr(twin, "refit", lambda fit, records: loud)
    found = names(twin_findings(fit, 40))
    assert found["twin predictions, sds"].good is False
    assert "too wide" in found["twin predictions, sds"].text
    assert found["twin sites, sds"].good


def test_chains_that_differ_judge_nothing(fit, chains, posterior, monkeypatch):
    draws = {name: x.clone() for name, x in posterior.draws.items()}
    draws["noise_sd"][1] *= 3.0
    moved = replace(posterior, draws=draws)
    monkeypatch.setattr(twin, "sample_posterior", lambda *args, **options: moved)
    found = twin_findings(fit, 40)
    assert all(one.good is None for one in found)
    assert "nothing is judged by it" in found[0].text
    assert "1 not judged, on which NUTS's chains differ" in found[1].text


def test_with_nuts_itself(one_pair):
    """Several records, by a mode: the first share of each; too few draws to judge by."""
    records = [simulate_record(one_pair, 0.1, n=n, seed=n) for n in (20, 40)]
    model = dgp.LinearDynamicGP(inputs=1, pairs=1, process_noise=False)
    fit = dgp.fit(model, records, restarts=1, steps=20, **QUIET, method="map")
    found = twin_findings(fit, 24, effort=Effort(2, 4, 2), workers=1)
    assert found[0].text.startswith("Laplace's approximation (predictions: the mode) against 2 x 4")
    assert "root mean square over 24" in found[-1].text


def test_gaps_of_known_size():
    """Logarithms of a scale: NUTS's ~ N(0, 1), ours ~ N(1, 0.5)."""

    def model():
        pyro.sample("scale", pyro.distributions.LogNormal(torch.zeros(2).double(), 1.0).to_event(1))

    z = torch.randn(2, 4000, 2, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    chains = Chains({"scale": z.exp()}, {}, {}, 0)
    potential = Potential(model, (), {"scale": torch.ones(2).double()})
    own = {"scale": (1.0 + 0.5 * z.reshape(-1, 2)).exp()}
    gap, left = _sites(potential, own, chains)
    assert gap.names == ("scale[0]", "scale[1]")
    assert left == 0
    np.testing.assert_allclose(gap.mean, 1.0, atol=0.05)
    np.testing.assert_allclose(gap.ratio, 0.5, rtol=1e-6)


def test_words_and_limits():
    gap = Gap(("a", "b"), np.array([0.1, -0.5004]), np.array([1.2, 0.0]))
    mean, sd = _judged("sites", gap, np.max, 0.5, 1.5, True, "")
    assert mean.good is False
    assert "off by 0.5004 of NUTS's sds, largest of 2 (good: up to 0.5000); worst: b" in mean.text
    assert sd.good is False
    assert "1 kept at the optimum, without any spread" in sd.text
    mean, sd = _judged("predictions", gap, _rms, 0.5, 1.5, False, "; x")
    assert mean.good is sd.good is None
    assert mean.value == pytest.approx(np.sqrt((0.1**2 + 0.5004**2) / 2))
    (none,) = _judged(
        "sites", Gap((), np.empty(0), np.empty(0)), np.max, 0.5, 1.5, True, "; 3 left"
    )
    assert none.good is None


def test_what_is_refused(fit):
    with pytest.raises(ValueError, match="fit: expected a fit whose trajectories are integrated"):
        dgp.check(
            replace(fit, posterior=Sampled(fit.draws, "svi", log_q_sites={"g": torch.zeros(3)})),
            twin=40,
            **QUIET,
        )
    with pytest.raises(ValueError, match="twin: expected False for a fit by NUTS"):
        dgp.check(replace(fit, posterior=Sampled(fit.draws)), twin=40, **QUIET)
    for wrong in (True, 5, 61, 30.0):
        with pytest.raises(ValueError, match="twin: expected False, or a number of samples from 2"):
            dgp.check(fit, twin=wrong, **QUIET)
