"""Each family on its own: what it learns, what it can represent, what it refuses."""

import warnings

import numpy as np
import pyro
import pyro.distributions as dist
import pytest
import torch
from pyro import poutine
from pyro.infer import SVI, Trace_ELBO, TraceMeanField_ELBO
from pyro.optim import ClippedAdam
from torch.distributions import MultivariateNormal, kl_divergence

from pyro_dynogp.guides import (
    FullRank,
    GaussMarkov,
    InducingTimes,
    LayerGuide,
    MeanField,
    Point,
    SameAsPrior,
)
from pyro_dynogp.guides.normal import FlatNormal
from tests.guides.models import DATA, LATENT, NOISE, Trajectory, real, users_model
from tests.lti.oracles import assert_close

FAMILIES = [Point(), MeanField(), FullRank(), SameAsPrior()]
CONTINUOUS = [MeanField(init_scale=0.4), FullRank(init_scale=0.4)]


@pytest.fixture(autouse=True)
def fresh():
    pyro.set_rng_seed(0)
    with pyro.get_param_store().scope(), pyro.validation_enabled(True), warnings.catch_warnings():
        warnings.simplefilter("error")
        yield


def batch(elbo, particles):
    return elbo(num_particles=particles, vectorize_particles=True, max_plate_nesting=0)


def train(model, guide, *args, steps, lr=0.1, particles=16, decay=0.02):
    optimiser = ClippedAdam({"lr": lr, "lrd": decay ** (1.0 / steps), "clip_norm": 1e3})
    svi = SVI(model, guide.single_pass(), optimiser, batch(TraceMeanField_ELBO, particles))
    return [svi.step(*args) for _ in range(steps)]


class TestUsersModel:
    @pytest.mark.parametrize("family", FAMILIES)
    @pytest.mark.parametrize("elbo", [Trace_ELBO, TraceMeanField_ELBO])
    @pytest.mark.parametrize("particles", [1, 3])
    def test_one_family_for_all_sites(self, family, elbo, particles):
        guide = LayerGuide(users_model, default=family)
        loss = elbo(num_particles=particles, vectorize_particles=particles > 1, max_plate_nesting=0)
        svi = SVI(users_model, guide, ClippedAdam({"lr": 0.01}), loss)
        for _ in range(3):
            assert np.isfinite(svi.step(DATA))
        values = guide(DATA)
        assert list(values) == LATENT
        assert values["share"].shape == (2,)
        assert values["matrix"].shape == (2, 3)
        for x in pyro.get_param_store().values():
            assert x.dtype == torch.float64
            assert x.isfinite().all()

    @pytest.mark.parametrize("family", FAMILIES)
    def test_values_are_in_the_support(self, family):
        guide = LayerGuide(users_model, default=family)
        with pyro.plate("draws", 500, dim=-1):
            trace = poutine.trace(guide).get_trace(DATA)
        model = poutine.trace(poutine.replay(users_model, trace=trace)).get_trace(DATA)
        for name in LATENT:
            fn, value = model.nodes[name]["fn"], trace.nodes[name]["value"]
            assert fn.support.check(value).all()
            assert fn.log_prob(value).isfinite().all()

    @pytest.mark.parametrize("family", CONTINUOUS)
    @pytest.mark.parametrize("prior", ["positive", "interval", "real"])
    def test_density_integrates_to_one(self, family, prior):
        fn, low, high = {
            "positive": (dist.HalfCauchy(real(1.0)), 0.0, 20.0),
            "interval": (dist.Uniform(real(-1.0), real(3.0)), -1.0, 3.0),
            "real": (dist.Cauchy(real(0.0), real(1.0)), -8.0, 8.0),
        }[prior]
        q = family.posterior("x", fn)
        edges = torch.linspace(low, high, 200_001, dtype=torch.float64)
        x = 0.5 * (edges[1:] + edges[:-1])
        density = q.log_prob(x).exp()
        assert density.mean().item() * (high - low) == pytest.approx(1.0, abs=1e-6)
        draws = q.sample((40_000,))
        mean = (density * x).mean().item() * (high - low)
        assert draws.mean().item() == pytest.approx(mean, abs=5 * draws.std().item() / 200)

    @pytest.mark.parametrize("family", CONTINUOUS)
    def test_analytic_divergences_are_those_of_draws(self, family):
        # Whatever TraceMeanField_ELBO finds in closed form, draws must agree with.
        guide = LayerGuide(users_model, default=family)
        guide(DATA)
        losses = {}
        for elbo in (Trace_ELBO, TraceMeanField_ELBO):
            many = batch(elbo, 1000)
            losses[elbo] = np.array([many.loss(users_model, guide, DATA) for _ in range(10)])
        means = [x.mean() for x in losses.values()]
        error = np.sqrt(sum(x.var() / len(x) for x in losses.values()))
        assert means[0] == pytest.approx(means[1], abs=4.5 * error)
        assert error < 0.3

    def test_support_that_another_site_sets(self):
        # The first call of all is one of particles: parameters belong to the site alone.
        guide = LayerGuide(users_model, default=FullRank())
        batch(TraceMeanField_ELBO, 5).loss(users_model, guide, DATA)
        store = pyro.get_param_store()
        assert store["top.loc"].shape == (1,)
        assert store["matrix.scale_tril"].shape == (6, 6)


def conjugate(y=None):
    """Posterior N(0.4, 0.2) of x, and its image under exp as that of a positive site."""
    x = pyro.sample("x", dist.Normal(real([0.0, 0.0]), 1.0).to_event(1))
    pyro.sample("y", dist.Normal(x, 0.5).to_event(1), obs=real([0.5, 0.5]))


def conjugate_positive(y=None):
    z = pyro.sample("z", dist.LogNormal(real(0.0), real(1.0)))
    pyro.sample("y", dist.Normal(z.log(), 0.5), obs=real(0.5))


class TestLearning:
    def test_point_is_the_mode(self):
        guide = LayerGuide(conjugate_positive, default=Point(init=1.3))
        assert guide()["z"].item() == pytest.approx(1.3)
        train(conjugate_positive, guide, steps=200, particles=1)
        # Mode of the density of z itself: log z - shift of -0.2, the variance of log z.
        assert guide()["z"].item() == pytest.approx(np.exp(0.4 - 0.2), rel=1e-3)

    @pytest.mark.parametrize("family", [MeanField(init_scale=0.3), FullRank(init_scale=0.3)])
    @pytest.mark.parametrize("model", [conjugate, conjugate_positive])
    def test_normal_families_find_normal_posteriors(self, family, model):
        guide = LayerGuide(model, default=family)
        train(model, guide, steps=300)
        name = "x" if model is conjugate else "z"
        store = pyro.get_param_store()
        assert_close(store[f"{name}.loc"], torch.full_like(store[f"{name}.loc"], 0.4), rtol=0.06)
        expected = torch.full_like(store[f"{name}.scale"], 0.2**0.5)
        assert_close(store[f"{name}.scale"], expected, rtol=0.06)

    def test_full_rank_finds_correlations(self):
        def model():
            x = pyro.sample("x", dist.Normal(torch.zeros(2).double(), 1.0).to_event(1))
            pyro.sample("y", dist.Normal(x.sum(-1), 0.3), obs=real(1.0))

        guide = LayerGuide(model, default=FullRank(init_scale=0.5))
        train(model, guide, steps=400)
        precision = torch.eye(2).double() + torch.ones(2, 2).double() / 0.09
        covariance = torch.linalg.inv(precision)
        q = FullRank(init_scale=0.5).posterior("x", dist.Normal(torch.zeros(2), 1.0).to_event(1))
        assert_close(q.base_dist.loc, covariance.sum(-1) / 0.09, rtol=0.03)
        assert_close(q.base_dist.covariance_matrix, covariance, rtol=0.12)


class TestFlatNormal:
    def make(self, batch=()):
        loc = torch.randn(*batch, 6).double()
        root = torch.randn(*batch, 6, 6).double().tril(-1) + torch.diag(torch.rand(6).double() + 1)
        reshape = torch.distributions.ReshapeTransform(torch.Size([6]), torch.Size([2, 3]))
        return FlatNormal(dist.MultivariateNormal(loc, scale_tril=root), [reshape])

    @pytest.mark.parametrize("batch", [(), (4,)])
    def test_divergence(self, batch):
        q = self.make(batch)
        mean, sd = torch.randn(2, 3).double(), torch.rand(2, 3).double() + 0.5
        p = dist.Normal(mean, sd).to_event(2).expand(batch)
        P = MultivariateNormal(mean.reshape(6), torch.diag(sd.reshape(6).square()))
        expected = kl_divergence(q.base_dist, P.expand(batch))
        assert_close(kl_divergence(q, p), expected)
        wide = (*batch[:0], 5, *batch)
        assert_close(kl_divergence(q.expand(wide), p.expand(wide)), expected.expand(wide))

    def test_other_distributions(self):
        with pytest.raises(NotImplementedError):
            kl_divergence(self.make(), dist.StudentT(3.0, torch.zeros(2, 3)).to_event(2))


@pytest.mark.parametrize("missing", [False, True])
@pytest.mark.parametrize("outputs", [None, 2])
class TestGaussMarkov:
    def exact(self, outputs, missing, jitter=1e-9, **kw):
        """A guide whose pseudo-observations are the data: the exact posterior."""
        model = Trajectory(outputs=outputs, missing=missing, jitter=jitter)
        there = ~torch.isnan(model.y)
        y = torch.where(there, model.y, 0.0)
        sd = torch.where(there, NOISE, 1e6)  # as good as missing
        return model, LayerGuide(model, {"h": GaussMarkov(init_mean=y, init_sd=sd)})

    def test_every_particle_is_the_evidence(self, outputs, missing):
        # The exact posterior leaves the ELBO no variance at all.
        model, guide = self.exact(outputs, missing)
        evidence = model.prior().observed(NOISE).log_prob(model.y).item()
        for _ in range(5):
            # To 1e-6: the site has the jitter, 1e-9 of its variance.
            assert Trace_ELBO().loss(model, guide) == pytest.approx(-evidence, rel=1e-6)
        assert batch(Trace_ELBO, 7).loss(model, guide) == pytest.approx(-evidence, rel=1e-6)

    def test_divergence_and_expected_likelihood(self, outputs, missing):
        model, guide = self.exact(outputs, missing)
        q = poutine.trace(guide).get_trace().nodes["h"]["fn"]
        there = ~torch.isnan(model.y)
        y = torch.where(there, model.y, 0.0)
        squares = ((y - q.mean).square() + q.variance) / NOISE**2
        expected = -0.5 * ((squares + np.log(2 * np.pi * NOISE**2)) * there).sum()
        elbo = expected - kl_divergence(q, q.prior)
        evidence = model.prior().observed(NOISE).log_prob(model.y).item()
        assert elbo.item() == pytest.approx(evidence, rel=1e-6)
        many = batch(TraceMeanField_ELBO, 100)
        error = [-many.loss(model, guide) - evidence for _ in range(30)]
        assert abs(np.mean(error)) < 4.5 * np.std(error) / 30**0.5


@pytest.mark.parametrize(
    ("family", "rate", "tolerance", "outputs", "missing"),
    [
        (GaussMarkov(), 0.2, 1.0, None, False),
        (GaussMarkov(), 0.2, 1.0, 2, True),
        (InducingTimes(12), 0.1, 2.0, None, False),
    ],
)
def test_learns_the_exact_posterior_from_a_poor_start(family, rate, tolerance, outputs, missing):
    # From off the prior's mean: the data lie about ten of their posterior deviations away.
    model = Trajectory(outputs=outputs, missing=missing)
    guide = LayerGuide(model, {"h": family}, values={"h": model.prior().mean - 1.0})
    exact = model.exact()
    sd = exact.variance.sqrt()

    def errors():
        q = poutine.trace(guide).get_trace().nodes["h"]["fn"]
        mean = ((q.mean - exact.mean) / sd).abs().max().item()
        return mean, (q.variance.sqrt() / sd - 1.0).abs().max().item()

    assert errors()[0] > 5.0
    train(model, guide, steps=400, lr=rate)
    mean, spread = errors()
    assert mean < 0.15 * tolerance
    assert spread < 0.1 * tolerance
    evidence = model.prior().observed(NOISE).log_prob(model.y).item()
    last = -batch(Trace_ELBO, 1000).loss(model, guide)
    assert evidence - 0.15 * tolerance**2 < last < evidence + 0.1


class TestInducingTimes:
    def test_starts_at_a_trajectory(self):
        model = Trajectory(outputs=2, start="gaussian")
        path = model.exact().mean.detach()
        guide = LayerGuide(model, {"h": InducingTimes(5, seed=1)}, values={"h": path})
        q = poutine.trace(guide).get_trace().nodes["h"]["fn"]
        assert_close(q.mean[q.index], path[q.index], rtol=1e-7)
        guide = LayerGuide(model, {"h": InducingTimes(5, seed=1)})
        with pyro.get_param_store().scope():
            q = poutine.trace(guide).get_trace().nodes["h"]["fn"]
        assert q.loc.abs().max() < 1e-9  # the prior's mean


class TestErrors:
    @pytest.mark.parametrize("family", [GaussMarkov(), InducingTimes(3)])
    def test_site_that_is_no_trajectory(self, family):
        guide = LayerGuide(users_model, {"share": family})
        with pytest.raises(ValueError, match=rf"{type(family).__name__}.*'share'.*LTIProcess"):
            guide(DATA)

    def test_discrete_site(self):
        def model():
            pyro.sample("kind", dist.Bernoulli(0.3))

        with pytest.raises(ValueError, match=r"'kind'.*continuous.*Bernoulli.*SameAsPrior"):
            LayerGuide(model)()
        assert LayerGuide(model, {"kind": SameAsPrior()})()["kind"].item() in (0.0, 1.0)

    def test_scales(self):
        for family, scale in ((MeanField, 0.0), (FullRank, -1.0)):
            with pytest.raises(ValueError, match=r"init_scale.*> 0"):
                family(init_scale=scale)
        with pytest.raises(ValueError, match=r"init_sd.*> 0"):
            LayerGuide(Trajectory(), default=GaussMarkov(init_sd=0.0))()

    def test_too_many_inducing_times(self):
        with pytest.raises(ValueError, match=r"count.*1 to 12.*13"):
            LayerGuide(Trajectory(), default=InducingTimes(13))()
