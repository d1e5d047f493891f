"""The paper's printed formulas that are wrong: each print fails the oracle that the package passes.

Every printed form is written out from the text of "dynoGP: Deep Gaussian Processes for dynamic
system identification", section "Stochastic linear dynamical systems", in its own notation.
"""

import numpy as np
import pytest
from scipy.linalg import expm, solve_continuous_lyapunov

from pyro_dynogp.lti.covariance import autocovariance
from pyro_dynogp.lti.response import mean_response
from pyro_dynogp.lti.views import real_state_space
from tests.lti import oracles
from tests.lti.matern import matern32
from tests.lti.oracles import NOISES, assert_close, random_system, tensor

TAU = np.array([0.0, 0.1, 0.6, 2.0])


def stacked(system):
    """The complex system of 2P states, each pair beside its conjugate: A_c, B_c, C_c, L_c."""

    def interleave(x):
        return np.stack([x, x.conj()], 1).reshape(2 * len(x), *x.shape[1:])

    return (
        np.diag(interleave(system.poles)),
        interleave(system.B_modal),
        interleave(system.c[0])[None],
        interleave(system.L_modal),
    )


def kernel(A, C, L, lags):
    """C exp(A tau) Sigma C^H for tau >= 0, Sigma from the Lyapunov equation."""
    Sigma = solve_continuous_lyapunov(A, -L @ L.conj().T)
    return np.array([(C @ expm(A * tau) @ Sigma @ C.conj().T)[0, 0] for tau in lags])


def relative_error(x, expected):
    return np.abs(np.asarray(x) - expected).max() / np.abs(expected).max()


@pytest.mark.parametrize("seed", [0, 1])
def test_1_sign_of_the_real_output_matrix(seed):
    """Equation (14): C_r = [sqrt2 Re c, -sqrt2 Im c]; the minus has to be a plus."""
    system = random_system(seed, pairs=1)
    lam, c, L = system.poles[0], system.c[0, 0], system.L_modal
    A_r = np.array([[lam.real, lam.imag], [-lam.imag, lam.real]])
    L_r = np.sqrt(2) * np.vstack([L.real, -L.imag])
    printed = np.sqrt(2) * np.array([[c.real, -c.imag]])
    A_c, _, C_c, L_c = stacked(system)
    expected = kernel(A_c, C_c, L_c, TAU)
    assert np.abs(expected.imag).max() < 1e-12 * np.abs(expected).max()
    assert relative_error(kernel(A_r, printed, L_r, TAU), expected.real) > 0.05

    ours = real_state_space(system.modes)
    assert_close(ours.A, A_r)
    assert_close(ours.L, L_r)
    assert_close(kernel(*(x.numpy() for x in (ours.A, ours.C, ours.L)), TAU), expected.real)
    assert_close(autocovariance(system.modes, tensor(TAU)), expected.real)


def terms(system, j=0):
    """The four covariance terms of Proposition 1, without their exponentials."""
    lam, c, L = system.poles[j], system.c[0, j], system.L_modal[j]
    lam_, c_, L_ = lam.conj(), c.conj(), L.conj()
    return (
        -c * (L @ L_) * c_ / (lam + lam_),
        -c_ * (L_ @ L_) * c_ / (2 * lam_),
        -c * (L @ L) * c / (2 * lam),
        -c_ * (L_ @ L) * c / (lam + lam_),
    )


def proposition_1(system, tau, j=0):
    """Both printed branches of the kernel, t' > t and t' < t, at tau = |t' - t|."""
    a, b, c, d = terms(system, j)
    up, up_ = np.exp(system.poles[j] * tau), np.exp(system.poles[j].conj() * tau)
    return up_ * (a + b) + up * (c + d), up_ * a + up * b + up_ * c + up * d


@pytest.mark.parametrize("seed", [0, 1])
def test_2_proposition_1_is_not_symmetric(seed):
    """Proposition 1: the branch t' < t has two exponents exchanged."""
    system = random_system(seed, pairs=1)
    forward, backward = proposition_1(system, TAU)
    expected = oracles.covariance(system, TAU, [0.0])[:, 0]
    assert_close(forward.real, expected)
    assert relative_error(backward, expected) > 0.05
    assert relative_error(backward, forward) > 0.05
    for sign in (1, -1):
        assert_close(autocovariance(system.modes, tensor(sign * TAU)), expected)


def test_3_mean_function_pairs_the_wrong_input():
    """Proposition 2: u(i delta) stands where a convolution has u((k - i) delta)."""
    system = random_system(2, pairs=1, inputs=1)
    lam, c, B, delta = system.poles[0], system.c[0, 0], system.B_modal[0], 0.3
    u = oracles.random_inputs(9, 1)

    def sum_formula(which):
        m = []
        for k in range(len(u)):
            total = sum(
                c / lam * np.exp(lam * (i - 1) * delta) * np.expm1(lam * delta) * B @ u[which(k, i)]
                for i in range(1, k + 1)
            )
            m.append(2 * np.real(total) + system.D[0] @ u[k])
        return np.array(m)

    t = delta * np.arange(len(u))
    expected = oracles.mean(system, t, u)[0][:, 0]
    assert relative_error(sum_formula(lambda k, i: i), expected) > 0.1
    assert_close(sum_formula(lambda k, i: k - i), expected)
    assert_close(mean_response(system.modes, t, u).output, expected)


def test_3_state_space_mean_holds_the_last_input():
    """Equation (13), above Proposition 2, has u(k delta) in every term of its sum."""
    system = random_system(2, inputs=1)
    delta, u = 0.3, oracles.random_inputs(9, 1)
    Abar = expm(system.A * delta)
    Bbar = (Abar - np.eye(len(Abar))) @ np.linalg.solve(system.A, system.B)
    printed = [
        sum(
            (system.C @ np.linalg.matrix_power(Abar, i - 1) @ Bbar @ u[k])[0]
            for i in range(1, k + 1)
        )
        + system.D[0] @ u[k]
        for k in range(len(u))
    ]
    expected = oracles.mean(system, delta * np.arange(len(u)), u)[0][:, 0]
    assert relative_error(printed, expected) > 0.1


def test_4_proposition_3_is_the_independent_noise_kernel():
    """Proposition 3: its sum over pairs is not the kernel of the system printed above it."""
    shared, independent = (random_system(3, noise=noise) for noise in NOISES)
    pairs = len(shared.poles)
    printed = sum(proposition_1(shared, TAU, j)[0] for j in range(pairs)).real
    # One and the same d beta drives every row of the printed system.
    A_c, _, C_c, L_c = stacked(shared)
    one_beta = kernel(A_c, C_c, L_c, TAU).real
    assert relative_error(printed, one_beta) > 0.1
    assert_close(autocovariance(shared.modes, tensor(TAU)), one_beta)
    assert_close(autocovariance(independent.modes, tensor(TAU)), printed)


def test_4_sums_run_over_pairs_not_states():
    """Proposition 3 sums to n_s; with both poles of each pair counted the mean doubles."""
    system = random_system(4, pairs=2, inputs=1)
    delta, u = 0.2, oracles.random_inputs(6, 1)
    lam = np.concatenate([system.poles, system.poles.conj()])
    c = np.concatenate([system.c[0], system.c[0].conj()])
    B = np.concatenate([system.B_modal, system.B_modal.conj()])[:, 0]

    def additive(count):  # of the first `count` poles, the input paired rightly
        gain = c[:count] * np.expm1(lam[:count] * delta) / lam[:count] * B[:count]
        m = []
        for k in range(len(u)):
            total = sum(
                (gain * np.exp(lam[:count] * (i - 1) * delta)).sum() * u[k - i, 0]
                for i in range(1, k + 1)
            )
            m.append(2 * np.real(total) + system.D[0] @ u[k])
        return np.array(m)

    expected = oracles.mean(system, delta * np.arange(6), u)[0][:, 0]
    assert relative_error(additive(4), expected) > 0.1
    assert_close(additive(2), expected)
    assert_close(mean_response(system.modes, delta * np.arange(6), u).output, expected)


@pytest.mark.parametrize("lengthscale", [0.3, 2.0])
def test_5_matern_example_has_too_large_a_variance(lengthscale):
    """Example 1: L = sigma [0, sqrt(36/l^3)] gives sqrt(3) sigma^2; sqrt(12 sqrt3/l^3) is right."""
    sigma = 0.7
    A = np.array([[0.0, 1.0], [-3.0 / lengthscale**2, -2.0 * np.sqrt(3.0) / lengthscale]])
    C = np.array([[1.0, 0.0]])
    x = np.sqrt(3.0) * TAU / lengthscale
    matern = sigma**2 * np.exp(-x) * (1.0 + x)
    printed = kernel(A, C, sigma * np.array([[0.0], [np.sqrt(36.0 / lengthscale**3)]]), TAU)
    assert_close(printed, np.sqrt(3.0) * matern)
    gain = np.sqrt(12.0 * np.sqrt(3.0) / lengthscale**3)
    assert_close(kernel(A, C, sigma * np.array([[0.0], [gain]]), TAU), matern)
    # Ours splits the double pole a little: see its docstring for the error.
    assert_close(autocovariance(matern32(lengthscale, sigma), tensor(TAU)), matern, rtol=5e-8)
    assert_close(
        autocovariance(matern32(lengthscale, sigma, split=1e-2), tensor(TAU)), matern, rtol=1e-4
    )
