"""Reference computations for stochastic LTI systems, in dense real matrices: numpy and scipy only.

Nothing here uses a formula of the package: the real state-space matrices are written out from the
differential equations of the real and imaginary parts, and everything else is a matrix exponential,
a Lyapunov equation or a dense multivariate normal.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from hypothesis import settings
from scipy.linalg import solve_continuous_lyapunov

from pyro_dynogp.lti.modes import Modes

# Few and fixed examples: the same ones in every run.
few = settings(max_examples=12, derandomize=True, deadline=None, database=None)

NOISES = ["shared", "independent"]


@dataclass(frozen=True)
class System:
    """Modal numbers and the real matrices of z = [Re x; Im x]; `several` keeps an output axis."""

    poles: np.ndarray
    B_modal: np.ndarray
    c: np.ndarray
    L_modal: np.ndarray
    D: np.ndarray
    noise: str = "shared"
    several: bool = False

    @cached_property
    def A(self):
        a, b = np.diag(self.poles.real), np.diag(self.poles.imag)
        return np.block([[a, -b], [b, a]])

    @cached_property
    def B(self):
        return np.vstack([self.B_modal.real, self.B_modal.imag])

    @cached_property
    def C(self):
        return np.hstack([2 * self.c.real, -2 * self.c.imag])

    @cached_property
    def L(self):
        wide = self.L_modal
        if self.noise == "independent":  # every pair has Brownian motions, so columns, of its own
            P, n_l = wide.shape
            wide = np.zeros((P, P * n_l), dtype=complex)
            for j in range(P):
                wide[j, j * n_l : (j + 1) * n_l] = self.L_modal[j]
        return np.vstack([wide.real, wide.imag])

    @cached_property
    def stationary(self):
        return solve_continuous_lyapunov(self.A, -self.L @ self.L.T)

    @property
    def modes(self) -> Modes:
        return Modes(
            self.poles,
            self.B_modal,
            self.c if self.several else self.c[0],
            self.L_modal,
            self.D if self.several else self.D[0],
            noise=self.noise,
        )


def random_system(seed=0, *, pairs=3, inputs=2, outputs=None, brownian=2, noise="shared"):
    """A stable system at random; outputs=None is one output without an output axis."""
    rng = np.random.default_rng(seed)
    n_y = 1 if outputs is None else outputs

    def complex_normal(*shape):
        return rng.standard_normal(shape) + 1j * rng.standard_normal(shape)

    poles = -np.exp(rng.uniform(-1.5, 1.0, pairs)) + 1j * rng.uniform(-4.0, 4.0, pairs)
    return System(
        poles,
        complex_normal(pairs, inputs),
        complex_normal(n_y, pairs),
        complex_normal(pairs, brownian),
        rng.standard_normal((n_y, inputs)),
        noise,
        outputs is not None,
    )


def irregular_times(n, seed=0, *, scale=0.4):
    return np.cumsum(scale * np.random.default_rng([seed, 7]).uniform(0.05, 2.0, n)) - 1.3


def random_inputs(n, n_u, seed=0):
    return np.random.default_rng([seed, 11]).standard_normal((n, n_u))


def random_covariance(J, seed=0):
    R = np.random.default_rng([seed, 13]).standard_normal((J, J))
    return R @ R.T / J


def expm(M):
    """Exponentials of matrices (..., J, J): the power series after scaling, then squaring.

    scipy's does the same one matrix at a time, too slow for a covariance of many lags
    (test_oracles.py compares the two).
    """
    M = np.asarray(M, dtype=float)
    doublings = int(np.ceil(np.log2(max(np.abs(M).sum(-1).max(), 1.0)))) + 1
    X = M / 2.0**doublings
    term = E = np.broadcast_to(np.eye(M.shape[-1]), M.shape)
    for j in range(1, 19):  # 2^-18 / 18! is far below double precision
        term = term @ X / j
        E = E + term
    for _ in range(doublings):
        E = E @ E
    return E


def mean(system, time, u, z0=None):
    """Outputs (n, n_y) and states (n, 2P) for inputs held over each step."""
    J, n_u = system.B.shape
    z = np.zeros(J) if z0 is None else np.asarray(z0, dtype=float)
    block = np.zeros((J + n_u, J + n_u))
    block[:J] = np.hstack([system.A, system.B])
    states = [z]
    for k, E in enumerate(expm(block * np.diff(time)[:, None, None])):
        z = (E @ np.concatenate([z, u[k]]))[:J]
        states.append(z)
    states = np.array(states)
    return states @ system.C.T + u @ system.D.T, states


def covariance(system, t, s, initial=None, origin=None):
    """S(t, s) (n n_y, m n_y); `initial` is the covariance of the state at time `origin`."""
    t, s = np.asarray(t, dtype=float), np.asarray(s, dtype=float)
    later = expm(system.A * np.abs(t[:, None] - s[None, :])[..., None, None])
    first = np.minimum(t[:, None], s[None, :])
    P = np.broadcast_to(system.stationary, (*first.shape, *system.stationary.shape))
    if initial is not None:
        # dP/dt = A P + P A' + L L' from `initial`: its departure from the stationary one decays.
        E = expm(system.A * (first - origin)[..., None, None])
        P = P + E @ (initial - system.stationary) @ E.swapaxes(-1, -2)
    forward, backward = later @ P, P @ later.swapaxes(-1, -2)
    state = np.where((t[:, None] >= s[None, :])[..., None, None], forward, backward)
    blocks = system.C @ state @ system.C.T  # n, m, n_y, n_y
    n_y = system.C.shape[0]
    return blocks.swapaxes(1, 2).reshape(len(t) * n_y, len(s) * n_y)


def sampled_noise(system, step):
    """Covariance that noise adds to the state over one step: Van Loan's block exponential."""
    J = system.A.shape[0]
    # exp(-A step) loses digits over a long step: take a short one, then double it.
    doublings = max(0, int(np.ceil(np.log2(max(np.abs(system.A).sum(1).max() * step, 1e-300)))))
    h = step / 2**doublings
    block = np.block([[-system.A, system.L @ system.L.T], [np.zeros((J, J)), system.A.T]])
    E = expm(block * h)
    F, Q = expm(system.A * h), E[J:, J:].T @ E[:J, J:]
    for _ in range(doublings):
        F, Q = F @ F, F @ Q @ F.T + Q
    return Q


def log_density(residual, K):
    """Log N(residual; 0, K)."""
    solved = np.linalg.solve(K, residual)
    return -0.5 * (residual @ solved + np.linalg.slogdet(K)[1] + len(residual) * np.log(2 * np.pi))


def tensor(x):
    return torch.as_tensor(np.array(x))


def assert_close(actual, expected, rtol=1e-10):
    """Same shape, and the largest error below rtol times the largest expected number."""
    actual, expected = (
        x.detach().resolve_conj().numpy() if isinstance(x, torch.Tensor) else np.asarray(x)
        for x in (actual, expected)
    )
    assert actual.shape == expected.shape
    scale = np.abs(expected).max()
    error = np.abs(actual - expected).max()
    assert error <= rtol * scale, f"relative error {error / scale:.3g}"  # false for NaN too
