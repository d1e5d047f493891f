"""Stationary covariance against Lyapunov equations, matrix exponentials, spectra and simulation."""

import hypothesis.strategies as st
import numpy as np
import pytest
import torch
from hypothesis import given
from scipy.integrate import quad
from scipy.linalg import expm

from pyro_dynogp.lti.covariance import (
    autocovariance,
    output_row,
    real_covariance,
    state_covariance,
    state_output_covariance,
    stationary_variance,
)
from pyro_dynogp.lti.modes import Modes
from tests.lti import oracles
from tests.lti.oracles import NOISES, assert_close, few, random_system, tensor

LAGS = np.array([-3.0, -0.4, -1e-3, 0.0, 1e-3, 0.7, 2.5])


@few
@given(seed=st.integers(0, 1000), pairs=st.integers(1, 4), noise=st.sampled_from(NOISES))
def test_state_covariance_solves_the_lyapunov_equation(seed, pairs, noise):
    system = random_system(seed, pairs=pairs, noise=noise)
    assert_close(state_covariance(system.modes), system.stationary)


@pytest.mark.parametrize("noise", NOISES)
def test_state_and_output(noise):
    system = random_system(1, outputs=3, noise=noise)
    q = state_output_covariance(system.modes).numpy()  # n_y, P
    expected = system.C @ system.stationary
    assert_close(np.hstack([q.real, q.imag]), expected)
    assert_close(output_row(system.modes), system.C)
    assert_close(stationary_variance(system.modes), np.diag(expected @ system.C.T))


def test_noise_structures_differ_for_several_pairs_only():
    shared, independent = (random_system(2, noise=noise) for noise in NOISES)
    one, other = (stationary_variance(s.modes).item() for s in (shared, independent))
    assert abs(one - other) > 0.1 * other
    shared, independent = (random_system(2, pairs=1, noise=noise) for noise in NOISES)
    assert_close(stationary_variance(shared.modes), stationary_variance(independent.modes))


def test_real_covariance_of_sampled_complex_numbers():
    # Any Hermitian and symmetric second moments, of data rather than of a system.
    rng = np.random.default_rng(0)
    x = rng.standard_normal((50, 3)) + 1j * rng.standard_normal((50, 3)) @ rng.standard_normal(
        (3, 3)
    )
    z = np.hstack([x.real, x.imag])
    moments = (tensor(x.T @ x.conj() / 50), tensor(x.T @ x / 50))
    assert_close(real_covariance(*moments), z.T @ z / 50)


class TestAutocovariance:
    @few
    @given(
        seed=st.integers(0, 1000),
        outputs=st.sampled_from([None, 1, 3]),
        noise=st.sampled_from(NOISES),
    )
    def test_against_the_matrix_exponential(self, seed, outputs, noise):
        system = random_system(seed, outputs=outputs, noise=noise)
        n_y = outputs or 1
        expected = oracles.covariance(system, LAGS, [0.0]).reshape(len(LAGS), n_y, n_y)
        if outputs is None:
            expected = expected[:, 0, 0]
        assert_close(autocovariance(system.modes, tensor(LAGS)), expected)

    @few
    @given(lag=st.floats(-50, 50), noise=st.sampled_from(NOISES))
    def test_reversing_time_transposes(self, lag, noise):
        modes = random_system(3, outputs=2, noise=noise).modes
        S = autocovariance(modes, torch.tensor([lag, -lag], dtype=torch.float64))
        torch.testing.assert_close(S[0], S[1].mT, rtol=1e-13, atol=0.0)

    def test_shape_of_lag_and_batch(self):
        modes = random_system(4, outputs=2).modes.expand((5,))
        assert autocovariance(modes, torch.zeros(3, 4)).shape == (5, 3, 4, 2, 2)
        assert autocovariance(modes, torch.tensor(0.2)).shape == (5, 2, 2)
        one = random_system(4).modes
        assert autocovariance(one, torch.zeros(3, 4)).shape == (3, 4)

    @pytest.mark.parametrize("noise", NOISES)
    def test_is_the_inverse_fourier_transform_of_the_spectrum(self, noise):
        system = random_system(5, pairs=2, outputs=2, noise=noise)
        G = spectrum(system)
        for tau in (0.3, 1.7):
            # S_ab(tau) = (1/pi) int_0^inf Re(G_ab) cos(w tau) - Im(G_ab) sin(w tau) dw
            even = fourier(lambda w: G(w)[0, 1].real, "cos", tau)
            odd = fourier(lambda w: G(w)[0, 1].imag, "sin", tau)
            ours = autocovariance(system.modes, torch.tensor([tau], dtype=torch.float64))[0]
            assert ours[0, 1].item() == pytest.approx((even - odd) / np.pi, rel=1e-7)
        variance = quad(lambda w: G(w)[0, 0].real, 0, np.inf, epsabs=1e-12, limit=500)[0] / np.pi
        assert stationary_variance(system.modes)[0].item() == pytest.approx(variance, rel=1e-8)


def fourier(f, weight, tau):
    return quad(f, 0, np.inf, weight=weight, wvar=tau, epsabs=1e-10, limlst=200, limit=500)[0]


def spectrum(system):
    eye = np.eye(system.A.shape[0])

    def G(w):
        transfer = system.C @ np.linalg.solve(1j * w * eye - system.A, system.L)
        return transfer @ transfer.conj().T

    return G


def test_stationary_variance_by_simulation():
    # From rest, long enough to forget it; independent paths, so the standard error is that of a
    # sample variance of independent normals.
    system = random_system(7, pairs=2, noise="shared")
    step, paths = 0.5, 40_000
    steps = int(np.ceil(12.0 / -system.poles.real.max() / step))
    F, root = expm(system.A * step), np.linalg.cholesky(oracles.sampled_noise(system, step))
    rng = np.random.default_rng(0)
    z = np.zeros((4, paths))
    for _ in range(steps):
        z = F @ z + root @ rng.standard_normal((4, paths))
    sampled = np.mean((system.C @ z) ** 2)
    exact = stationary_variance(system.modes).item()
    standard_error = exact * np.sqrt(2.0 / paths)
    assert standard_error < 0.01 * exact
    assert abs(sampled - exact) < 4.0 * standard_error


def test_gradient():
    system = random_system(8, pairs=2, inputs=1, outputs=2, brownian=1)
    values = [tensor(x).requires_grad_() for x in (system.poles, system.c, system.L_modal)]

    def f(poles, c, L):
        modes = Modes(poles, output_gain=c, noise_gain=L, noise="shared")
        return autocovariance(modes, tensor([-0.4, 0.0, 0.9])), state_covariance(modes)

    assert torch.autograd.gradcheck(f, values)
