"""Trajectories with inducing times, against dense normals."""

import numpy as np
import pytest
import torch
from torch.distributions import MultivariateNormal, kl_divergence

from pyro_dynogp.distributions.inducing import InducingLTIProcess, inducing_times
from pyro_dynogp.distributions.process import LTIProcess
from pyro_dynogp.lti.modes import Modes
from tests.distributions.cases import START, make
from tests.distributions.test_conditioned import jitter_of, posterior
from tests.distributions.test_divergence import dense
from tests.distributions.test_process import moments
from tests.lti.oracles import assert_close, tensor

INDEX = [[0, 3, 4, 9], [2, 5, 6, 11]]  # with the first sample, and with the last


class Oracle:
    """Dense matrices of a case with jitter, and of the inducing values."""

    def __init__(self, case, index, relative):
        n_y = case.process.modes.outputs
        self.rows = (np.array(index)[:, None] * n_y + np.arange(n_y)).reshape(-1)
        self.mean = case.mean
        self.S = case.covariance + jitter_of(case, relative) * np.eye(case.size)
        R = np.linalg.cholesky(self.S[np.ix_(self.rows, self.rows)])
        self.W = np.linalg.solve(R, self.S[self.rows]).T  # h - m = W e + what is left

    def moments(self, loc, scale_tril):
        change = self.W @ (scale_tril @ scale_tril.T - np.eye(len(loc))) @ self.W.T
        return self.mean + self.W @ loc, self.S + change

    def optimal(self, y, noise):
        """Mean and Cholesky factor of e given y = h + N(0, noise)."""
        precision = np.eye(self.W.shape[1]) + self.W.T @ self.W / noise
        covariance = np.linalg.inv(precision)
        return covariance @ self.W.T @ (y - self.mean) / noise, np.linalg.cholesky(covariance)


def parameters(size, seed=0):
    rng = np.random.default_rng([seed, 23])
    L = np.tril(0.4 * rng.standard_normal((size, size)), -1)
    return rng.standard_normal(size), L + np.diag(rng.uniform(0.3, 1.5, size))


@pytest.mark.parametrize("index", INDEX)
@pytest.mark.parametrize("start", START)
@pytest.mark.parametrize("outputs", [None, 2])
class TestDense:
    def make(self, outputs, start, index, relative, n=12):
        case = make(outputs=outputs, start=start, n=n, offset=True, jitter=relative)
        oracle = Oracle(case, index, relative)
        loc, scale_tril = parameters(len(oracle.rows))
        q = InducingLTIProcess(case.process, index, loc, scale_tril)
        return case, q, *oracle.moments(loc, scale_tril)

    def test_moments_density_divergence(self, outputs, start, index):
        case, q, mean, covariance = self.make(outputs, start, index, 1e-2)
        Q = dense(mean, covariance)
        assert_close(q.mean, case.event(mean))
        assert_close(q.variance, case.event(np.diag(covariance)), rtol=1e-9)
        h = case.draw(3, seed=1)
        assert_close(q.log_prob(case.event(h)), Q.log_prob(tensor(h)), rtol=1e-9)
        P = dense(case.mean, case.covariance + jitter_of(case, 1e-2) * np.eye(case.size))
        divergence = kl_divergence(q, case.process)
        assert divergence.shape == ()
        assert divergence.item() == pytest.approx(kl_divergence(Q, P).item(), rel=1e-10)

    def test_samples(self, outputs, start, index):
        case, q, mean, covariance = self.make(outputs, start, index, 0.3)
        torch.manual_seed(0)
        draws = q.sample((20_000,))
        assert draws.shape == (20_000, *case.process.event_shape)
        moments(draws.reshape(20_000, -1).numpy(), mean, covariance, level=5.0)

    def test_monte_carlo_divergence(self, outputs, start, index):
        case, q, *_ = self.make(outputs, start, index, 1e-4)
        torch.manual_seed(0)
        h = q.sample((4000,))
        ratio = (q.log_prob(h) - case.process.log_prob(h)).numpy()
        error = ratio.std() / np.sqrt(len(ratio))
        expected = kl_divergence(q, case.process).item()
        assert expected == pytest.approx(ratio.mean(), abs=4.5 * error)

    def test_whitened_values_of_draws(self, outputs, start, index):
        # At the default jitter, too, the values at the inducing times are those that were drawn.
        _, q, *_ = self.make(outputs, start, index, 1e-9)
        torch.manual_seed(0)
        e = q.whiten(q.sample((20_000,))).numpy()
        loc, scale_tril = parameters(e.shape[-1])
        moments(e, loc, scale_tril @ scale_tril.T, level=5.0)


def test_standard_normal_is_the_prior():
    case = make(outputs=2, start="gaussian")
    q = InducingLTIProcess(case.process, [1, 6], torch.zeros(4), torch.eye(4))
    h = case.event(case.draw())
    assert q.log_prob(h).item() == pytest.approx(case.process.log_prob(h).item(), rel=1e-14)
    assert kl_divergence(q, case.process).item() == 0.0
    assert_close(q.mean, case.process.mean)
    assert_close(q.variance, case.process.variance, rtol=1e-7)


@pytest.mark.parametrize("start", START)
@pytest.mark.parametrize("outputs", [None, 2])
class TestGaussianLikelihood:
    """y = h + N(0, noise): what the best q knows is then known exactly."""

    noise = 0.25

    def elbo(self, case, y, q):
        # E_q log p(y | h) in closed form, less the registered divergence.
        h = case.process.rows(q.mean).numpy()
        spread = case.process.rows(q.variance).numpy()
        fit = ((y - h) ** 2 + spread).sum() / self.noise
        constant = case.size * np.log(2 * np.pi * self.noise)
        return -0.5 * (fit + constant) - kl_divergence(q, case.process).item()

    def best(self, case, index, y):
        oracle = Oracle(case, index, case.process.jitter)
        q = InducingLTIProcess(case.process, index, *oracle.optimal(y, self.noise))
        return q, self.elbo(case, y, q)

    def test_every_sample_inducing_is_exact(self, outputs, start):
        case = make(outputs=outputs, start=start, n=12)
        y = case.draw()
        q, elbo = self.best(case, range(12), y)
        # The trajectory of q has the jitter (1e-9 of its variance), the exact results have none.
        mean, covariance = posterior(case, y, self.noise)
        assert_close(q.mean, case.event(mean), rtol=1e-6)
        assert_close(q.variance, case.event(np.diag(covariance)), rtol=1e-6)
        evidence = case.process.observed(self.noise**0.5).log_prob(case.event(y)).item()
        assert elbo == pytest.approx(evidence, rel=1e-6)

    def test_the_jitter_is_all_that_differs(self, outputs, start):
        case = make(outputs=outputs, start=start, n=12, jitter=1e-2)
        y = case.draw()
        q, elbo = self.best(case, range(12), y)
        jitter = jitter_of(case, 1e-2)
        mean, covariance = posterior(case, y, self.noise, jitter=jitter)
        assert_close(q.mean, case.event(mean), rtol=1e-9)
        assert_close(q.variance, case.event(np.diag(covariance)), rtol=1e-9)
        noisy = case.process.observed((self.noise + jitter) ** 0.5)
        assert elbo == pytest.approx(noisy.log_prob(case.event(y)).item(), rel=1e-10)
        assert abs(elbo - self.best(make(outputs=outputs, start=start, n=12), range(12), y)[1]) > (
            1e-3  # which the tolerance of the test above would see
        )

    def test_fewer_inducing_times_know_less(self, outputs, start):
        case = make(outputs=outputs, start=start, n=12)
        y = case.draw()
        nested = [[5], [2, 5], [2, 5, 8, 10], [0, 2, 4, 5, 6, 8, 10, 11], range(12)]
        elbo = [self.best(case, index, y)[1] for index in nested]
        assert (np.diff(elbo) > 1e-3).all()


def test_batches():
    # Two systems, three sets of values: every member is what it is alone.
    systems = [make(seed=k, jitter=1e-4, start="gaussian") for k in range(2)]
    stacked = {
        name: torch.stack([getattr(c.system.modes, name) for c in systems]).unsqueeze(1)
        for name in ("poles", "B", "output_gain", "L", "feedthrough")
    }
    case = systems[0]
    state = case.process.initial_state
    prior = LTIProcess(Modes(*stacked.values()), case.time, case.inputs, state, jitter=1e-4)
    loc = np.stack([parameters(3, seed)[0] for seed in range(3)])
    scale_tril = np.stack([parameters(3, seed)[1] for seed in range(3)])
    q = InducingLTIProcess(prior, [2, 3, 7], loc, scale_tril)
    assert (q.batch_shape, q.event_shape) == ((2, 3), (10,))
    h = tensor(case.draw())
    density, divergence = q.log_prob(h), kl_divergence(q, prior.expand((2, 3)))
    assert q.sample((4,)).shape == (4, 2, 3, 10)
    assert density.shape == divergence.shape == (2, 3)
    for i in range(2):
        one = LTIProcess(systems[i].system.modes, case.time, case.inputs, state, jitter=1e-4)
        for k in range(3):
            alone = InducingLTIProcess(one, [2, 3, 7], loc[k], scale_tril[k])
            assert_close(q.mean[i, k], alone.mean)
            assert_close(q.variance[i, k], alone.variance)
            assert density[i, k].item() == pytest.approx(alone.log_prob(h).item(), rel=1e-10)
            assert divergence[i, k].item() == pytest.approx(kl_divergence(alone, one).item())


def test_expand():
    case = make(outputs=2)
    wide = InducingLTIProcess(case.process, [0, 5], *parameters(4)).expand((3, 2))
    assert wide.sample().shape == wide.mean.shape == wide.variance.shape == (3, 2, 10, 2)
    assert wide.log_prob(wide.sample()).shape == (3, 2)
    assert kl_divergence(wide, case.process.expand((3, 2))).shape == (3, 2)
    draws = wide.sample()
    assert (draws[0, 0] - draws[2, 1]).abs().min() > 0.0


@pytest.mark.parametrize("what", ["log_prob", "sample", "mean", "variance", "divergence"])
def test_gradients(what):
    case = make(n=5, start="gaussian")
    m, state = case.system.modes, case.process.initial_state
    h = tensor(case.draw())
    loc, scale_tril = (tensor(x).requires_grad_() for x in parameters(2))
    leaves = (
        m.poles.clone().requires_grad_(),
        m.B.clone().requires_grad_(),
        m.L.clone().requires_grad_(),
        loc,
        scale_tril,
    )

    def value(poles, B, L, loc, scale_tril):
        modes = Modes(poles, B, m.output_gain, L, m.feedthrough)
        prior = LTIProcess(modes, case.time, case.inputs, state, jitter=1e-3)
        q = InducingLTIProcess(prior, [1, 3], loc, scale_tril.tril())
        torch.manual_seed(0)
        return {
            "log_prob": lambda: q.log_prob(h),
            "sample": q.rsample,
            "mean": lambda: q.mean,
            "variance": lambda: q.variance,
            "divergence": lambda: kl_divergence(q, prior),
        }[what]()

    assert torch.autograd.gradcheck(value, leaves)


def test_divergence_from_another_process_is_refused():
    case, other = make(), make(seed=1)
    q = InducingLTIProcess(case.process, [0, 5], *parameters(2))
    with pytest.raises(NotImplementedError):
        kl_divergence(q, other.process)


def test_finely_sampled():
    # Smooth, all samples inducing: singular but for the jitter.
    modes = Modes([-0.5 + 1.0j, -1.0 + 0.2j], None, [1.0, -1.0], [[1.0], [1.0]])
    prior = LTIProcess(modes, 1e-3 * np.arange(300.0))
    q = InducingLTIProcess(prior, range(300), torch.zeros(300), 0.5 * torch.eye(300))
    torch.manual_seed(0)
    h = q.rsample()
    e = q.whiten(h)
    assert bool(torch.isfinite(q.log_prob(h)))
    assert 0.8 < e.std().item() / 0.5 < 1.2


class TestInducingTimes:
    def test_drawn_without_replacement(self):
        index = inducing_times(np.arange(50.0), 20, seed=3)
        assert index.dtype == torch.int64
        assert index.shape == (20,)
        assert (index.diff() > 0).all()
        assert torch.equal(index, inducing_times(np.arange(50.0), 20, seed=3))
        assert not torch.equal(index, inducing_times(np.arange(50.0), 20, seed=4))

    def test_all_samples(self):
        for time in (np.arange(7.0) - 3.0, [0.0, 0.0, 1.0, 1.0], [2.0, 2.0], [5.0]):
            count = len(time)
            assert inducing_times(time, count).tolist() == list(range(count))

    def test_probabilities(self):
        # Later samples are likelier, by log(1 + t_i / t_n); the clock of the record does not count.
        time = np.array([0.0, 1.0, 2.0, 3.0, 9.0])
        drawn = [inducing_times(time + 100.0, 1, seed=k).item() for k in range(6000)]
        share = np.bincount(drawn, minlength=5) / 6000
        t = time + 9.0 / 4.0
        expected = np.log1p(t / t[-1])
        expected /= expected.sum()
        error = np.sqrt(expected * (1 - expected) / 6000)
        assert (np.abs(share - expected) < 4.5 * error).all()

    @pytest.mark.parametrize("count", [0, 6, 2.0])
    def test_count(self, count):
        with pytest.raises(ValueError, match=r"count.*1 to 5"):
            inducing_times(np.arange(5.0), count)


class TestErrors:
    @pytest.mark.parametrize(
        "index", [[], [3, 1], [1, 1], [-1, 2], [0, 10], [0.0, 1.0], [[0, 1]], [True, False]]
    )
    def test_index(self, index):
        with pytest.raises(ValueError, match="index"):
            InducingLTIProcess(make().process, index, *parameters(2))

    def test_shapes(self):
        loc, scale_tril = parameters(4)
        case = make(outputs=2)
        with pytest.raises(ValueError, match=r"loc.*4.*\(3,\)"):
            InducingLTIProcess(case.process, [0, 5], loc[:3], scale_tril)
        with pytest.raises(ValueError, match=r"scale_tril.*4, 4.*\(4, 3\)"):
            InducingLTIProcess(case.process, [0, 5], loc, scale_tril[:, :3])


def test_dense_normal_of_the_oracle():
    # The oracle's own algebra: conditioning on the inducing values and integrating them out.
    case = make(n=6)
    oracle = Oracle(case, [1, 4], 1e-2)
    loc, scale_tril = parameters(2)
    mean, covariance = oracle.moments(loc, scale_tril)
    R = np.linalg.cholesky(oracle.S[np.ix_([1, 4], [1, 4])])
    assert_close(mean[[1, 4]], case.mean[[1, 4]] + R @ loc)
    assert_close(covariance[np.ix_([1, 4], [1, 4])], R @ scale_tril @ scale_tril.T @ R.T)
    assert isinstance(dense(mean, covariance), MultivariateNormal)
