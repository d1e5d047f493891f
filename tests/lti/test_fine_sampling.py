"""Fast sampling with small noise, where covariance matrices are nearly singular: 60 digits decide.

Information-form filters lose whole nats here (step/time constant 1e-4).
"""

from dataclasses import replace

import numpy as np
import pytest
from mpmath import mp

from pyro_dynogp.lti.semiseparable import SemiseparableCovariance
from tests.lti.oracles import assert_close, random_system, tensor


def lyapunov(A, Q):
    """P with A P + P A' + Q = 0, by the linear system of its entries."""
    J = A.rows
    big, right = mp.matrix(J * J, J * J), mp.matrix(J * J, 1)
    for i in range(J):
        for k in range(J):
            right[i * J + k] = -Q[i, k]
            for m in range(J):
                big[i * J + k, m * J + k] += A[i, m]
                big[i * J + k, i * J + m] += A[k, m]
    p = mp.lu_solve(big, right)
    return mp.matrix([[p[i * J + k] for k in range(J)] for i in range(J)])


def exact(system, t, v, y):
    """Log-density of y and K^{-1} y in 60 digits."""
    with mp.workdps(60):
        A, C, L = (mp.matrix(x.tolist()) for x in (system.A, system.C, system.L))
        P = lyapunov(A, L * L.T)
        n = len(t)
        K = mp.matrix(n, n)
        for i in range(n):
            for k in range(i + 1):
                E = mp.expm(A * (mp.mpf(float(t[i])) - mp.mpf(float(t[k]))))
                K[i, k] = K[k, i] = (C * E * P * C.T)[0] + (mp.mpf(float(v)) if i == k else 0)
        Y = mp.matrix(y.tolist())
        root = mp.cholesky(K)
        z = mp.lu_solve(root, Y)
        log_det = 2 * sum(mp.log(root[i, i]) for i in range(n))
        log_prob = -(sum(x * x for x in z) + log_det + n * mp.log(2 * mp.pi)) / 2
        return float(log_prob), np.array([float(x) for x in mp.lu_solve(K, Y)])


def smooth(system):
    """The same system with C L = 0, so that its output is differentiable (a Matern-3/2 or so)."""
    c = system.c.copy()
    c[0, 0] -= (system.C @ system.L).item() / (2.0 * system.L_modal[0, 0])
    return replace(system, c=c)


@pytest.mark.parametrize(
    ("rough", "noise", "tolerance"),
    [
        # noise variance as a share of the signal's, tolerance of the log-density and of K^{-1} y
        (True, 1e-6, (1e-11, 1e-10)),
        (True, 1e-10, (1e-11, 1e-10)),
        (False, 1e-4, (1e-11, 1e-10)),
        (False, 1e-6, (1e-10, 1e-9)),
        # 12 samples tell 12 numbers of a curve whose bends are 1e-8 of its size: the condition
        # number is 1e11, and what is left of double precision is an error of 1e-5 nats.
        (False, 1e-10, (1e-7, 1e-5)),
    ],
)
def test_against_sixty_digits(rough, noise, tolerance):
    system = random_system(0, pairs=2, brownian=1)
    if not rough:
        system = smooth(system)
        assert abs((system.C @ system.L).item()) < 1e-12
    rng = np.random.default_rng(0)
    time_constant = 1.0 / np.abs(system.poles).max()
    t = 1e-4 * time_constant * np.cumsum(rng.uniform(0.5, 1.5, 12))
    variance = (system.C @ system.stationary @ system.C.T).item()
    v = noise * variance
    y = np.sqrt(variance) * (0.8 + np.sqrt(noise) * rng.standard_normal(12))
    log_prob, alpha = exact(system, t, v, y)
    K = SemiseparableCovariance(system.modes, t, v)
    Y = tensor(y).unsqueeze(-1)
    assert K.log_prob(Y).item() == pytest.approx(log_prob, rel=tolerance[0])
    assert_close(K.solve(Y)[:, 0], alpha, rtol=tolerance[1])
