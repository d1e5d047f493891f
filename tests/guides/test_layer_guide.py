"""LayerGuide as a Pyro guide: traces, particles, scopes, joint sites, plates, errors."""

import warnings
from dataclasses import dataclass

import numpy as np
import pyro
import pyro.distributions as dist
import pytest
import torch
from pyro import poutine
from pyro.infer import SVI, Predictive, Trace_ELBO, TraceMeanField_ELBO
from pyro.infer.autoguide import AutoMultivariateNormal
from pyro.optim import Adam
from torch.distributions import MultivariateNormal, SigmoidTransform, biject_to

from pyro_dynogp.guides import (
    Family,
    FullRank,
    GaussMarkov,
    InducingTimes,
    LayerGuide,
    MeanField,
    Point,
    SameAsPrior,
)
from tests.distributions import models
from tests.distributions.models import N, data, inputs
from tests.guides.models import DATA, LATENT, real, users_model
from tests.lti.oracles import assert_close

HYPER = ["decay", "gain", "noise", "sigma"]
TRAJECTORY = [GaussMarkov(), InducingTimes(5), MeanField(), FullRank(), SameAsPrior(), Point()]
ELBOS = [Trace_ELBO, TraceMeanField_ELBO]


@pytest.fixture(autouse=True)
def fresh():
    pyro.set_rng_seed(0)
    with pyro.get_param_store().scope(), pyro.validation_enabled(True), warnings.catch_warnings():
        warnings.simplefilter("error")
        yield


def gradients(model, guide, elbo, *args, seed=1):
    """Loss and gradient of every parameter."""
    store = pyro.get_param_store()
    for _, x in store.named_parameters():
        x.grad = None
    pyro.set_rng_seed(seed)
    loss = elbo.loss_and_grads(model, guide, *args)
    return loss, {name: x.grad.clone() for name, x in store.named_parameters()}


def assert_same(one, other):
    assert one[0] == pytest.approx(other[0], rel=1e-9)
    assert set(one[1]) == set(other[1])
    for name, x in one[1].items():
        assert_close(x + 1e-3, other[1][name] + 1e-3, rtol=1e-6)  # some gradients are zero


class TestTraces:
    def test_only_latent_sites_are_seen(self):
        guide = LayerGuide(users_model)
        trace = poutine.trace(guide).get_trace(DATA)
        assert [n for n, s in trace.nodes.items() if s["type"] == "sample"] == LATENT
        total = sum(s["fn"].log_prob(s["value"]) for s in map(trace.nodes.get, LATENT))
        assert trace.log_prob_sum().item() == pytest.approx(total.item())

    def test_data_stay_data_in_calls_without(self):
        guide = LayerGuide(users_model, default=MeanField())
        guide(DATA)
        before = set(pyro.get_param_store())
        assert list(guide()) == LATENT
        assert set(pyro.get_param_store()) == before
        named = LayerGuide(users_model, observed=["y"])
        assert list(named()) == LATENT

    @pytest.mark.parametrize("parallel", [False, True])
    @pytest.mark.parametrize("joint", [(), True])
    def test_predictive(self, parallel, joint):
        guide = LayerGuide(models.latent, joint=joint)
        guide(inputs(), data())
        draws = Predictive(models.latent, guide=guide, num_samples=6, parallel=parallel)(inputs())
        assert set(draws) >= {*HYPER, "g", "y"}
        assert draws["g"].shape == draws["y"].shape == (6, N)
        assert len(torch.unique(draws["sigma"])) == 6

    def test_conditioned_model(self):
        # A site that the model already knows is no business of the guide.
        model = poutine.condition(models.latent, {"sigma": torch.tensor(0.5).double()})
        assert "sigma" not in LayerGuide(model)(inputs(), data())

    def test_families_see_the_prior_given_what_was_drawn(self):
        seen = {}

        @dataclass(frozen=True)
        class Spy(Family):
            def posterior(self, name, prior):
                seen["prior"] = prior
                return prior.condition(data(), 0.5)

        values = LayerGuide(models.latent, {"g": Spy()})(inputs(), data())
        poles = seen["prior"].modes.poles
        assert_close(-poles.real, values["decay"])

    def test_default_chooses_by_name_and_prior(self):
        def choose(name, prior):
            return Point() if prior.event_dim == 0 else MeanField()

        guide = LayerGuide(models.latent, default=choose)
        guide(inputs(), data())
        kinds = {name: type(f) for name, f in guide.families.items()}
        assert kinds["sigma"] is kinds["noise"] is Point
        assert kinds["decay"] is kinds["g"] is MeanField

    def test_starting_values(self):
        values = {"decay": torch.tensor([0.3, 0.9]), "g": np.linspace(0, 1, N)}
        guide = LayerGuide(models.latent, {"decay": Point()}, values=values)
        drawn = guide(inputs(), data())
        assert_close(drawn["decay"], values["decay"].double())
        assert drawn["decay"].dtype == torch.float64
        assert_close(pyro.param("g.pseudo_outputs"), values["g"])
        assert_close(pyro.param("sigma.loc"), np.log(0.5) + 0.125)  # the log of the prior's mean


class TestElbo:
    @pytest.mark.parametrize("elbo", ELBOS)
    @pytest.mark.parametrize("family", TRAJECTORY)
    @pytest.mark.parametrize("joint", [(), True])
    def test_single_pass_is_the_same_elbo(self, elbo, family, joint):
        given = {} if isinstance(family, GaussMarkov) else {"g": family}
        guide = LayerGuide(models.latent, given, joint=joint)
        args = inputs(), data()
        guide(*args)
        for particles in (1, 3):
            loss = elbo(
                num_particles=particles, vectorize_particles=particles > 1, max_plate_nesting=0
            )
            two = gradients(models.latent, guide, loss, *args)
            assert_same(two, gradients(models.latent, guide.single_pass(), loss, *args))
            assert any(g.abs().max() > 0 for g in two[1].values())

    @pytest.mark.parametrize("family", [GaussMarkov(), InducingTimes(5)])
    @pytest.mark.parametrize("elbo", ELBOS)
    def test_the_first_gradient_is_like_the_second(self, elbo, family):
        # Starting values are found on the way; they must not cut the graph of the prior.
        guide = LayerGuide(models.latent, {"g": family})
        args = inputs(), data()
        guide.prepare(*args)
        first = gradients(models.latent, guide, elbo(), *args)
        assert_same(first, gradients(models.latent, guide, elbo(), *args))

    @pytest.mark.parametrize("elbo", ELBOS)
    @pytest.mark.parametrize("family", [GaussMarkov(), InducingTimes(5), SameAsPrior()])
    def test_particles_in_a_batch_are_particles_in_a_loop(self, elbo, family):
        guide = LayerGuide(models.latent, {"g": family}, joint=HYPER[:2])
        args = inputs(), data()
        guide(*args)
        loop = np.array([elbo().loss(models.latent, guide, *args) for _ in range(80)])
        batch = elbo(num_particles=50, vectorize_particles=True, max_plate_nesting=0)
        together = np.array([batch.loss(models.latent, guide, *args) for _ in range(30)])
        error = np.sqrt(loop.var() / len(loop) + together.var() / len(together))
        assert loop.mean() == pytest.approx(together.mean(), abs=4.5 * error)
        # One particle of fifty has a fiftieth of the variance: they are independent.
        assert 0.3 < 50 * together.var() / loop.var() < 3.0

    @pytest.mark.parametrize("joint", [(), HYPER, True])
    @pytest.mark.parametrize("family", [GaussMarkov(), InducingTimes(5)])
    def test_closed_form_divergence_is_that_of_draws(self, family, joint):
        guide = LayerGuide(models.latent, {"g": family}, joint=joint, joint_scale=0.3)
        args = inputs(), data()
        guide(*args)
        losses = []
        for elbo in ELBOS:
            batch = elbo(num_particles=2000, vectorize_particles=True, max_plate_nesting=0)
            losses.append([batch.loss(models.latent, guide, *args) for _ in range(5)])
        error = np.sqrt(sum(np.var(x, ddof=1) / 5 for x in losses))
        assert np.mean(losses[0]) == pytest.approx(np.mean(losses[1]), abs=5 * error)
        assert error < 1.0

    def test_the_closed_form_is_used(self, monkeypatch):
        # The prior is computed twice, in guide and model, and recognised as one.
        from pyro_dynogp.distributions import divergence

        verdicts = []

        def spy(a, b, same=divergence.same_process):
            verdicts.append(same(a, b))
            return verdicts[-1]

        monkeypatch.setattr(divergence, "same_process", spy)
        for family in (GaussMarkov(), InducingTimes(5)):
            for joint in ((), True):
                with pyro.get_param_store().scope():
                    guide = LayerGuide(models.latent, {"g": family}, joint=joint)
                    batch = TraceMeanField_ELBO(
                        num_particles=2, vectorize_particles=True, max_plate_nesting=0
                    )
                    batch.loss(models.latent, guide, inputs(), data())
                    TraceMeanField_ELBO().loss(models.latent, guide, inputs(), data())
        assert verdicts == [True] * 8

    def test_factors_and_handlers_of_the_model_count_once(self):
        guide = LayerGuide(users_model, default=Point())
        guide(DATA)
        trace = poutine.trace(poutine.condition(users_model, guide(DATA))).get_trace(DATA)
        expected = -trace.log_prob_sum().item()
        for g in (guide, guide.single_pass()):
            for elbo in ELBOS:
                assert elbo().loss(users_model, g, DATA) == pytest.approx(expected, rel=1e-12)
        scaled = poutine.scale(users_model, scale=0.1)
        small = LayerGuide(scaled, default=Point())
        for g in (small, small.single_pass()):
            assert Trace_ELBO().loss(scaled, g, DATA) == pytest.approx(0.1 * expected, rel=1e-12)


class TestJoint:
    def posterior(self):
        store = pyro.get_param_store()
        root = store["_joint.scale"].unsqueeze(-1) * store["_joint.scale_tril"]
        return MultivariateNormal(store["_joint.loc"], scale_tril=root)

    def randomise(self):
        store = pyro.get_param_store()
        d = len(store["_joint.loc"])
        store["_joint.loc"] = 0.3 * torch.randn(d).double()
        store["_joint.scale"] = 0.2 + torch.rand(d).double()
        store["_joint.scale_tril"] = torch.eye(d).double() + torch.randn(d, d).double().tril(-1)

    def test_density_with_its_jacobian(self):
        guide = LayerGuide(users_model, joint=True)
        guide(DATA)
        self.randomise()
        trace = poutine.trace(guide).get_trace(DATA)
        z = trace.nodes["_joint"]["value"]
        model = poutine.trace(poutine.replay(users_model, trace=trace)).get_trace(DATA)
        expected, parts = self.posterior().log_prob(z), []
        for name in LATENT:
            transform = biject_to(model.nodes[name]["fn"].support)
            value = trace.nodes[name]["value"]
            x = transform.inv(value)
            parts.append(x.reshape(-1))
            expected = expected - transform.log_abs_det_jacobian(x, value).sum()
        assert_close(torch.cat(parts), z)
        assert trace.log_prob_sum().item() == pytest.approx(expected.item(), rel=1e-10)

    @pytest.mark.parametrize("elbo", ELBOS)
    def test_entropy(self, elbo):
        # Flat in unconstrained coordinates, a model leaves the ELBO nothing but the entropy there.
        def model():
            zero, wide = torch.zeros(2).double(), real(1e8)
            unit = dist.TransformedDistribution(dist.Normal(zero, wide), [SigmoidTransform()])
            pyro.sample("a", dist.Normal(zero, wide).to_event(1))
            pyro.sample("b", dist.LogNormal(zero, wide).to_event(1))
            pyro.sample("c", unit.to_event(1))

        start = {"b": torch.ones(2), "c": torch.full((2,), 0.5)}
        guide = LayerGuide(model, joint=True, values=start)
        guide()
        self.randomise()
        flat = 6 * (np.log(1e8) + 0.5 * np.log(2 * np.pi))
        entropy = self.posterior().entropy().item()
        batch = elbo(num_particles=4000, vectorize_particles=True, max_plate_nesting=0)
        elbos = [-batch.loss(model, guide) for _ in range(4)]
        assert np.mean(elbos) + flat == pytest.approx(entropy, abs=4.5 * np.sqrt(3.0 / 16000))

    def test_is_pyros_multivariate_normal(self):
        # But for the support of "top", which is another one for each draw: Pyro's guide ignores it.
        model = poutine.condition(users_model, {"top": real(0.1)})
        auto = AutoMultivariateNormal(model, init_scale=0.05)
        auto(DATA)
        guide = LayerGuide(model, joint=True)
        guide(DATA)
        self.randomise()
        q = self.posterior()
        auto.get_posterior = lambda *args: dist.MultivariateNormal(q.loc, scale_tril=q.scale_tril)
        traces = []
        for g in (guide, auto):
            pyro.set_rng_seed(3)
            traces.append(poutine.trace(g).get_trace(DATA))
        for name in LATENT:
            if name != "top":
                ours, theirs = (t.nodes[name]["value"] for t in traces)
                assert_close(ours, theirs)
        ours, theirs = (t.log_prob_sum().item() for t in traces)
        assert ours == pytest.approx(theirs, rel=1e-10)

    def test_named_sites_and_a_rule(self):
        for joint in (["decay", "sigma"], lambda name, prior: name in ("decay", "sigma")):
            with pyro.get_param_store().scope():
                guide = LayerGuide(models.latent, joint=joint)
                guide(inputs(), data())
                store = pyro.get_param_store()
                assert store["_joint.loc"].shape == (3,)
                assert {"gain.loc", "noise.loc", "g.pseudo_sd"} <= set(store)
                assert not {"decay.loc", "sigma.loc"} & set(store)


def test_scopes_keep_two_guides_apart():
    guides = [LayerGuide(models.latent), LayerGuide(models.latent, {"sigma": Point()})]
    args = inputs(), data()
    states = []
    for guide in guides:
        with pyro.get_param_store().scope() as state:
            SVI(models.latent, guide, Adam({"lr": 0.1}), Trace_ELBO()).step(*args)
        states.append(state)
    assert len(pyro.get_param_store()) == 0
    assert "sigma.loc" in states[0]["params"]
    assert "sigma.loc" not in states[1]["params"]
    first = states[0]["params"]["gain.loc"].detach().clone()
    with pyro.get_param_store().scope(states[1]):
        SVI(models.latent, guides[1], Adam({"lr": 0.1}), Trace_ELBO()).step(*args)
    with pyro.get_param_store().scope(states[0]):
        assert torch.equal(pyro.param("gain.loc"), first)
    # One guide in a new scope starts anew.
    with pyro.get_param_store().scope():
        guides[0](*args)
        assert not torch.equal(pyro.param("gain.loc"), first)


class TestPlates:
    @pytest.mark.parametrize("elbo", ELBOS)
    @pytest.mark.parametrize("family", TRAJECTORY)
    @pytest.mark.parametrize("joint", [(), HYPER, True])
    def test_records(self, elbo, family, joint):
        args = inputs(3), data(3)
        given = {} if joint is True and isinstance(family, Point) else {"g": family}
        guide = LayerGuide(models.latent_records, given, joint=joint)
        for particles in (1, 4):
            loss = elbo(
                num_particles=particles, vectorize_particles=particles > 1, max_plate_nesting=1
            )
            svi = SVI(models.latent_records, guide, Adam({"lr": 0.01}), loss)
            assert np.isfinite(svi.step(*args))
        shapes = {name: tuple(x.shape) for name, x in pyro.get_param_store().items()}
        for name, shape in shapes.items():
            if name.startswith("g."):
                assert shape[0] == 3

    @pytest.mark.parametrize("joint", [(), HYPER])
    def test_subsampled_records(self, joint):
        u, y = inputs(6), data(6)

        def model():
            modes, sigma = models.sample_system(), models.sample_sigma()
            with pyro.plate("records", 6, subsample_size=2, dim=-1) as index:
                g = pyro.sample("g", models.LTIProcess(modes, models.TIME, u[index], jitter=1e-6))
                noise = dist.Normal(g, sigma.unsqueeze(-1)).to_event(1)
                pyro.sample("y", noise, obs=y[index])
                model.index = index

        guide = LayerGuide(
            model, {"g": GaussMarkov(), "decay": Point()} if not joint else {}, joint=joint
        )
        guide()
        assert pyro.param("g.pseudo_outputs").shape == (6, N)
        pyro.get_param_store()["g.pseudo_outputs"] = (
            torch.arange(6.0).double()[:, None].expand(6, N)
        )
        trace = poutine.trace(guide).get_trace()
        q = trace.nodes["g"]["fn"]
        assert_close(q.y[:, 0], trace.nodes["records"]["value"].double())
        for g in (guide, guide.single_pass()):
            _, grads = gradients(model, g, Trace_ELBO(max_plate_nesting=1))
            touched = (grads["g.pseudo_outputs"] != 0).any(-1)
            assert touched.nonzero().flatten().tolist() == sorted(model.index.tolist())

    def test_joint_in_a_subsampled_plate(self):
        def model():
            with pyro.plate("many", 6, subsample_size=2):
                pyro.sample("x", dist.Normal(0.0, 1.0))

        with pytest.raises(ValueError, match=r"joint.*not subsampled.*'x'"):
            LayerGuide(model, joint=True)()


class TestErrors:
    @pytest.mark.parametrize(
        ("kw", "said"),
        [
            ({"families": {"decoy": Point()}}, r"families.*'decay'.*\['decoy'\]"),
            ({"families": {"y": Point()}}, r"families.*\['y'\]"),
            ({"values": {"decoy": 1.0}}, r"values.*'decay'.*\['decoy'\]"),
            ({"joint": ["decay", "decoy"]}, r"joint.*'decay'.*\['decoy'\]"),
            ({"values": {"g": torch.zeros(5)}}, r"'g'.*\(12,\).*\(5,\)"),
            ({"values": {"sigma": -1.0}}, r"'sigma'.*[Gg]reater"),
            ({"families": {"sigma": Point(init=-1.0)}}, "'sigma'"),
            ({"default": lambda name, prior: None}, "'decay'.*a Family.*None"),
            ({"values": {"g": torch.full((12,), torch.nan)}}, "'g'"),
        ],
    )
    def test_when_first_called(self, kw, said):
        guide = LayerGuide(models.latent, **kw)
        with pytest.raises(ValueError, match=said):
            guide(inputs(), data())

    def test_when_made(self):
        with pytest.raises(ValueError, match=r"'sigma'.*a Family.*Normal"):
            LayerGuide(models.latent, {"sigma": dist.Normal})
        with pytest.raises(ValueError, match=r"joint.*family.*\['decay'\]"):
            LayerGuide(models.latent, {"decay": Point()}, joint=["decay"])
        with pytest.raises(ValueError, match=r"joint.*several.*'decay'"):
            LayerGuide(models.latent, joint="decay")

    def test_start_on_a_boundary(self):
        guide = LayerGuide(users_model, values={"width": 0.0})
        with pytest.raises(ValueError, match=r"'width'"):
            guide(DATA)

    def test_start_that_is_no_number_in_coordinates(self):
        def model():
            pyro.sample("x", dist.HalfNormal(real(1.0)))

        with pytest.raises(ValueError, match=r"'x'.*inside"):
            LayerGuide(model, values={"x": 0.0})()

    def test_site_that_appears_later(self):
        def model(more):
            pyro.sample("a", dist.Normal(0.0, 1.0))
            if more:
                pyro.sample("b", dist.Normal(0.0, 1.0))

        guide = LayerGuide(model)
        guide(False)
        with pytest.raises(ValueError, match=r"'b'.*\['a'\].*new LayerGuide"):
            guide(True)

    def test_a_failed_first_call_leaves_nothing(self):
        def model(x):
            pyro.sample("a", dist.Normal(0.0, 1.0))
            if x is None:
                raise RuntimeError("no data")

        guide = LayerGuide(model)
        with pytest.raises(RuntimeError, match="no data"):
            guide(None)
        assert list(guide(1.0)) == ["a"]
