"""The same model in statsmodels: its Kalman filter and smoother give the same numbers.

The state-space matrices come from `discrete_state_space`, which test_views.py holds against matrix
exponentials; here they tie the O(n) algebra to an independent filter.
"""

from dataclasses import dataclass

import numpy as np
import pytest
from statsmodels.tsa.statespace.kalman_smoother import KalmanSmoother

from pyro_dynogp.lti.filtering import predict_k_steps
from pyro_dynogp.lti.response import mean_response
from pyro_dynogp.lti.semiseparable import SemiseparableCovariance
from pyro_dynogp.lti.views import discrete_state_space
from tests.lti import oracles
from tests.lti.oracles import NOISES, assert_close, random_system, tensor

STEP, NOISE_SD = 0.2, 0.3


@dataclass
class Case:
    system: oracles.System
    y: np.ndarray  # (n, n_y), NaN where missing
    u: np.ndarray
    P0: np.ndarray | None
    z0: np.ndarray

    @property
    def time(self):
        return STEP * np.arange(len(self.y))

    def filter(self, y=None):
        y = self.y if y is None else y
        d = discrete_state_space(self.system.modes, STEP)
        J, n_y = len(d.A), y.shape[1]
        model = KalmanSmoother(k_endog=n_y, k_states=J, k_posdef=J)
        model.tolerance = 0.0  # no short cut to a steady state
        model.bind(np.array(y))
        model["design"], model["transition"] = d.C.numpy(), d.A.numpy()
        model["selection"], model["state_cov"] = np.eye(J), d.Q.numpy()
        model["state_intercept"] = d.B.numpy() @ self.u.T
        model["obs_intercept"] = d.D.numpy() @ self.u.T
        model["obs_cov"] = NOISE_SD**2 * np.eye(n_y)
        P0 = d.stationary.numpy() if self.P0 is None else self.P0
        model.initialize_known(self.z0, P0)
        return model

    @property
    def response(self):
        P = len(self.z0) // 2
        x0 = self.z0[:P] + 1j * self.z0[P:]
        m = mean_response(self.system.modes, self.time, self.u, x0)
        return m.output.numpy().reshape(self.y.shape)

    @property
    def covariance(self):
        v = np.where(np.isnan(self.y), np.inf, NOISE_SD**2).reshape(-1)
        P0 = None if self.P0 is None else tensor(self.P0)
        return SemiseparableCovariance(self.system.modes, self.time, tensor(v), P0)

    @property
    def residual(self):
        return tensor(np.nan_to_num(self.y - self.response).reshape(-1))


@pytest.fixture(params=["plain", "known start", "independent", "two outputs", "missing"])
def case(request):
    kind, n = request.param, 40
    outputs = 2 if kind in ("two outputs", "missing") else None
    noise = NOISES[kind == "independent"]
    system = random_system(2, pairs=2, outputs=outputs, noise=noise)
    rng = np.random.default_rng(0)
    y = 2.0 * rng.standard_normal((n, outputs or 1))
    if kind == "missing":
        y[[0, 7, 8]] = np.nan
        y[20, 1] = y[39, 0] = np.nan
    known = kind in ("known start", "missing")
    P0 = oracles.random_covariance(4) if known else None
    z0 = rng.standard_normal(4) if known else np.zeros(4)
    return Case(system, y, oracles.random_inputs(n, 2), P0, z0)


def test_log_likelihood(case):
    expected = case.filter().loglike()
    ours = case.covariance.log_prob(case.residual.unsqueeze(-1)).item()
    assert ours == pytest.approx(expected, rel=1e-11)


def test_stationary_initialisation():
    # Without inputs statsmodels finds the stationary covariance itself.
    system = random_system(3, pairs=2)
    case = Case(system, oracles.random_inputs(30, 1, 5), np.zeros((30, 2)), None, np.zeros(4))
    model = case.filter()
    model["state_intercept"], model["obs_intercept"] = np.zeros((4, 1)), np.zeros((1, 1))
    model.initialize_stationary()
    ours = case.covariance.log_prob(case.residual.unsqueeze(-1)).item()
    assert ours == pytest.approx(model.loglike(), rel=1e-9)


def test_smoothed_signal(case):
    smoothed = case.filter().smooth()
    C, D = case.system.C, case.system.D
    mean = smoothed.smoothed_state.T @ C.T + case.u @ D.T
    variance = np.einsum("ai,ijn,aj->na", C, smoothed.smoothed_state_cov, C)
    K = case.covariance
    update = K.signal_matmul(K.solve(case.residual.unsqueeze(-1)))
    assert_close(case.response + update.numpy().reshape(case.y.shape), mean)
    assert_close(K.signal_variance(), variance.reshape(-1))


def test_final_state(case):
    filtered = case.filter().filter()
    K = case.covariance
    assert_close(K.final_covariance, filtered.filtered_state_cov[..., -1])
    x = K.final_state(case.residual).numpy()
    P = len(case.z0) // 2
    x0 = case.z0[:P] + 1j * case.z0[P:]
    x = x + mean_response(case.system.modes, case.time, case.u, x0).state.numpy()
    assert_close(np.concatenate([x.real, x.imag]), filtered.filtered_state[:, -1])


@pytest.mark.parametrize("horizon", [1, 3, 12])
def test_predictions(case, horizon):
    # The k-step prediction of sample j is the forecast of a filter that has seen y up to j - k.
    n, n_y = case.y.shape
    mean, variance = np.empty((n, n_y)), np.empty((n, n_y))
    for j in range(n):
        known = case.y.copy()
        known[max(j - horizon + 1, 0) :] = np.nan
        filtered = case.filter(known).filter()
        z, P = filtered.predicted_state[:, j], filtered.predicted_state_cov[..., j]
        mean[j] = case.system.C @ z + case.system.D @ case.u[j]
        variance[j] = np.diag(case.system.C @ P @ case.system.C.T)
    ours = predict_k_steps(case.covariance, case.residual, horizon)
    assert_close(case.response + ours.mean.numpy().reshape(n, n_y), mean)
    assert_close(ours.variance.reshape(n, n_y), variance)


@pytest.mark.parametrize("case", ["plain", "known start", "independent"], indirect=True)
def test_innovations(case):
    # Forecast errors and their variances; one output, for statsmodels takes those of a time
    # together and we take one after the other.
    filtered = case.filter().filter()
    ours = case.covariance.innovations(case.residual.unsqueeze(-1))[:, 0]
    assert_close(ours, filtered.forecasts_error[0])
    assert_close(case.covariance.innovation_variance, filtered.forecasts_error_cov[0, 0])
