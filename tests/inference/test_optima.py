"""A posterior around several optima: weights, draws, density."""

import math
from types import SimpleNamespace

import numpy as np
import pyro
import pyro.distributions as dist
import pytest
import torch

import pyro_dynogp as dgp
from pyro_dynogp.inference.density import Potential, spread
from pyro_dynogp.inference.methods.optima import LEAST_WEIGHT, MOST_OPTIMA, _weighted
from pyro_dynogp.inference.optimise.optimum import Optimum
from pyro_dynogp.inference.posteriors import Mixture
from pyro_dynogp.inference.run import Run
from tests.inference.cascades import FAST, wiener


@pytest.fixture(scope="module")
def several(bent):
    options = {**FAST, "restarts": 8, "steps": 60, "draws": 400}
    return dgp.fit(wiener(), bent, **options)


def test_consists_of_distinct_optima_by_weight(several):
    posterior = several.posterior
    assert isinstance(posterior, Mixture)
    K = len(posterior.weights)
    assert 2 <= K <= MOST_OPTIMA
    assert several.diagnostics["optima"] == K
    assert float(posterior.weights.sum()) == pytest.approx(1.0)
    assert (posterior.weights.diff() <= 0).all()  # the best first
    decays = posterior.points["g_log_decay"]
    assert len({tuple(row.tolist()) for row in decays}) == K
    assert torch.equal(several.mode["g_log_decay"], decays[0])
    assert several.diagnostics["elbo"] == pytest.approx(several.elbo[-50:].mean())


def test_a_needle_does_not_lead_because_it_is_high():
    shares = torch.tensor([0.02, 0.28, 0.7]).double()
    centres, widths = torch.tensor([-2.0, 2.0, 0.0]).double(), torch.tensor([1e-3, 0.2, 0.2])

    def hills(record):
        x = pyro.sample("x", dist.Normal(torch.tensor(0.0).double(), 100.0))
        each = dist.Normal(centres, widths.double()).log_prob(x.unsqueeze(-1))
        pyro.factor("hills", torch.logsumexp(shares.log() + each, -1))

    optima = []
    for centre in centres:
        values = {"x": centre}
        energy = -float(Potential(hills, (None,), values).log_joint(values))
        optima.append(Optimum(energy, values, np.zeros(1), ""))
    optima.sort(key=lambda one: one.energy)
    assert float(optima[0].values["x"]) == -2.0  # the needle is the highest
    problem = SimpleNamespace(target=hills, records=None)
    leading, weights = _weighted(problem, optima, Run(workers=1))
    tempered = (shares ** (1.0 / spread(optima[0].values))).sort(descending=True).values
    kept = tempered[tempered / tempered.sum() >= LEAST_WEIGHT]
    assert [float(values["x"]) for values in leading] == [0.0, 2.0]
    assert weights.numpy() == pytest.approx((kept / kept.sum()).numpy(), abs=0.01)
    alone, one = _weighted(problem, optima[:1], Run(workers=1))
    assert (len(alone), one.tolist()) == (1, [1.0])


def test_draws_come_from_each_optimum_in_its_share(several):
    posterior = several.posterior
    drawn = several.draws["g_log_decay"]
    for point, weight in zip(posterior.points["g_log_decay"], posterior.weights, strict=True):
        share = float((drawn == point).all(-1).double().mean())
        w = float(weight)
        assert share == pytest.approx(w, abs=4 * math.sqrt(w * (1 - w) / len(drawn)) + 1e-9)


def test_sites_of_one_draw_belong_to_one_optimum(several):
    """Points and inducing values are drawn together: each draw's values suit its function."""
    posterior = several.posterior
    with torch.no_grad(), pyro.plate("draws", 2000, dim=-1):
        trace = pyro.poutine.trace(posterior).get_trace()
    chosen = trace.nodes["_optimum"]["value"]
    values = trace.nodes["f_values"]["value"].reshape(2000, -1)
    for k in range(len(posterior.weights)):
        here = values[chosen == k]
        if len(here) < 50:
            continue
        M = here.shape[-1]
        mean, root = posterior.loc[k], posterior.scale_tril[k]
        first = 0 if posterior.sites[0].name == "f_values" else posterior.sites[0].shape.numel()
        sd = (root @ root.mT).diagonal().sqrt()[first : first + M]
        z = (here.mean(0) - mean[first : first + M]) / (sd / math.sqrt(len(here)))
        assert float(z.abs().max()) < 5.0
        chosen_points = trace.nodes["g_log_decay"]["value"][chosen == k]
        assert torch.equal(chosen_points[0], posterior.points["g_log_decay"][k])


def test_density_of_a_draw_is_the_component_s(several):
    posterior = several.posterior
    with torch.random.fork_rng():
        torch.manual_seed(1)
        trace = pyro.poutine.trace(posterior).get_trace()
    k = trace.nodes["_optimum"]["value"]
    with torch.random.fork_rng():
        torch.manual_seed(1)
        z = trace.nodes["_latent"]["value"]
    expected = (
        torch.distributions.MultivariateNormal(
            posterior.loc[k], scale_tril=posterior.scale_tril[k]
        ).log_prob(z)
        + posterior.weights[k].log()
    )
    assert float(trace.log_prob_sum()) == pytest.approx(float(expected))


def test_spread_is_that_of_log_densities_of_a_normal():
    values = {"a": torch.zeros(3, 4), "b": torch.zeros(6)}
    x = np.random.default_rng(0).standard_normal((20000, 18))
    assert spread(values) == pytest.approx((-0.5 * (x**2).sum(1)).std(), rel=0.03)


def test_saved_and_loaded_with_all_optima(several, tmp_path, bent):
    several.save(tmp_path / "fit")
    again = dgp.load(tmp_path / "fit")
    assert torch.equal(again.posterior.weights, several.posterior.weights)
    assert torch.equal(again.posterior.scale_tril, several.posterior.scale_tril)
    assert again.posterior.points.keys() == several.posterior.points.keys()
    assert np.array_equal(several.simulate(bent).mean, again.simulate(bent).mean)


def total(guide, *args, count=7):
    """Draws (count, ...) of a guide with the trace's own log density (count,) of all sites."""
    with torch.random.fork_rng(), torch.no_grad(), pyro.plate("draws", count, dim=-1):
        torch.manual_seed(4)
        trace = pyro.poutine.trace(guide).get_trace(*args)
    trace.compute_log_prob()
    sites = {n: s for n, s in trace.nodes.items() if s["type"] == "sample" and n != "draws"}
    own = {n: s["value"] for n, s in sites.items() if not s["infer"].get("is_auxiliary")}
    return own, sum(site["log_prob"] for site in sites.values())


def test_log_prob_of_draws_is_that_of_the_trace(several):
    draws, expected = total(several.posterior)
    torch.testing.assert_close(several.posterior.log_prob(draws), expected, rtol=1e-10, atol=1e-8)
    with pytest.raises(ValueError, match="none of its optima"):
        several.posterior.component({**draws, "g_log_decay": draws["g_log_decay"] + 1.0})


def test_log_prob_of_a_single_normal(svi_fit):
    draws, expected = total(svi_fit.posterior)
    torch.testing.assert_close(svi_fit.posterior.log_prob(draws), expected, rtol=1e-10, atol=1e-8)


def test_log_density_of_every_site_is_kept_with_trajectories(layered_fit):
    """Of single draws: the mean of log q of a parameter is its entropy with the sign changed."""
    names = set(layered_fit.draws) | set(layered_fit.trajectories)
    assert names <= set(layered_fit.log_q_sites)
    count = len(layered_fit.draws["noise_sd"])
    assert all(v.shape == (count,) for v in layered_fit.log_q_sites.values())
    noise = layered_fit.draws["noise_sd"][:, 0].log()
    # Normal on the log scale: log q is quadratic in log(noise_sd), but for the Jacobian.
    z = (layered_fit.log_q_sites["noise_sd"] + noise).numpy()
    fitted = np.polynomial.Polynomial.fit(noise.numpy(), z, 2)
    np.testing.assert_allclose(fitted(noise.numpy()), z, atol=1e-8)
    assert fitted.convert().coef[2] < 0
