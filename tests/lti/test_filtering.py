"""Predictions k steps ahead against dense conditional normals at irregular times."""

import numpy as np
import pytest
import torch

from pyro_dynogp.lti.filtering import predict_k_steps
from pyro_dynogp.lti.modes import Modes
from pyro_dynogp.lti.semiseparable import SemiseparableCovariance
from tests.lti import oracles
from tests.lti.oracles import NOISES, assert_close, random_system, tensor


def conditional(S, v, y, rows, given):
    """Mean and variance of S-rows given noisy samples `given`, missing ones left out."""
    given = [i for i in given if np.isfinite(v[i])]
    if not given:
        return np.zeros(len(rows)), np.diag(S)[rows]
    K = S[np.ix_(given, given)] + np.diag(v[given])
    cross = S[np.ix_(rows, given)]
    gain = np.linalg.solve(K, cross.T).T
    return gain @ y[given], np.diag(S[np.ix_(rows, rows)] - gain @ cross.T)


@pytest.mark.parametrize("horizon", [1, 2, 5, 30])
@pytest.mark.parametrize("outputs", [None, 2])
@pytest.mark.parametrize("noise", NOISES)
def test_irregular_and_repeated_times_and_missing_rows(outputs, noise, horizon):
    system = random_system(1, outputs=outputs, noise=noise)
    n, n_y = 14, outputs or 1
    t = oracles.irregular_times(n)
    t[6] = t[5]
    rng = np.random.default_rng(2)
    y, v = rng.standard_normal(n * n_y), rng.uniform(0.1, 0.5, n * n_y)
    v[[1, 9]] = np.inf
    y[[1, 9]] = 0.0
    P0 = oracles.random_covariance(6)
    S = oracles.covariance(system, t, t, P0, t[0])
    mean, variance = np.empty(n * n_y), np.empty(n * n_y)
    for j in range(n):
        rows = list(range(j * n_y, (j + 1) * n_y))
        seen = range(max(j - horizon + 1, 0) * n_y)
        mean[rows], variance[rows] = conditional(S, v, y, rows, seen)
    K = SemiseparableCovariance(system.modes, t, tensor(v), tensor(P0))
    ours = predict_k_steps(K, tensor(y), horizon)
    assert_close(ours.mean, mean)
    assert_close(ours.variance, variance)


def test_batches():
    systems = [random_system(k, pairs=2) for k in range(2)]
    t = oracles.irregular_times(9)
    modes = Modes(
        np.stack([s.poles for s in systems])[:, None],
        output_gain=np.stack([s.c[0] for s in systems])[:, None],
        noise_gain=np.stack([s.L_modal for s in systems])[:, None],
    )
    y = tensor(np.random.default_rng(0).standard_normal((3, 9)))
    together = predict_k_steps(SemiseparableCovariance(modes, t, 0.1), y, 2)
    assert together.mean.shape == together.variance.shape == (2, 3, 9)
    for i, system in enumerate(systems):
        K = SemiseparableCovariance(system.modes, t, 0.1)
        for k in range(3):
            alone = predict_k_steps(K, y[k], 2)
            assert_close(together.mean[i, k], alone.mean)
            assert_close(together.variance[i, k], alone.variance)


@pytest.mark.parametrize("horizon", [0, -1, 1.5, "2"])
def test_horizon_must_be_a_count(horizon):
    K = SemiseparableCovariance(random_system(0).modes, [0.0, 1.0], 0.1)
    with pytest.raises(ValueError, match=r"horizon.*>= 1"):
        predict_k_steps(K, torch.zeros(2, dtype=torch.float64), horizon)
