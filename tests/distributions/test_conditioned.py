"""A trajectory given noisy samples, against dense conditional normals."""

import numpy as np
import pytest
import torch
from scipy.stats import multivariate_normal

from pyro_dynogp.distributions.process import LTIProcess
from tests.distributions.cases import START, make
from tests.distributions.test_process import moments
from tests.lti.oracles import assert_close, tensor


def posterior(case, y, noise, *, jitter=0.0):
    """Mean and covariance of h given the samples of y that are there."""
    H = case.covariance + jitter * np.eye(case.size)
    there = ~np.isnan(y)
    K = H[np.ix_(there, there)] + np.diag(np.broadcast_to(noise, y.shape)[there])
    gain = np.linalg.solve(K, H[there]).T
    return case.mean + gain @ (y - case.mean)[there], H - gain @ H[there]


def jitter_of(case, relative):
    C = case.system.C
    scale = np.diag(C @ case.system.stationary @ C.T).max()
    P0 = case.process.initial_covariance
    if P0 is not None:
        scale += np.diag(C @ P0.numpy() @ C.T).max()
    return relative * scale


@pytest.mark.parametrize("start", START)
@pytest.mark.parametrize("outputs", [None, 2])
class TestMoments:
    def test_mean_variance_and_evidence(self, outputs, start):
        case = make(outputs=outputs, start=start, offset=True)
        y = case.draw()
        y[[0, 4, 5]] = np.nan
        given = case.process.condition(case.event(y), 0.5)
        mean, covariance = posterior(case, y, 0.25)
        assert_close(given.mean, case.event(mean))
        assert_close(given.variance, case.event(np.diag(covariance)))
        there = ~np.isnan(y)
        K = (case.covariance + 0.25 * np.eye(case.size))[np.ix_(there, there)]
        evidence = multivariate_normal(case.mean[there], K).logpdf(y[there])
        assert given.log_evidence.item() == pytest.approx(evidence, rel=1e-10)
        assert_close(given.residual, np.where(there, y - case.mean, 0.0))

    def test_density(self, outputs, start):
        case = make(outputs=outputs, start=start, jitter=1e-3)
        y = case.draw()
        y[[2, 9]] = np.nan
        given = case.process.condition(case.event(y), 0.5)
        mean, covariance = posterior(case, y, 0.25, jitter=jitter_of(case, 1e-3))
        h = case.draw(3, seed=1)
        expected = multivariate_normal(mean, covariance).logpdf(h)
        assert_close(given.log_prob(case.event(h)), expected, rtol=1e-9)

    def test_samples(self, outputs, start):
        case = make(outputs=outputs, start=start, n=5, jitter=0.3)  # large, to be seen
        y = case.draw()
        y[1] = np.nan
        given = case.process.condition(case.event(y), 0.5)
        torch.manual_seed(1)
        draws = given.sample((20_000,))
        assert draws.shape == (20_000, *case.process.event_shape)
        mean, covariance = posterior(case, y, 0.25, jitter=jitter_of(case, 0.3))
        moments(draws.reshape(20_000, -1).numpy(), mean, covariance)

    def test_noise_that_varies(self, outputs, start):
        case = make(outputs=outputs, start=start)
        y = case.draw()
        sd = np.random.default_rng(2).uniform(0.2, 1.0, case.size)
        given = case.process.condition(case.event(y), case.event(sd), varying=True)
        mean, covariance = posterior(case, y, sd**2)
        assert_close(given.mean, case.event(mean))
        assert_close(given.variance, case.event(np.diag(covariance)))


def test_forecast_and_interpolation():
    # Times without samples are part of the axis, their samples missing.
    case = make(n=12)
    y = case.draw()
    y[[3, 9, 10, 11]] = np.nan
    given = case.process.condition(tensor(y), 0.4)
    mean, covariance = posterior(case, y, 0.16)
    assert_close(given.mean[-3:], mean[-3:])
    assert_close(given.variance[-3:], np.diag(covariance)[-3:])


def test_final_state_gives_the_last_output():
    case = make(outputs=2, start="gaussian")
    y = case.draw()
    given = case.process.condition(case.event(y), 0.4)
    mean, covariance = posterior(case, y, 0.16)
    x = given.final_state.mean.numpy()
    z = np.concatenate([x.real, x.imag])
    C, D, P = case.system.C, case.system.D, given.final_state.covariance.numpy()
    assert_close(C @ z + D @ case.inputs[-1], mean[-2:])
    assert_close(C @ P @ C.T, covariance[-2:, -2:])


def test_batches():
    # Three records with missing samples of their own, two noise levels.
    case = make()
    u = np.stack([case.inputs] * 3)
    y = case.draw(3)
    y[0, 1] = y[2, 8] = np.nan
    sd = torch.tensor([[0.2], [0.7]], dtype=torch.float64)
    given = LTIProcess(case.system.modes, case.time, u).condition(tensor(y), sd)
    assert given.batch_shape == (2, 3)
    assert given.event_shape == (10,)
    h = tensor(case.draw(seed=1))
    density = given.log_prob(h.expand(2, 3, 10))
    state = given.final_state
    assert given.sample((4,)).shape == (4, 2, 3, 10)
    for i in range(2):
        for k in range(3):
            alone = case.process.condition(tensor(y[k]), sd[i, 0])
            assert_close(given.mean[i, k], alone.mean)
            assert_close(given.variance[i, k], alone.variance)
            assert given.log_evidence[i, k].item() == pytest.approx(alone.log_evidence.item())
            assert density[i, k].item() == pytest.approx(alone.log_prob(h).item(), rel=1e-10)
            assert_close(state.mean[i, k], alone.final_state.mean)
            covariance = state.covariance.expand(2, 3, 4, 4)[i, k]
            assert_close(covariance, alone.final_state.covariance)


def test_records_of_data_widen_the_batch():
    # One process without batch, conditioned on three records: a posterior for each.
    case = make()
    y = case.draw(3)
    given = case.process.condition(tensor(y), 0.3)
    assert given.batch_shape == (3,)
    torch.manual_seed(0)
    assert given.sample((2,)).shape == (2, 3, 10)
    for k in range(3):
        alone = case.process.condition(tensor(y[k]), 0.3)
        assert_close(given.mean[k], alone.mean)
        assert_close(given.log_evidence[k], alone.log_evidence)
        assert_close(given.log_prob(tensor(y[k]))[k], alone.log_prob(tensor(y[k])))
        assert_close(given.final_state.mean[k], alone.final_state.mean)


def test_expand():
    case = make()
    y = tensor(case.draw())
    wide = case.process.condition(y, 0.3).expand((4,))
    assert wide.sample().shape == wide.mean.shape == wide.variance.shape == (4, 10)
    assert wide.log_prob(y.expand(4, 10)).shape == (4,)


def test_posterior_is_prior_where_nothing_was_seen():
    case = make(outputs=2)
    nothing = torch.full((10, 2), torch.nan, dtype=torch.float64)
    given = case.process.condition(nothing, 0.3)
    h = case.event(case.draw())
    assert_close(given.mean, case.process.mean)
    assert_close(given.variance, case.process.variance)
    assert given.log_prob(h).item() == pytest.approx(case.process.log_prob(h).item(), rel=1e-12)


def test_gradients_with_missing_samples():
    # The posterior's variance enters losses: its gradient must survive a missing sample.
    case = make()
    y = case.draw()
    y[[0, 6]] = np.nan
    sd = torch.tensor(0.4, dtype=torch.float64, requires_grad=True)

    def variance(sd):
        return case.process.condition(tensor(y), sd).variance

    def mean(sd):
        return case.process.condition(tensor(y), sd).mean

    assert torch.autograd.gradcheck(mean, sd)
    assert torch.autograd.gradcheck(variance, sd)


class TestErrors:
    def test_noise_sd_zero(self):
        case = make()
        with pytest.raises(ValueError, match=r"noise_sd.*> 0.*zero"):
            case.process.condition(tensor(case.draw()), 0.0)

    def test_shape_of_y(self):
        with pytest.raises(ValueError, match=r"y.*\(10,\).*\(9,\)"):
            make().process.condition(torch.zeros(9), 0.1)
        with pytest.raises(ValueError, match=r"y.*\(10, 2\)"):
            make(outputs=2).process.condition(torch.zeros(10), 0.1)
