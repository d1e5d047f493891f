"""Densities of left-out samples: dense algebra, sums, units, and what they must refuse."""

import numpy as np
import pyro.distributions as dist
import pytest
import torch
from scipy.stats import multivariate_normal, norm

import pyro_dynogp as dgp
from pyro_dynogp.criticism.densities import pointwise_log_density
from pyro_dynogp.models.outputs import output_process
from pyro_dynogp.models.wiring import Dynamic, Static
from tests.lti import oracles
from tests.lti.oracles import random_system, tensor
from tests.models.outputs import outputs_along
from tests.moments.joint import linear_cascade

N = 12


def linear(outputs, batch=False):
    system = random_system(3, outputs=outputs)
    time = oracles.irregular_times(N, 3)
    u = oracles.random_inputs(N, system.modes.inputs, 3)
    modes = system.modes
    sd = tensor(0.3 if outputs is None else np.linspace(0.2, 0.4, outputs))
    process = dgp.LTIProcess(modes, time, tensor(u))
    observed = process.observed(sd)
    with torch.random.fork_rng():
        torch.manual_seed(0)
        y = observed.sample()
    y[4] = torch.nan
    if outputs:
        y[7, 0] = torch.nan
    covariance = oracles.covariance(system, time, time) + np.kron(
        np.eye(N), np.diag(np.atleast_1d(sd.numpy() ** 2))
    )
    return observed, y, covariance


def conditional(mean, covariance, y, k, given):
    """Scipy's density of y_k given others."""
    there = [j for j in given if not np.isnan(y[j])]
    C = covariance[np.ix_(there, there)]
    gain = np.linalg.solve(C, covariance[there, k]) if there else np.zeros(0)
    m = mean[k] + gain @ (y[there] - mean[there])
    return norm.logpdf(y[k], m, np.sqrt(covariance[k, k] - gain @ covariance[there, k]))


@pytest.mark.parametrize("outputs", [None, 2])
@pytest.mark.parametrize(
    ("kind", "horizon"), [("missing sample", 1), ("forecast", 1), ("forecast", 3)]
)
def test_linear_against_dense_algebra(outputs, kind, horizon):
    observed, y, covariance = linear(outputs)
    found = pointwise_log_density(observed, y, kind, horizon=horizon)
    width = outputs or 1
    assert found.shape == (1, N, width)
    flat, mean = y.numpy().reshape(-1), observed.mean.numpy().reshape(-1)
    for k in range(N * width):
        if np.isnan(flat[k]):
            assert np.isnan(found.reshape(-1)[k])
            continue
        if kind == "missing sample":
            given = [j for j in range(N * width) if j != k]
        elif horizon == 1:
            given = range(k)
        else:
            given = range(max(k // width - horizon + 1, 0) * width)
        exact = conditional(mean, covariance, flat, k, given)
        assert found.reshape(-1)[k] == pytest.approx(exact, rel=1e-8, abs=1e-8)


@pytest.mark.parametrize("outputs", [None, 2])
def test_one_step_densities_add_up_to_that_of_the_record(outputs):
    observed, y, covariance = linear(outputs)
    total = np.nansum(pointwise_log_density(observed, y, "forecast"))
    assert total == pytest.approx(float(observed.log_prob(y)), rel=1e-10)
    flat, mean = y.numpy().reshape(-1), observed.mean.numpy().reshape(-1)
    k = np.flatnonzero(~np.isnan(flat))
    exact = multivariate_normal.logpdf(flat[k], mean[k], covariance[np.ix_(k, k)])
    assert total == pytest.approx(exact, rel=1e-8)


@pytest.mark.parametrize("kind", ["missing sample", "forecast"])
def test_a_linear_cascade_is_the_linear_process(kind):
    """In its own units: a change of scale enters by the logarithm of the Jacobian."""
    layers = (Dynamic(pairs=2), Static(), Dynamic(pairs=1, skip=("g1",)))
    time = oracles.irregular_times(N, 5)
    u = oracles.random_inputs(N, 1, 5)
    system, joint, sd, offset = linear_cascade(1, layers, time, u, seed=5, known_start=("g1",))
    scale, shift = np.array([2.5]), np.array([-1.0])
    observed = outputs_along(system, time, tensor(u), scale, shift)
    with torch.random.fork_rng():
        torch.manual_seed(1)
        y = observed.sample()
    y[3] = torch.nan
    found = pointwise_log_density(observed, y, kind)[0, :, 0]
    i = joint.index("g2").reshape(-1)
    covariance = 2.5**2 * (joint.covariance[np.ix_(i, i)] + sd**2 * np.eye(N))
    mean = -1.0 + 2.5 * (joint.mean[i] + offset)
    for k in range(N):
        if k == 3:
            assert np.isnan(found[k])
            continue
        given = range(k) if kind == "forecast" else [j for j in range(N) if j != k]
        exact = conditional(mean, covariance, y.numpy(), k, given)
        assert found[k] == pytest.approx(exact, rel=1e-7, abs=1e-7)


@pytest.mark.parametrize("likelihood", [dgp.Gaussian(), dgp.StudentT(4.0)])
def test_one_step_densities_of_a_cascade_add_up(likelihood, bent):
    """Student-t noise too: the density of a residual is the mixture's, not a normal's."""
    model = dgp.Wiener(1, pairs=1, inducing=6, likelihood=likelihood).scaled_to(bent)
    with torch.random.fork_rng(), torch.no_grad():
        torch.manual_seed(2)
        system = model.collapsed.sample_system(model.scaling)
        states = model.sample_states("")
    (along,) = model.prepare(bent)
    observed = output_process(model.begin(system, states), along)
    y = bent.tensors().outputs[:, 0]
    y[5:9] = torch.nan
    total = np.nansum(pointwise_log_density(observed, y, "forecast"))
    assert total == pytest.approx(float(observed.log_prob(y)), rel=1e-9)
    far = pointwise_log_density(observed, y, "forecast", horizon=4)
    assert np.isfinite(far[0, ~torch.isnan(y).numpy()]).all()


def test_a_density_given_a_trajectory_is_refused():
    site = dist.Normal(torch.zeros(5), 1.0).to_event(1)
    with pytest.raises(ValueError, match="observed: expected an observed site whose traj"):
        pointwise_log_density(site, torch.zeros(5), "missing sample")
    observed, y, _ = linear(None)
    with pytest.raises(ValueError, match="kind: expected 'missing sample' or 'forecast'"):
        pointwise_log_density(observed, y, "loo")
    with pytest.raises(ValueError, match="horizon: expected a whole number >= 1"):
        pointwise_log_density(observed, y, "forecast", horizon=0)
