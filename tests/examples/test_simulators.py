"""Simulators against oracles that share no code with them."""

import re

import numpy as np
import pytest
from scipy.integrate import quad_vec, solve_ivp
from scipy.linalg import expm, solve_continuous_lyapunov
from scipy.signal import cont2discrete, lsim

from pyro_dynogp.examples.simulators import (
    discretise,
    simulate_lti,
    simulate_states,
    simulate_wiener,
)

SIMULATORS = [simulate_lti, simulate_wiener]


def refused(*parts):
    return pytest.raises(ValueError, match=".*".join(map(re.escape, parts)))


def system(seed=0, n=3):
    rng = np.random.default_rng(seed)
    A = rng.standard_normal((n, n)) - 3 * np.eye(n)
    return A, rng.standard_normal((n, 2)), rng.standard_normal((n, 1))


class TestDiscretise:
    def test_transition_and_input(self):
        A, B, L = system()
        Ad, Bd, _ = discretise(A, B, L, 0.3)
        expected = cont2discrete((A, B, np.eye(3), np.zeros((3, 2))), 0.3, method="zoh")
        np.testing.assert_allclose(Ad, expected[0], rtol=1e-12, atol=1e-14)
        np.testing.assert_allclose(Bd, expected[1], rtol=1e-12, atol=1e-14)

    @pytest.mark.parametrize("step", [1e-3, 0.3, 4.0])
    def test_noise_covariance_by_quadrature(self, step):
        A, B, L = system()
        Q = discretise(A, B, L, step)[2]
        expected = quad_vec(
            lambda s: expm(A * s) @ L @ L.T @ expm(A * s).T, 0, step, epsabs=1e-14, epsrel=1e-11
        )[0]
        np.testing.assert_allclose(Q, expected, rtol=1e-9, atol=1e-13)

    def test_noise_covariance_by_the_stationary_one(self):
        A, B, L = system(1)
        Ad, _, Q = discretise(A, B, L, 0.3)
        stationary = solve_continuous_lyapunov(A, -L @ L.T)
        np.testing.assert_allclose(Q, stationary - Ad @ stationary @ Ad.T, rtol=1e-9, atol=1e-13)

    def test_stiff_system(self):
        # exp(-A step) is 1e26 here: the block exponential over the whole step has no digit left.
        A, B, L = np.diag([-6000.0, -3.0]), np.zeros((2, 1)), np.array([[1.0], [0.5]])
        Q = discretise(A, B, L, 0.01)[2]
        rates = -np.add.outer(np.diag(A), np.diag(A))
        expected = L @ L.T * -np.expm1(-rates * 0.01) / rates
        np.testing.assert_allclose(Q, expected, rtol=1e-10)

    def test_zero_step_limit(self):
        A, B, L = system()
        Ad, Bd, Q = discretise(A, B, L, 1e-9)
        np.testing.assert_allclose(Q, L @ L.T * 1e-9, rtol=1e-6)
        np.testing.assert_allclose(Bd, B * 1e-9, rtol=1e-6)
        np.testing.assert_allclose(Ad, np.eye(3), atol=1e-7)


class TestStates:
    def test_response_to_held_inputs(self):
        A, B, L = system()
        rng = np.random.default_rng(5)
        inputs, step = rng.standard_normal((6, 2)), 0.2
        states = simulate_states(A, B, 0 * L, inputs, step, rng)
        x = np.zeros(3)
        for k in range(5):
            np.testing.assert_allclose(states[k], x, rtol=1e-8, atol=1e-10)
            flow = solve_ivp(
                lambda t, x, u=inputs[k]: A @ x + B @ u, (0, step), x, rtol=1e-11, atol=1e-13
            )
            x = flow.y[:, -1]

    def test_stationary_covariance(self):
        # Samples 6 s apart share exp(-12) of their variance: independent draws of the stationary
        # state, so the standard error of their covariance is known.
        A, B, L = np.array([[-2.0, 1.0], [0.0, -3.0]]), np.zeros((2, 1)), np.array([[0.5], [1.0]])
        rng = np.random.default_rng(11)
        last = simulate_states(A, B, L, np.zeros((80_004, 1)), 1.5, rng)[4::4]
        draws = len(last)
        assert draws == 20_000
        S = solve_continuous_lyapunov(A, -L @ L.T)
        error = np.sqrt((S**2 + np.outer(np.diag(S), np.diag(S))) / draws)
        deviation = (last.T @ last / draws - S) / error
        assert np.abs(deviation).max() < 4  # the chance of more is 2e-4
        assert np.abs(last.mean(0) / np.sqrt(np.diag(S) / draws)).max() < 4

    def test_noise_stops(self):
        A, B, L = system()
        inputs = np.random.default_rng(1).standard_normal((30, 2))
        states = simulate_states(A, B, L, inputs, 0.1, np.random.default_rng(2), noisy_samples=20)
        Ad, Bd, _ = discretise(A, B, L, 0.1)
        innovation = np.abs(states[1:] - states[:-1] @ Ad.T - inputs[:-1] @ Bd.T).max(axis=1)
        assert innovation[:19].min() > 1e-6
        assert innovation[19:].max() < 1e-12


@pytest.mark.parametrize("simulate", SIMULATORS)
class TestBoth:
    def test_shapes_and_clock(self, simulate):
        run = simulate(0)
        assert (len(run.train), len(run.test), len(run.full)) == (1500, 1000, 2500)
        assert run.full.duration == pytest.approx(24.99)
        assert run.test.time[0] == pytest.approx(15.0)
        t = run.full.time
        expected = np.column_stack([np.sin(3 * np.pi * t), np.sin(5 * np.pi * t)])
        np.testing.assert_allclose(run.full.inputs, expected, atol=1e-15)

    def test_seed(self, simulate):
        assert simulate(3).full == simulate(3).full
        assert simulate(3).full != simulate(4).full

    def test_stable_and_read_only(self, simulate):
        for seed in range(5):
            assert simulate(seed).truth.poles.real.max() < 0
        with pytest.raises(ValueError, match="read-only"):
            simulate(0).truth.A[0, 0] = 1

    def test_measurement_noise(self, simulate):
        for seed in range(3):
            run = simulate(seed)
            truth = run.truth
            clean = np.concatenate([truth.clean_train, truth.clean_test])
            assert truth.noise_sd == pytest.approx(0.1 * clean.std(), rel=1e-12)
            noise = (run.full.outputs[:, 0] - clean) / truth.noise_sd
            assert abs(noise.mean()) < 4 / np.sqrt(2500)
            assert abs(noise.var() - 1) < 4 * np.sqrt(2 / 2500)
            assert abs(np.mean(noise[1:] * noise[:-1])) < 4 / np.sqrt(2500)

    def test_no_measurement_noise(self, simulate):
        run = simulate(0, noise_ratio=0.0)
        np.testing.assert_array_equal(run.train.outputs[:, 0], run.truth.clean_train)

    def test_test_part_goes_on_without_process_noise(self, simulate):
        run = simulate(1)
        truth = run.truth
        Ad, Bd, _ = discretise(truth.A, truth.B, truth.L, 0.01)
        x = Ad @ truth.final_state + Bd @ run.train.inputs[-1]
        assert (truth.C @ truth.final_state).item() == pytest.approx(truth.linear_train[-1])
        for k in range(1000):
            assert (truth.C @ x).item() == pytest.approx(truth.linear_test[k], abs=1e-9)
            x = Ad @ x + Bd @ run.test.inputs[k]

    def test_training_part_is_the_driven_response_and_process_noise(self, simulate):
        run = simulate(2)
        truth = run.truth
        # Held inputs as an independent program has them: first-order holds are off.
        plant = (truth.A, truth.B, truth.C, truth.D)
        quiet = lsim(plant, run.full.inputs, run.full.time, interp=False)[1]
        noise = truth.linear_train - quiet[:1500]
        S = (truth.C @ solve_continuous_lyapunov(truth.A, -truth.L @ truth.L.T) @ truth.C.T).item()
        assert truth.process_noise_share == pytest.approx(S / (S + quiet.var()), rel=1e-9)
        # Autocorrelated noise of a few seconds' memory: a wide band, yet far from 0 and from 2 S.
        assert 0.3 < np.mean(noise**2) / S < 2.5
        assert np.abs(noise[0]) == 0

    def test_refusals(self, simulate):
        for seed in (-1, 1.5, None, True):
            with refused("seed", "zero or positive", repr(seed)):
                simulate(seed)
        for k in (1, 10, 11):
            with refused("training_samples", "2 and samples - 1 = 9", str(k)):
                simulate(0, samples=10, training_samples=k)
        with refused("sampling_time", "positive", "0"):
            simulate(0, sampling_time=0)
        with refused("noise_ratio", "zero or a positive", "-1"):
            simulate(0, noise_ratio=-1)


def test_lti_truth():
    for seed in range(8):
        run = simulate_lti(seed)
        truth = run.truth
        assert truth.A.shape == (10, 10)
        assert 0.001 <= truth.process_noise_share <= 0.01
        poles = truth.poles
        assert len(np.unique(np.round(poles.imag, 9))) == 10  # five pairs, none real
        frequency, damping = np.abs(poles), -poles.real / np.abs(poles)
        assert ((frequency >= 1) & (frequency <= 25)).all()
        assert ((damping >= 0.2 - 1e-9) & (damping <= 0.9 + 1e-9)).all()
        np.testing.assert_array_equal(truth.clean_train, truth.linear_train)


def test_lti_pairs_contribute_comparably():
    truth, full = simulate_lti(4).truth, simulate_lti(4).full
    states = simulate_states(
        truth.A, truth.B, truth.L, full.inputs, 0.01, np.random.default_rng(0), noisy_samples=0
    )
    spread = [
        (states[:, [2 * j, 2 * j + 1]] @ truth.C[0, [2 * j, 2 * j + 1]]).std() for j in range(5)
    ]
    assert min(spread) >= 0.5
    assert max(spread) <= 1.5


def test_wiener_truth():
    decay, gain = [], []
    for seed in range(20):
        truth = simulate_wiener(seed).truth
        np.testing.assert_array_equal(truth.clean_test, np.maximum(truth.linear_test, 0))
        np.testing.assert_allclose(truth.A, truth.A.T)
        decay.append(-truth.poles.real.max())
        gain.append(truth.B)
    # The published systems' slowest poles lie between -23 and -3 1/s, and their B has
    # standard deviation 51: the printed scale (entries within 1) would fail both.
    assert 1 < np.median(decay) < 25
    assert abs(np.std(gain) - 50) < 4 * 50 / np.sqrt(2 * 200)


def test_wiener_half_of_the_output_is_cut():
    truth = simulate_wiener(0).truth
    assert 0.3 < np.mean(truth.clean_test == 0) < 0.7


def test_length_leaves_the_wiener_system_as_it_is():
    short = simulate_wiener(6, samples=100, training_samples=50).truth
    np.testing.assert_array_equal(short.A, simulate_wiener(6).truth.A)
