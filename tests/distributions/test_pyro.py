"""Trajectories as Pyro sites: shapes, plates, handlers, provenance and gradient estimators."""

import numpy as np
import pyro
import pyro.distributions as dist
import pytest
import torch
from pyro import poutine
from pyro.infer import SVI, Predictive, Trace_ELBO, TraceMeanField_ELBO
from pyro.infer.autoguide import AutoNormal
from pyro.infer.inspect import get_model_relations
from pyro.optim import Adam

from pyro_dynogp.distributions.process import LTIProcess
from pyro_dynogp.lti.modes import Modes
from pyro_dynogp.lti.state import ModalState
from tests.distributions import models
from tests.distributions.models import TIME, N, data, inputs
from tests.lti import oracles
from tests.lti.oracles import assert_close, random_system, tensor


@pytest.fixture(autouse=True)
def fresh():
    pyro.clear_param_store()
    pyro.set_rng_seed(0)
    with pyro.validation_enabled(True):
        yield


def process(modes, *args, **kwargs):
    """Over 5 irregular times; modes have two inputs."""
    return LTIProcess(modes, oracles.irregular_times(5), *args, **kwargs)


class TestShapes:
    @pytest.mark.parametrize("outputs", [None, 2])
    @pytest.mark.parametrize(
        ("modes_batch", "inputs_batch", "state_batch", "offset_batch", "expected"),
        [
            ((), (), (), (), ()),
            ((4,), (), (), (), (4,)),
            ((), (3,), (), (), (3,)),
            ((4, 1), (3,), (), (), (4, 3)),
            ((), (), (6,), (), (6,)),
            ((4, 1), (), (3,), (2, 1, 1), (2, 4, 3)),
        ],
    )
    def test_batch_and_event(
        self, modes_batch, inputs_batch, state_batch, offset_batch, expected, outputs
    ):
        modes = random_system(0, pairs=2, outputs=outputs).modes.expand(modes_batch)
        event = (5,) if outputs is None else (5, 2)
        state = ModalState(
            torch.zeros(*state_batch, 2, dtype=torch.complex128), torch.eye(4, dtype=torch.float64)
        )
        offset = torch.zeros((*offset_batch, *event[1:]), dtype=torch.float64)
        g = process(modes, torch.zeros(*inputs_batch, 5, 2), state, offset=offset)
        for d in (g, g.observed(0.1)):
            assert d.batch_shape == expected
            assert d.event_shape == event
            assert d.shape() == expected + event
            x = d.sample((7,))
            assert x.shape == (7, *expected, *event)
            assert x.dtype == torch.float64
            assert d.log_prob(x).shape == (7, *expected)
            assert d.mean.shape == d.variance.shape == expected + event

    def test_noise_widens_the_batch(self):
        g = process(random_system(0).modes, torch.zeros(5, 2))
        assert g.observed(torch.full((3, 1), 0.1)).batch_shape == (3, 1)
        varying = g.observed(torch.full((3, 5), 0.1), varying=True)
        assert (varying.batch_shape, varying.event_shape) == ((3,), (5,))

    def test_members_of_a_batch(self):
        # Systems, records and noise levels: every member is what it is alone.
        systems = [random_system(k, pairs=2) for k in range(2)]
        modes = Modes(
            np.stack([s.poles for s in systems])[:, None],
            np.stack([s.B_modal for s in systems])[:, None],
            np.stack([s.c[0] for s in systems])[:, None],
            np.stack([s.L_modal for s in systems])[:, None],
            np.stack([s.D[0] for s in systems])[:, None],
        )
        u = np.stack([oracles.random_inputs(5, 2, k) for k in range(3)])
        sd = torch.tensor([0.1, 0.4, 0.9], dtype=torch.float64)
        y = oracles.random_inputs(3, 5, 9)
        together = process(modes, u).observed(sd).log_prob(tensor(y))
        assert together.shape == (2, 3)
        for i, system in enumerate(systems):
            for k in range(3):
                alone = process(system.modes, u[k]).observed(sd[k]).log_prob(tensor(y[k]))
                assert together[i, k].item() == pytest.approx(alone.item(), rel=1e-12)

    def test_expand(self):
        g = process(random_system(0, outputs=2).modes, oracles.random_inputs(5, 2))
        x = g.sample()
        for d in (g, g.observed(0.3)):
            wide = d.expand((3, 2))
            assert wide.sample().shape == wide.mean.shape == wide.variance.shape == (3, 2, 5, 2)
            assert_close(wide.log_prob(x.expand(3, 2, 5, 2)), d.log_prob(x).expand(3, 2))
            draws = wide.sample()
            assert (draws[0, 0] - draws[2, 1]).abs().min() > 0.0  # independent draws

    def test_to_event(self):
        g = process(random_system(0).modes, np.zeros((3, 5, 2)))
        records = g.to_event(1)
        assert (records.batch_shape, records.event_shape) == ((), (3, 5))
        x = g.sample()
        assert records.log_prob(x).item() == pytest.approx(g.log_prob(x).sum().item())

    def test_mask(self):
        g = process(random_system(0).modes, np.zeros((3, 5, 2)))
        x, mask = g.sample(), torch.tensor([True, False, True])
        assert_close(g.mask(mask).log_prob(x), torch.where(mask, g.log_prob(x), 0.0))


class TestHandlers:
    def test_trace_in_a_plate_expands(self):
        system = random_system(0)

        def model():
            with pyro.plate("records", 4):
                return pyro.sample("g", process(system.modes, oracles.random_inputs(5, 2)))

        trace = poutine.trace(model).get_trace()
        trace.compute_log_prob()
        site = trace.nodes["g"]
        assert site["value"].shape == (4, 5)
        assert site["log_prob"].shape == (4,)
        alone = process(system.modes, oracles.random_inputs(5, 2)).log_prob(site["value"])
        assert site["log_prob_sum"].item() == pytest.approx(alone.sum().item())

    def test_a_plate_of_wrong_size_is_an_error(self):
        def model():
            with pyro.plate("records", 4):
                pyro.sample("g", process(random_system(0).modes, np.zeros((3, 5, 2))))

        with pytest.raises((ValueError, RuntimeError)):
            model()

    def test_subsampled_records_are_scaled_up(self):
        u, y = inputs(6), data(6)

        def model():
            modes = models.sample_system()
            with pyro.plate("records", 6, subsample=torch.tensor([1, 4])) as index:
                g = LTIProcess(modes, TIME, u[index]).observed(0.5)
                pyro.sample("y", g, obs=y[index])

        trace = poutine.trace(model).get_trace()
        trace.compute_log_prob()
        site = trace.nodes["y"]
        expected = 3.0 * site["fn"].log_prob(y[[1, 4]]).sum()
        assert site["log_prob_sum"].item() == pytest.approx(expected.item())

    def test_condition_and_do(self):
        g = torch.linspace(0.0, 1.0, N, dtype=torch.float64)
        trace = poutine.trace(poutine.condition(models.latent, {"g": g})).get_trace(inputs())
        trace.compute_log_prob()
        assert trace.nodes["g"]["is_observed"]
        assert trace.nodes["g"]["value"] is g
        assert trace.nodes["g"]["log_prob"].item() != 0.0
        # An intervention cuts the site out of the density, and y still follows it.
        done = poutine.trace(poutine.do(models.latent, {"g": g})).get_trace(inputs())
        assert_close(done.nodes["y"]["fn"].base_dist.loc, g)

    def test_masked_records_do_not_count(self):
        u, y = inputs(3), data(3)
        mask = torch.tensor([True, False, True])

        def model():
            modes = models.sample_system()
            with pyro.plate("records", 3), poutine.mask(mask=mask):
                pyro.sample("y", LTIProcess(modes, TIME, u).observed(0.5), obs=y)

        trace = poutine.trace(model).get_trace()
        trace.compute_log_prob()
        site = trace.nodes["y"]
        base = site["fn"]
        expected = base.log_prob(y)[mask].sum()
        assert site["log_prob_sum"].item() == pytest.approx(expected.item())

    @pytest.mark.parametrize(
        ("model", "records", "latent"),
        [
            (models.latent, None, True),
            (models.observed, None, False),
            (models.latent_records, 3, True),
            (models.observed_records, 3, False),
        ],
    )
    def test_predictive_in_parallel(self, model, records, latent):
        u = inputs(records)
        shape = (N,) if records is None else (records, N)
        draws = Predictive(model, num_samples=5, parallel=True)(u)
        assert draws["y"].squeeze().shape == (5, *shape)
        # Draws of the posterior, here of one system five times, go in as a batch.
        hyper = {
            name: value[:1].expand(5, *value.shape[1:])
            for name, value in draws.items()
            if name not in ("g", "y")
        }
        again = Predictive(model, hyper, parallel=True, return_sites=["g", "y"])(u)
        y = again["y"].reshape(5, *shape)
        assert (y[0] - y[1]).abs().min() > 0.0
        if latent:
            assert again["g"].reshape(5, *shape).isfinite().all()

    def test_parallel_and_serial_densities_agree(self):
        u, y = inputs(3), data(3)
        draws = Predictive(models.observed_records, num_samples=4, parallel=True)(u)
        hyper = {k: v for k, v in draws.items() if k != "y"}
        with pyro.plate("particles", 4, dim=-2):
            trace = poutine.trace(poutine.condition(models.observed_records, hyper)).get_trace(u, y)
        trace.compute_log_prob()
        together = trace.nodes["y"]["log_prob"]
        assert together.shape == (4, 3)
        for k in range(4):
            one = {name: value[k].squeeze(0) for name, value in hyper.items()}
            alone = poutine.trace(poutine.condition(models.observed_records, one)).get_trace(u, y)
            alone.compute_log_prob()
            assert_close(together[k], alone.nodes["y"]["log_prob"], rtol=1e-12)


class TestProvenance:
    def test_latent(self):
        upstream = get_model_relations(models.latent, (inputs(), data()))["sample_sample"]
        assert set(upstream["g"]) == {"decay", "gain", "noise"}
        assert set(upstream["y"]) == {"g", "sigma"}  # the system enters through g alone

    def test_observed(self):
        relations = get_model_relations(models.observed, (inputs(), data()))
        assert set(relations["sample_sample"]["y"]) == {"decay", "gain", "noise", "sigma"}
        assert relations["observed"] == ["y"]

    def test_plates(self):
        relations = get_model_relations(models.latent_records, (inputs(3), data(3)))
        assert relations["plate_sample"]["records"] == ["g", "y"]


class TestEstimators:
    @pytest.mark.parametrize("elbo", [Trace_ELBO, TraceMeanField_ELBO])
    @pytest.mark.parametrize(
        ("model", "records"),
        [(models.latent, None), (models.observed, None), (models.latent_records, 3)],
    )
    @pytest.mark.parametrize("vectorize", [False, True])
    def test_one_step(self, elbo, model, records, vectorize):
        guide = AutoNormal(model, init_scale=0.1)
        loss = elbo(
            num_particles=3,
            vectorize_particles=vectorize,
            max_plate_nesting=0 if records is None else 1,
        )
        svi = SVI(model, guide, Adam({"lr": 0.01}), loss)
        assert np.isfinite(svi.step(inputs(records), data(records)))
        before = {k: v.detach().clone() for k, v in guide.named_parameters()}
        svi.step(inputs(records), data(records))
        for name, value in guide.named_parameters():
            assert value.isfinite().all()
            assert not torch.equal(value, before[name])

    def test_trajectory_guide(self):
        # A posterior of the trajectory as the guide of its site: the exact one, so that the ELBO
        # of any single draw is the evidence.
        u, y = inputs(), data()
        modes = poutine.trace(models.sample_system).get_trace().nodes["_RETURN"]["value"].detach()
        prior = LTIProcess(modes, TIME, u, jitter=1e-6)

        def model():
            g = pyro.sample("g", prior)
            sd = torch.tensor(0.4, dtype=torch.float64)
            pyro.sample("y", dist.Normal(g, sd).to_event(1), obs=y)

        def guide():
            pyro.sample("g", prior.condition(y, 0.4))

        jitter = prior.noise_rows
        noise = (0.16 + jitter).sqrt()
        evidence = prior.observed(noise, varying=True).log_prob(y).item()
        for _ in range(3):
            assert Trace_ELBO().loss(model, guide) == pytest.approx(-evidence, rel=1e-9)
