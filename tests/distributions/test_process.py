"""LTIProcess and ObservedLTIProcess against dense multivariate normals."""

import numpy as np
import pytest
import torch
from scipy.stats import multivariate_normal

from pyro_dynogp.distributions.process import LTIProcess
from pyro_dynogp.lti.modes import Modes
from pyro_dynogp.lti.state import ModalState, propagate
from tests.distributions.cases import START, make
from tests.lti import oracles
from tests.lti.oracles import NOISES, assert_close, random_system, tensor

KINDS = [(None, "shared"), (None, "independent"), (2, "shared"), (2, "independent")]


@pytest.mark.parametrize("start", START)
@pytest.mark.parametrize(("outputs", "noise"), KINDS)
class TestDensities:
    def test_trajectory(self, outputs, noise, start):
        case = make(outputs=outputs, noise=noise, start=start, jitter=1e-4)
        # The jitter is a share of the larger output's stationary variance (and of its variance at
        # the first time, where that is given); nothing else is added.
        C = case.system.C
        scale = np.diag(C @ case.system.stationary @ C.T).max()
        if start == "gaussian":
            scale += np.diag(C @ case.process.initial_covariance.numpy() @ C.T).max()
        K = case.covariance + 1e-4 * scale * np.eye(case.size)
        x = case.draw(3)
        expected = multivariate_normal(case.mean, K).logpdf(x)
        assert_close(case.process.log_prob(case.event(x)), expected)
        assert_close(case.process.mean, case.event(case.mean))
        assert_close(case.process.variance, case.event(np.diag(case.covariance)))
        assert_close(case.process.stddev.square(), case.event(np.diag(case.covariance)))

    def test_observed(self, outputs, noise, start):
        case = make(outputs=outputs, noise=noise, start=start, offset=True)
        sd = np.array([0.3, 0.8])[: outputs or 1]
        K = case.covariance + np.diag(np.tile(sd**2, 10))
        y = case.draw(3)
        observed = case.process.observed(sd if outputs else sd[0])
        expected = multivariate_normal(case.mean, K).logpdf(y)
        assert_close(observed.log_prob(case.event(y)), expected)
        assert_close(observed.mean, case.event(case.mean))
        assert_close(observed.variance, case.event(np.diag(K)))

    def test_noise_that_varies(self, outputs, noise, start):
        case = make(outputs=outputs, noise=noise, start=start)
        sd = np.random.default_rng(0).uniform(0.1, 1.0, case.size)
        y = case.draw()
        observed = case.process.observed(case.event(sd), varying=True)
        expected = multivariate_normal(case.mean, case.covariance + np.diag(sd**2)).logpdf(y)
        assert observed.log_prob(case.event(y)).item() == pytest.approx(expected, rel=1e-10)

    def test_missing_samples_are_dropped(self, outputs, noise, start):
        case = make(outputs=outputs, noise=noise, start=start)
        y = case.draw(2)
        y[:, [0, 3, 4]] = np.nan
        y[1, 7] = np.nan  # another pattern in the second record
        observed = case.process.observed(0.4)
        ours = observed.log_prob(case.event(y))
        for k in range(2):
            there = ~np.isnan(y[k])
            K = (case.covariance + 0.16 * np.eye(case.size))[np.ix_(there, there)]
            expected = multivariate_normal(case.mean[there], K).logpdf(y[k, there])
            assert ours[k].item() == pytest.approx(expected, rel=1e-10)


@pytest.mark.parametrize("outputs", [None, 2])
def test_missing_samples_leave_gradients_finite(outputs):
    case = make(outputs=outputs)
    y = case.draw()
    y[[1, 5]] = np.nan
    grads = []
    for data in (y, np.where(np.isnan(y), 0.0, y)):  # the second: no value, infinite noise
        poles = tensor(case.system.poles).requires_grad_()
        sd = torch.full((case.size,), 0.4, dtype=torch.float64).requires_grad_()
        m = case.process.modes
        modes = Modes(poles, m.B, m.output_gain, m.L, m.feedthrough)
        process = LTIProcess(modes, case.time, case.inputs)
        noise = sd if data is y else torch.where(torch.as_tensor(np.isnan(y)), 1e8, sd)
        observed = process.observed(noise.reshape(process.event_shape), varying=True)
        value = observed.log_prob(case.event(data))
        grads.append(torch.autograd.grad(value, [poles, sd]))
    assert grads[0][1][[1, 5]].tolist() == [0.0, 0.0]
    for ours, limit in zip(*grads, strict=True):
        assert_close(ours, limit, rtol=1e-9)


def test_all_missing():
    case = make()
    observed = case.process.observed(0.4)
    assert observed.log_prob(torch.full((10,), torch.nan, dtype=torch.float64)).item() == 0.0


def test_missing_with_batches_of_noise_and_of_modes():
    # Noise of 3 draws, data of 2 records, each record with its own missing samples.
    case = make()
    sd = torch.tensor([[0.2], [0.5], [0.9]], dtype=torch.float64)
    y = case.draw(2)
    y[0, 2] = y[1, 5] = np.nan
    process = LTIProcess(case.system.modes, case.time, np.stack([case.inputs] * 2))
    observed = process.observed(sd)
    assert observed.batch_shape == (3, 2)
    together = observed.log_prob(tensor(y))
    assert together.shape == (3, 2)
    for i in range(3):
        for k in range(2):
            alone = case.process.observed(sd[i, 0]).log_prob(tensor(y[k]))
            assert together[i, k].item() == pytest.approx(alone.item(), rel=1e-12)


def moments(draws, mean, covariance, *, level=4.5):
    """Sample mean and covariance of draws (R, N) within `level` standard errors."""
    R = len(draws)
    variance = np.diag(covariance)
    error = (draws.mean(0) - mean) / np.sqrt(variance / R)
    assert np.abs(error).max() < level
    d = draws - mean
    sampled = d.T @ d / R
    # Var[d_i d_j] = K_ii K_jj + K_ij^2 for normals
    standard_error = np.sqrt((np.outer(variance, variance) + covariance**2) / R)
    assert np.abs((sampled - covariance) / standard_error).max() < level
    assert (standard_error < 0.02 * np.sqrt(np.outer(variance, variance))).all()


@pytest.mark.parametrize(("outputs", "noise"), KINDS)
def test_sample_moments(outputs, noise):
    case = make(outputs=outputs, noise=noise, start="gaussian", n=6, seed=1)
    torch.manual_seed(0)
    draws = case.process.sample((20_000,))
    assert draws.shape == (20_000, *case.process.event_shape)
    moments(draws.reshape(20_000, -1).numpy(), case.mean, case.covariance)
    noisy = case.process.observed(0.5).sample((20_000,)).reshape(20_000, -1).numpy()
    moments(noisy, case.mean, case.covariance + 0.25 * np.eye(case.size))


@pytest.mark.parametrize("outputs", [None, 2])
def test_innovations_are_the_standardised_prediction_errors(outputs):
    case = make(outputs=outputs)
    observed = case.process.observed(0.3)
    root = np.linalg.cholesky(case.covariance + 0.09 * np.eye(case.size))
    e = np.random.default_rng(0).standard_normal((4, case.size))
    y = observed.from_innovations(case.event(e))
    assert_close(y, case.event(case.mean + e @ root.T))
    assert_close(observed.to_innovations(y), case.event(e))


def test_samples_are_differentiable():
    case = make(n=5)
    m = case.process.modes
    noise = torch.ones(5, dtype=torch.float64)

    def f(poles, L, D):
        modes = Modes(poles, m.B, m.output_gain, L, D)
        return LTIProcess(modes, case.time, case.inputs, jitter=1e-3).from_innovations(noise)

    leaves = [x.clone().requires_grad_() for x in (m.poles, m.L, m.feedthrough)]
    assert torch.autograd.gradcheck(f, leaves)
    assert LTIProcess(m, case.time, case.inputs).has_rsample


class TestErrors:
    def test_process(self):
        modes = random_system(0, outputs=2).modes
        t, u = np.arange(3.0), np.zeros((3, 2))
        for args, said in [
            ((modes, t), "inputs.*2 inputs"),
            ((modes, t, np.zeros((2, 2))), r"inputs.*\(2, 2\)"),
            ((modes, t, np.full((3, 2), np.nan)), "inputs.*finite.*row 0"),
            ((modes, [0.0, 2.0, 1.0], u), "time.*decrease"),
            ((modes, [], u), "time"),
        ]:
            with pytest.raises(ValueError, match=said):
                LTIProcess(*args)

    def test_offset(self):
        with pytest.raises(ValueError, match=r"offset.*2.*\(3,\)"):
            LTIProcess(random_system(0, outputs=2).modes, [0.0], np.zeros((1, 2)), offset=[1, 2, 3])

    @pytest.mark.parametrize(
        "state",
        [
            torch.zeros(4),
            ModalState(torch.zeros(4, dtype=torch.complex128)),
            ModalState(torch.zeros(3, dtype=torch.complex128), torch.eye(3, dtype=torch.float64)),
        ],
    )
    def test_initial_state_when_made(self, state):
        with pytest.raises(ValueError, match="initial_state"):
            LTIProcess(random_system(0).modes, [0.0, 1.0], np.zeros((2, 2)), state)

    @pytest.mark.parametrize(
        ("sd", "varying", "said"),
        [
            (-0.1, False, "noise_sd.*>= 0"),
            (np.nan, False, "noise_sd.*finite"),
            (np.inf, False, "noise_sd.*finite"),
            ([0.1, 0.2, 0.3], False, r"noise_sd.*2.*\(3,\)"),
            (0.1, True, "noise_sd"),
            (np.ones((4, 2)), True, r"noise_sd.*\(5, 2\).*\(4, 2\)"),
        ],
    )
    def test_noise_sd(self, sd, varying, said):
        case = make(outputs=2, n=5)
        with pytest.raises(ValueError, match=said):
            case.process.observed(sd, varying=varying)

    def test_zero_noise_needs_distinct_times(self):
        modes = random_system(0, inputs=0).modes
        twice = LTIProcess(modes, [0.0, 1.0, 1.0])
        with pytest.raises(ValueError, match=r"noise_sd.*share a time.*zero"):
            twice.observed(0.0)
        with pytest.raises(ValueError, match="noise_sd"):
            twice.observed([0.1, 0.1, 0.0], varying=True)
        assert torch.isfinite(twice.observed(0.1).log_prob(torch.zeros(3, dtype=torch.float64)))

    def test_zero_noise_at_distinct_times(self):
        case = make()
        y = case.draw()
        ours = case.process.observed(0.0).log_prob(tensor(y)).item()
        expected = multivariate_normal(case.mean, case.covariance).logpdf(y)
        assert ours == pytest.approx(expected, rel=1e-8)

    def test_values(self):
        case = make()
        for value in (torch.full((10,), torch.inf), torch.zeros(9)):
            with pytest.raises(ValueError, match=r"value|support|shape|size"):
                case.process.observed(0.1).log_prob(value)
        with pytest.raises(ValueError, match="support"):
            case.process.log_prob(torch.full((10,), torch.nan))

    def test_expand(self):
        with pytest.raises(ValueError, match="batch_shape"):
            make().process.expand((3,)).expand((2,))


def test_initial_state_is_the_mean_with_the_stationary_covariance():
    case = make(start="state")
    other = make(start="stationary")
    assert_close(case.process.variance, other.process.variance)
    assert (case.process.mean - other.process.mean).abs().max() > 0.1
    assert case.process.initial_covariance is None


def test_jitter_is_not_in_the_observed_density():
    case = make()
    loose = LTIProcess(case.system.modes, case.time, case.inputs, jitter=0.5)
    y = tensor(case.draw())
    assert loose.observed(0.1).log_prob(y) == case.process.observed(0.1).log_prob(y)
    assert loose.log_prob(y) != case.process.log_prob(y)


def test_forecast_by_the_final_state():
    # A record in two pieces, the second started from the posterior state of the first: the chain
    # rule gives the density of the whole.
    case = make(n=12, start="gaussian")
    y = tensor(case.draw())
    whole = case.process.observed(0.3).log_prob(y)
    head = LTIProcess(case.system.modes, case.time[:7], case.inputs[:7], case.process.initial_state)
    posterior = head.condition(y[:7], 0.3)
    step = float(case.time[7] - case.time[6])
    state = propagate(case.system.modes, posterior.final_state, step, tensor(case.inputs[6]))
    tail = LTIProcess(case.system.modes, case.time[7:], case.inputs[7:], state)
    parts = head.observed(0.3).log_prob(y[:7]) + tail.observed(0.3).log_prob(y[7:])
    assert parts.item() == pytest.approx(whole.item(), rel=1e-12)
    assert oracles.log_density(
        y.numpy() - case.mean, case.covariance + 0.09 * np.eye(12)
    ) == pytest.approx(whole.item(), rel=1e-10)


@pytest.mark.parametrize("noise", NOISES)
def test_order_of_pairs_does_not_matter(noise):
    case = make(noise=noise)
    s, order = case.system, [1, 0]
    modes = Modes(s.poles[order], s.B_modal[order], s.c[0, order], s.L_modal[order], s.D[0], noise)
    other = LTIProcess(modes, case.time, case.inputs)
    y = tensor(case.draw())
    assert_close(other.log_prob(y), case.process.log_prob(y), rtol=1e-12)
