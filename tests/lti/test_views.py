"""State space, transfer function and responses against scipy.signal and matrix exponentials."""

import hypothesis.strategies as st
import numpy as np
import pytest
import torch
from hypothesis import example, given
from scipy import signal
from scipy.linalg import expm

from pyro_dynogp.lti import views
from pyro_dynogp.lti.covariance import autocovariance, stationary_variance
from pyro_dynogp.lti.modes import Modes
from tests.lti import oracles
from tests.lti.matern import matern32
from tests.lti.oracles import NOISES, assert_close, few, random_system, tensor

OMEGA = np.array([-3.0, 0.0, 0.4, 2.0, 50.0])


def transfer(system, s):
    J = len(system.A)
    return system.C @ np.linalg.solve(s * np.eye(J) - system.A, system.B) + system.D


class TestStateSpace:
    @few
    @given(
        seed=st.integers(0, 1000),
        outputs=st.sampled_from([None, 2]),
        noise=st.sampled_from(NOISES),
    )
    def test_same_transfer_functions_from_inputs_and_from_noise(self, seed, outputs, noise):
        # Two realisations of one system agree in what can be measured, not in their states.
        system = random_system(seed, outputs=outputs, noise=noise)
        ss = views.real_state_space(system.modes)
        eye = np.eye(6)
        for w in OMEGA:
            inner = np.linalg.inv(1j * w * eye - ss.A.numpy())
            assert_close(
                ss.C.numpy() @ inner @ ss.B.numpy() + ss.D.numpy(), transfer(system, 1j * w)
            )
            noise_gain = system.C @ np.linalg.solve(1j * w * eye - system.A, system.L)
            assert_close(ss.C.numpy() @ inner @ ss.L.numpy(), noise_gain)

    def test_is_a_block_diagonal_real_form(self):
        system = random_system(0)
        A = views.real_state_space(system.modes).A.numpy()
        for j, lam in enumerate(system.poles):
            block = A[2 * j : 2 * j + 2, 2 * j : 2 * j + 2]
            assert_close(block, np.array([[lam.real, lam.imag], [-lam.imag, lam.real]]))
        blocks = np.kron(np.eye(3), np.ones((2, 2)))
        assert (A[blocks == 0] == 0).all()

    def test_batch(self):
        modes = random_system(1, outputs=2).modes
        batch = views.real_state_space(modes.expand((4, 2)))
        alone = views.real_state_space(modes)
        for name in ("A", "B", "C", "L"):
            assert_close(getattr(batch, name)[3, 1], getattr(alone, name))


class TestDiscrete:
    @few
    @given(seed=st.integers(0, 1000), step=st.floats(0.01, 3.0), noise=st.sampled_from(NOISES))
    def test_against_scipy(self, seed, step, noise):
        system = random_system(seed, outputs=2, noise=noise)
        d = views.discrete_state_space(system.modes, step)
        A, B, C, D, _ = signal.cont2discrete((system.A, system.B, system.C, system.D), step, "zoh")
        for ours, theirs in ((d.A, A), (d.B, B), (d.C, C), (d.D, D)):
            assert_close(ours, theirs)
        assert_close(d.Q, oracles.sampled_noise(system, step))
        assert_close(d.stationary, system.stationary)
        assert d.step == step

    def test_noise_of_a_short_step(self):
        # The noise of one step is small beside the stationary covariance: Q ~ L L' step.
        system = random_system(2, pairs=1, brownian=2)
        for step in (1e-4, 1e-8):
            Q = views.discrete_state_space(system.modes, step).Q
            assert_close(Q, oracles.sampled_noise(system, step), rtol=1e-9)


class TestTransferFunction:
    def test_against_scipy_signal(self):
        system = random_system(3, pairs=2, outputs=2)
        tf = views.transfer_function(system.modes)
        for i in range(2):  # inputs
            numerators, denominator = signal.ss2tf(system.A, system.B, system.C, system.D, i)
            assert_close(tf.denominator, denominator)
            for a in range(2):  # outputs
                assert_close(tf.numerator[a, i], numerators[a])

    @few
    @given(seed=st.integers(0, 1000), outputs=st.sampled_from([None, 2]))
    def test_frequency_response(self, seed, outputs):
        system = random_system(seed, outputs=outputs)
        expected = np.array([transfer(system, 1j * w) for w in OMEGA])
        assert_close(views.frequency_response(system.modes, OMEGA), expected)
        tf = views.transfer_function(system.modes)
        for w, G in zip(OMEGA, expected, strict=True):
            powers = (1j * w) ** np.arange(6, -1, -1)
            numerator, denominator = tf.numerator.numpy() @ powers, tf.denominator.numpy() @ powers
            assert_close(numerator / denominator, G, rtol=1e-9)

    def test_steady_state_gain(self):
        system = random_system(4, outputs=2)
        assert_close(views.steady_state_gain(system.modes), transfer(system, 0.0))

    def test_batch(self):
        members = [random_system(k, pairs=2) for k in range(2)]
        modes = Modes(
            np.stack([s.poles for s in members]),
            np.stack([s.B_modal for s in members]),
            np.stack([s.c[0] for s in members]),
            None,
            np.stack([s.D[0] for s in members]),
        )
        together = views.transfer_function(modes)
        response = views.frequency_response(modes, OMEGA)
        for k, system in enumerate(members):
            alone = views.transfer_function(system.modes)
            assert_close(together.numerator[k], alone.numerator)
            assert_close(together.denominator[k], alone.denominator)
            assert_close(response[k], views.frequency_response(system.modes, OMEGA))


class TestTimeResponses:
    def test_impulse(self):
        system = random_system(5, outputs=2)
        t = np.array([-1.0, 0.0, 0.3, 2.0])
        expected = np.array([system.C @ expm(system.A * x) @ system.B for x in t])
        expected[0] = 0.0
        assert_close(views.impulse_response(system.modes, t), expected)

    def test_impulse_and_step_of_scipy_signal(self):
        system = random_system(6, inputs=1)
        lti = signal.StateSpace(system.A, system.B, system.C, np.zeros((1, 1)))
        t = np.linspace(0.0, 4.0, 41)
        impulse, step = signal.impulse(lti, T=t)[1], signal.step(lti, T=t)[1]
        assert_close(views.impulse_response(system.modes, t)[:, 0, 0], impulse, rtol=1e-9)
        ours = views.step_response(system.modes, t)[:, 0, 0] - system.D[0, 0]
        assert_close(ours, step, rtol=1e-9)

    def test_step(self):
        system = random_system(7, outputs=2)
        t = np.array([-0.5, 0.0, 1e-9, 0.3, 2.0])
        A = system.A
        expected = np.array(
            [
                system.C @ np.linalg.solve(A, expm(A * x) - np.eye(6)) @ system.B + system.D
                for x in t
            ]
        )
        expected[0] = 0.0
        ours = views.step_response(system.modes, t)
        assert_close(ours, expected)
        far = views.step_response(system.modes, [1e4])[0]
        assert_close(far, transfer(system, 0.0))


class TestMatern32:
    @example(lengthscale=1.0, sd=1.0, split=1e-4)  # the default
    @few
    @given(
        lengthscale=st.floats(1e-3, 1e3),
        sd=st.floats(1e-3, 1e3),
        split=st.sampled_from([1e-4, 1e-3, 1e-2, 0.1]),
    )
    def test_error_bound_of_its_docstring(self, lengthscale, sd, split):
        bound = split**2 + 1e-15 / split**2
        modes = matern32(lengthscale, sd, split=split)
        lag = lengthscale * np.linspace(0.0, 6.0, 200)
        x = np.sqrt(3.0) * lag / lengthscale
        matern = np.exp(-x) * (1.0 + x)
        S = autocovariance(modes, tensor(lag)).numpy()
        assert np.abs(S / sd**2 - matern).max() < bound
        assert stationary_variance(modes).item() == pytest.approx(sd**2, rel=bound)

    def test_noise_enters_like_white_noise_through_a_double_pole(self):
        # The transfer function from noise: sqrt(12 sqrt3/l^3) sd / (s + a)^2.
        lengthscale, sd = 0.8, 1.7
        modes = matern32(lengthscale, sd, split=1e-3)
        as_input = Modes(modes.poles, modes.L, modes.output_gain)
        G = views.frequency_response(as_input, OMEGA)[:, 0, 0].numpy()
        a = np.sqrt(3.0) / lengthscale
        gain = sd * np.sqrt(12.0 * np.sqrt(3.0) / lengthscale**3)
        assert_close(G, gain / (1j * OMEGA + a) ** 2, rtol=1e-5)


def test_gradients_flow():
    system = random_system(8, pairs=2, inputs=1)
    values = [tensor(x).requires_grad_() for x in (system.poles, system.B_modal, system.c[0])]

    def f(poles, B, c):
        modes = Modes(poles, B, c, system.L_modal)
        d = views.discrete_state_space(modes, 0.3)
        t = torch.tensor([0.1, 1.0], dtype=torch.float64)
        return (
            d.A,
            d.B,
            d.Q,
            views.step_response(modes, t),
            views.transfer_function(modes).numerator,
        )

    assert torch.autograd.gradcheck(f, values)
