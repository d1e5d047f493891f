"""The non-centred form of a trajectory: same density, other coordinates."""

import numpy as np
import pyro
import pyro.distributions as dist
import pytest
import torch
from pyro import poutine
from pyro.infer import MCMC, NUTS, Predictive

from pyro_dynogp.distributions.process import LTIProcess
from pyro_dynogp.distributions.reparam import InnovationReparam
from tests.distributions import models
from tests.distributions.models import N, data, inputs
from tests.distributions.test_sites import HYPER
from tests.lti import oracles
from tests.lti.oracles import assert_close, random_system

CONFIG = {"g": InnovationReparam()}


@pytest.fixture(autouse=True)
def fresh():
    pyro.set_rng_seed(0)
    with pyro.validation_enabled(True):
        yield


def log_joint(model, values, *args):
    trace = poutine.trace(poutine.condition(model, HYPER | values)).get_trace(*args)
    return trace, trace.log_prob_sum().item()


@pytest.mark.parametrize("records", [None, 3])
def test_same_joint_density_up_to_the_jacobian(records):
    model = models.latent if records is None else models.latent_records
    u, y = inputs(records), data(records)
    shape = (N,) if records is None else (records, N)
    e = torch.randn(shape, dtype=torch.float64)
    flat, ours = log_joint(poutine.reparam(model, CONFIG), {"g_innovations": e}, u, y)
    g = flat.nodes["g"]["value"]
    straight, expected = log_joint(model, {"g": g}, u, y)
    # dg = L D^{1/2} de, whose determinant is the root of that of the covariance.
    fn = straight.nodes["g"]["fn"]
    fn = getattr(fn, "base_dist", fn)
    basis = torch.eye(N, dtype=torch.float64)
    zero = torch.zeros(N, dtype=torch.float64)
    jacobian = torch.stack(
        [
            fn.from_innovations(x.expand(shape)).reshape(-1, N)[0]
            - fn.from_innovations(zero.expand(shape)).reshape(-1, N)[0]
            for x in basis
        ]
    )
    log_det = np.linalg.slogdet(jacobian.numpy())[1] * (records or 1)
    assert ours == pytest.approx(expected + log_det, rel=1e-9)
    # The site keeps its name and counts nothing by itself.
    assert flat.nodes["g"]["log_prob_sum"].item() == 0.0
    assert flat.nodes["g_innovations"]["value"].shape == shape


def test_trajectory_has_the_moments_of_the_process():
    system = random_system(0, pairs=2)
    t, u = oracles.irregular_times(4), oracles.random_inputs(4, 2)

    def model():
        with pyro.plate("draws", 20_000):
            return pyro.sample("g", LTIProcess(system.modes, t, u))

    draws = poutine.reparam(model, CONFIG)().numpy()
    mean, K = oracles.mean(system, t, u)[0][:, 0], oracles.covariance(system, t, t)
    variance = np.diag(K)
    assert np.abs((draws.mean(0) - mean) / np.sqrt(variance / 20_000)).max() < 4.5
    standard_error = np.sqrt((np.outer(variance, variance) + K**2) / 20_000)
    assert np.abs((np.cov(draws.T) - K) / standard_error).max() < 4.5


def test_initial_values_are_turned_into_innovations():
    # An initialisation hands the site a value without observing it.
    g = torch.linspace(-1.0, 1.0, N, dtype=torch.float64)
    initial = poutine.condition(models.latent, HYPER)
    with pyro.poutine.trace() as tr, poutine.reparam(config=CONFIG):
        pyro.infer.autoguide.initialization.InitMessenger(
            pyro.infer.autoguide.init_to_value(values={"g": g})
        )(initial)(inputs(), data())
    trace = tr.trace
    fn = poutine.trace(initial).get_trace(inputs(), data()).nodes["g"]["fn"]
    assert_close(trace.nodes["g"]["value"], g)
    assert_close(trace.nodes["g_innovations"]["value"], fn.to_innovations(g))
    assert not trace.nodes["g_innovations"]["is_observed"]


def test_a_conditioned_trajectory_keeps_its_density():
    # Conditioning on the trajectory itself: the joint density is that of the plain model, with the
    # determinant of the covariance in it, or hyperparameters would be fitted to the wrong target.
    # A clear refusal would do as well; a density without the determinant would not.
    g = torch.sin(torch.arange(N, dtype=torch.float64))
    for scale in (1.0, 1.5):
        values = {"g": g, "noise": scale * HYPER["noise"]}
        expected = log_joint(models.latent, values, inputs(), data())[1]
        conditioned = poutine.condition(models.latent, HYPER | values)
        try:
            trace = poutine.trace(poutine.reparam(conditioned, CONFIG)).get_trace(inputs(), data())
        except (NotImplementedError, ValueError) as refusal:
            assert "'g'" in str(refusal)  # noqa: PT017
            return
        assert trace.log_prob_sum().item() == pytest.approx(expected, rel=1e-9)


def test_posterior_trajectory():
    # A posterior as the site's distribution must come out with its own moments, or be refused.
    system = random_system(0, pairs=2)
    t, u = oracles.irregular_times(4), oracles.random_inputs(4, 2)
    y = torch.zeros(4, dtype=torch.float64)
    posterior = LTIProcess(system.modes, t, u).condition(y, 0.1)

    def model():
        with pyro.plate("draws", 4000):
            return pyro.sample("g", posterior)

    try:
        draws = poutine.reparam(model, CONFIG)()
    except (NotImplementedError, ValueError) as refusal:
        assert "'g'" in str(refusal)  # noqa: PT017
        return
    spread = draws.var(0) / posterior.variance
    assert (spread - 1.0).abs().max() < 5.0 * np.sqrt(2.0 / 4000)


def test_other_sites_are_refused():
    def model():
        pyro.sample("g", dist.Normal(0.0, 1.0))

    with pytest.raises(ValueError, match=r"InnovationReparam.*'g'.*LTIProcess.*Normal"):
        poutine.reparam(model, CONFIG)()


def test_nuts_and_predictive():
    model = poutine.reparam(models.latent, CONFIG)
    kernel = NUTS(model, max_tree_depth=4)
    mcmc = MCMC(kernel, num_samples=6, warmup_steps=6, disable_progbar=True)
    mcmc.run(inputs(), data())
    draws = mcmc.get_samples()
    assert set(draws) == {"decay", "gain", "noise", "sigma", "g_innovations"}
    assert draws["g_innovations"].shape == (6, N)
    assert len(torch.unique(draws["sigma"])) > 1
    g = Predictive(model, draws, return_sites=["g"], parallel=True)(inputs())["g"]
    assert g.shape == (6, N)
    # The trajectory that belongs to the draws, not a new one.
    one = {name: value[2] for name, value in draws.items()}
    trace = poutine.trace(poutine.condition(model, one)).get_trace(inputs())
    assert_close(g[2], trace.nodes["g"]["value"], rtol=1e-12)
