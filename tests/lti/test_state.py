"""Carrying a Gaussian state over a gap."""

import hypothesis.strategies as st
import numpy as np
import torch
from hypothesis import given
from scipy.linalg import expm

from pyro_dynogp.lti.state import ModalState, propagate, real_propagator
from tests.lti import oracles
from tests.lti.oracles import NOISES, assert_close, few, random_system, tensor

seeds = st.integers(0, 1000)


def split(z):
    P = z.shape[-1] // 2
    return tensor(z[..., :P] + 1j * z[..., P:])


@few
@given(seed=seeds, step=st.floats(0.0, 5.0), noise=st.sampled_from(NOISES))
def test_mean_and_covariance(seed, step, noise):
    system = random_system(seed, noise=noise)
    rng = np.random.default_rng(seed)
    z, u, P0 = rng.standard_normal(6), rng.standard_normal(2), oracles.random_covariance(6, seed)
    later = propagate(system.modes, ModalState(split(z), tensor(P0)), step, tensor(u))
    two = np.array([0.0, step])
    states = oracles.mean(system, two, np.stack([u, u]), z)[1]
    F = expm(system.A * step)
    # dP/dt = A P + P A' + L L': initial covariance carried on, plus the noise of the step.
    P = F @ P0 @ F.T + oracles.sampled_noise(system, step)
    assert_close(later.mean, split(states[1]))
    assert_close(later.covariance, P)


def test_stationary_stays_stationary():
    system = random_system(1)
    start = ModalState(tensor(np.ones(3) + 0j))
    assert_close(propagate(system.modes, start, 0.7).covariance, system.stationary)


@few
@given(a=st.floats(0.0, 2.0), b=st.floats(0.0, 2.0))
def test_two_gaps_are_one(a, b):
    system = random_system(2)
    start = ModalState(tensor(np.arange(3) + 1j), tensor(oracles.random_covariance(6)))
    u = tensor([0.3, -1.0])
    apart = propagate(system.modes, propagate(system.modes, start, a, u), b, u)
    once = propagate(system.modes, start, a + b, u)
    assert_close(apart.mean, once.mean, rtol=1e-12)
    assert_close(apart.covariance, once.covariance, rtol=1e-12)


def test_real_propagator_multiplies_like_the_complex_number():
    rng = np.random.default_rng(0)
    phi, x = (rng.standard_normal((2, 3)) + 1j * rng.standard_normal((2, 3)) for _ in range(2))
    z = torch.as_tensor(np.concatenate([x.real, x.imag], -1)).unsqueeze(-1)
    moved = (real_propagator(tensor(phi)) @ z).squeeze(-1)
    y = phi * x
    assert_close(moved, np.concatenate([y.real, y.imag], -1))
