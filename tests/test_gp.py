"""The system as a GPyTorch kernel and mean: the same model as LTIProcess, and a kernel at all."""

from itertools import pairwise

import gpytorch
import numpy as np
import pytest
import torch

from pyro_dynogp.distributions.process import LTIProcess
from pyro_dynogp.gp import LTIKernel, LTIMean, LTIParameters
from tests.lti import oracles
from tests.lti.oracles import NOISES, assert_close, random_system, tensor

N, NOISE_SD = 25, 0.4


class Stock(gpytorch.models.ExactGP):
    """GPyTorch's own exact GP, as its tutorials write it."""

    def __init__(self, x, y, mean, kernel):
        super().__init__(x, y, gpytorch.likelihoods.GaussianLikelihood().double())
        self.mean_module, self.covar_module = mean, kernel
        self.likelihood.noise = NOISE_SD**2

    def forward(self, x):
        return gpytorch.distributions.MultivariateNormal(self.mean_module(x), self.covar_module(x))


@pytest.fixture(autouse=True)
def exact():
    with gpytorch.settings.fast_computations(False, False, False):
        yield


def case(noise="shared", seed=0):
    system = random_system(seed, pairs=2, noise=noise)
    t, u = oracles.irregular_times(N + 6, seed), oracles.random_inputs(N + 6, 2, seed)
    y = oracles.random_inputs(N + 6, 1, seed + 50)[:, 0]
    return system, t, u, y


def build(parameters, t, u, y, *, columns):
    """The model on the first N samples, and its covariates at all of them."""
    if columns:
        x = tensor(np.column_stack([t, u]))
        mean = LTIMean(parameters)
    else:
        x = tensor(t).unsqueeze(-1)
        mean = LTIMean(parameters, t, u)
    return Stock(x[:N], tensor(y[:N]), mean, LTIKernel(parameters)), x


def noise_of(model):
    """The likelihood's own standard deviation: its constraint works in single precision."""
    return model.likelihood.noise.detach()[0].sqrt()


@pytest.mark.parametrize("columns", [False, True])
@pytest.mark.parametrize("noise", NOISES)
class TestSameModel:
    def test_marginal_likelihood(self, noise, columns):
        system, t, u, y = case(noise)
        model, x = build(LTIParameters(system.modes), t, u, y, columns=columns)
        model.train()
        mll = gpytorch.mlls.ExactMarginalLogLikelihood(model.likelihood, model)
        observed = LTIProcess(system.modes, t[:N], u[:N]).observed(noise_of(model))
        ours = observed.log_prob(tensor(y[:N]))
        theirs = mll(model(x[:N]), tensor(y[:N])) * N  # GPyTorch's is per sample
        assert theirs.item() == pytest.approx(ours.item(), rel=1e-10)

    def test_smoothing_and_forecast(self, noise, columns):
        system, t, u, y = case(noise)
        model, x = build(LTIParameters(system.modes), t, u, y, columns=columns)
        model.eval()
        data = y.copy()
        data[N:] = np.nan
        sd = noise_of(model)
        given = LTIProcess(system.modes, t, u).condition(tensor(data), sd)
        ahead = model(x[N:])
        assert_close(ahead.mean, given.mean[N:])
        assert_close(ahead.variance, given.variance[N:], rtol=1e-9)


def test_prediction_between_samples_in_any_order():
    # Inputs given to LTIMean: the covariate is time alone, so tests may fall anywhere.
    system, t, u, y = case()
    model, _ = build(LTIParameters(system.modes), t, u, y, columns=False)
    model.eval()
    middle = 0.5 * (t[3:8] + t[4:9])
    shuffled = middle[[3, 0, 4, 1, 2]]
    merged = np.concatenate([t, middle])
    order = np.argsort(merged, kind="stable")
    held = np.concatenate([u, u[3:8]])[order]
    data = np.concatenate([np.append(y[:N], np.full(6, np.nan)), np.full(5, np.nan)])[order]
    sd = noise_of(model)
    given = LTIProcess(system.modes, merged[order], held).condition(tensor(data), sd)
    place = np.argsort(order)[-5:][[3, 0, 4, 1, 2]]
    ours = model(tensor(shuffled).unsqueeze(-1))
    assert_close(ours.mean, given.mean[place])
    assert_close(ours.variance, given.variance[place], rtol=1e-9)


class TestKernel:
    @pytest.mark.parametrize("noise", NOISES)
    def test_matrix(self, noise):
        system, t, _, _ = case(noise)
        kernel = LTIKernel(system.modes)
        x, other = tensor(t[::-1]).unsqueeze(-1), tensor(t[:4] + 0.01).unsqueeze(-1)
        K = kernel(x).to_dense()
        assert_close(K, oracles.covariance(system, t[::-1], t[::-1]))
        assert_close(kernel(x, other).to_dense(), oracles.covariance(system, t[::-1], t[:4] + 0.01))
        assert_close(kernel(x, diag=True), K.diagonal())
        assert_close(kernel(other, x[:4], diag=True), kernel(other, x[:4]).to_dense().diagonal())
        assert torch.linalg.eigvalsh(K).min() > 0.0

    def test_a_batch_of_covariates(self):
        system, t, _, _ = case()
        x = tensor(np.stack([t, t + 3.0, 2.0 * t])).unsqueeze(-1)
        K = LTIKernel(system.modes)(x).to_dense()
        assert K.shape == (3, N + 6, N + 6)
        assert_close(K[1], K[0])  # stationary
        assert_close(K[2], oracles.covariance(system, 2.0 * t, 2.0 * t))

    def test_further_columns_are_ignored(self):
        system, t, u, _ = case()
        kernel = LTIKernel(system.modes)
        alone = kernel(tensor(t).unsqueeze(-1)).to_dense()
        assert_close(kernel(tensor(np.column_stack([t, u]))).to_dense(), alone)

    def test_sums_with_stock_kernels(self):
        system, t, _, _ = case()
        x = tensor(t).unsqueeze(-1)
        other = gpytorch.kernels.RBFKernel().double()
        both = (LTIKernel(system.modes) + gpytorch.kernels.ScaleKernel(other).double())(x)
        rest = gpytorch.kernels.ScaleKernel(other).double()(x).to_dense()
        assert_close(both.to_dense(), tensor(oracles.covariance(system, t, t)) + rest)


class TestMean:
    @pytest.mark.parametrize("columns", [False, True])
    def test_times_in_any_order(self, columns):
        system, t, u, _ = case()
        expected = oracles.mean(system, t, u)[0][:, 0]
        order = np.random.default_rng(0).permutation(len(t))
        if columns:
            m = LTIMean(system.modes)(tensor(np.column_stack([t, u])[order]))
        else:
            m = LTIMean(system.modes, t, u)(tensor(t[order]))
        assert_close(m, expected[order])

    def test_one_input_as_a_vector(self):
        system = random_system(1, inputs=1)
        t, u = oracles.irregular_times(8), oracles.random_inputs(8, 1)
        m = LTIMean(system.modes, t, u[:, 0])(tensor(t))
        assert_close(m, oracles.mean(system, t, u)[0][:, 0])

    def test_last_input_is_held(self):
        system, t, u, _ = case()
        later = np.append(t, t[-1] + 5.0)
        expected = oracles.mean(system, later, np.vstack([u, u[-1]]))[0][-1]
        assert_close(LTIMean(system.modes, t, u)(tensor(later[-1:])), expected)

    def test_errors(self):
        system, t, u, _ = case()
        with pytest.raises(ValueError, match=r"time, inputs.*both or neither"):
            LTIMean(system.modes, t)
        mean = LTIMean(system.modes, t, u)
        with pytest.raises(ValueError, match="from"):
            mean(tensor([t[0] - 1.0]))
        with pytest.raises(ValueError, match=r"x.*without batches"):
            mean(torch.zeros(2, 5, 1, dtype=torch.float64))
        with pytest.raises(ValueError, match=r"inputs.*2 inputs|inputs.*column"):
            LTIMean(system.modes)(tensor(t).unsqueeze(-1))


class TestParameters:
    def test_start_where_the_modes_are(self):
        for noise in NOISES:
            modes = case(noise)[0].modes
            again = LTIParameters(modes).modes
            assert again.noise == noise
            for name in ("poles", "B", "C", "L", "D"):
                assert_close(getattr(again, name), getattr(modes, name), rtol=1e-14)

    def test_errors(self):
        modes = case()[0].modes
        with pytest.raises(ValueError, match=r"modes.*no batch"):
            LTIParameters(modes.expand((3,)))
        with pytest.raises(ValueError, match=r"modes.*one output"):
            LTIParameters(random_system(0, outputs=2).modes)

    def test_shared_ones_are_trained(self):
        system, t, u, y = case()
        parameters = LTIParameters(system.modes)
        model, x = build(parameters, t, u, y, columns=False)
        assert model.mean_module.system is model.covar_module.system
        names = [name for name, _ in model.named_parameters()]
        assert sum("log_decay" in name for name in names) == 1
        model.train()
        mll = gpytorch.mlls.ExactMarginalLogLikelihood(model.likelihood, model)
        optimizer = torch.optim.Adam(model.parameters(), lr=0.02)
        losses = []
        for _ in range(8):
            optimizer.zero_grad()
            loss = -mll(model(x[:N]), tensor(y[:N]))
            loss.backward()
            losses.append(loss.item())
            for parameter in parameters.parameters():
                assert (parameter.grad != 0.0).any()
            optimizer.step()
        assert all(later < earlier for earlier, later in pairwise(losses))
        # What was learnt is the system that the O(n) path sees, too.
        ours = LTIProcess(parameters.modes, t[:N], u[:N]).observed(noise_of(model))
        expected = mll(model(x[:N]), tensor(y[:N])).item() * N
        assert ours.log_prob(tensor(y[:N])).item() == pytest.approx(expected, rel=1e-9)

    def test_stable_for_any_parameter(self):
        parameters = LTIParameters(case()[0].modes)
        with torch.no_grad():
            parameters.log_decay.fill_(-30.0)
        assert (parameters.modes.poles.real < 0).all()

    def test_state_dict_round_trip(self):
        system, t, u, y = case()
        model, x = build(LTIParameters(system.modes), t, u, y, columns=False)
        other = build(LTIParameters(random_system(9, pairs=2).modes), t, u, y, columns=False)[0]
        other.load_state_dict(model.state_dict())
        for m in (model, other):
            m.eval()
        expected = model(x[N:])
        assert_close(other(x[N:]).mean, expected.mean, rtol=1e-14)
        assert_close(other(x[N:]).covariance_matrix, expected.covariance_matrix, rtol=1e-14)
