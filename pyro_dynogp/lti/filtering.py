r"""Predictions k steps ahead: the Kalman filter, in O(n P^2) for any horizon and any sampling."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numba import njit
from torch import Tensor

from pyro_dynogp.lti.arithmetic import rotate_rows
from pyro_dynogp.lti.factorisation import factor_row
from pyro_dynogp.lti.primitives import array, flatten_batch
from pyro_dynogp.lti.semiseparable import SemiseparableCovariance
from pyro_dynogp.support.compiled import OPTIONS
from pyro_dynogp.support.errors import invalid


@njit(**OPTIONS)
def _emit(F, S, lam, h, k0, age, j, out_mean, out_variance):
    """Mean and variance of every output at an age [s] after the state F, S; F may be empty."""
    pairs = lam.shape[0]
    J = 2 * pairs
    row = np.empty(J)
    for a in range(h.shape[0]):
        for i in range(pairs):
            phi = np.exp(lam[i] * age)
            row[i] = phi.real * h[a, i] + phi.imag * h[a, pairs + i]
            row[pairs + i] = phi.real * h[a, pairs + i] - phi.imag * h[a, i]
        mean = 0.0
        explained = 0.0
        for i in range(J):
            mean += row[i] * F[i]
            for m in range(J):
                explained += row[i] * S[i, m] * row[m]
        out_mean[j * h.shape[0] + a] = mean
        out_variance[j * h.shape[0] + a] = k0[a] - explained


@njit(**OPTIONS)
def _k_step(re, im, step, lam, time, h, g, k0, v, S0, Y, horizon):
    """Means (b, N) and variances (b, N) of the noise-free outputs given samples k steps before."""
    batch, rows = v.shape
    n = time.shape[0]
    n_y = h.shape[1]
    J = h.shape[2]
    mean = np.empty((batch, rows))
    variance = np.empty((batch, rows))
    s = np.empty(J)
    e = np.empty(J)
    F = np.empty((J, 1))
    for b in range(batch):
        S = S0[b].copy()
        F[:] = 0.0
        for j in range(min(horizon, n)):
            age = time[j] - time[0]
            _emit(F[:, 0], S, lam[b], h[b], k0[b], age, j, mean[b], variance[b])
        for i in range(n):
            if step[i] >= 0:
                rotate_rows(F, re[b, step[i]], im[b, step[i]])
            for a in range(n_y):
                row = i * n_y + a
                k = step[i] if a == 0 else -1
                p = factor_row(S, re[b], im[b], k, h[b, a], g[b, a], k0[b, a], v[b, row], s, e)
                z = Y[b, row]
                for m in range(J):
                    z -= h[b, a, m] * F[m, 0]
                z /= p + v[b, row]
                for m in range(J):
                    F[m, 0] += e[m] * z
            j = i + horizon
            if j < n:
                age = time[j] - time[i]
                _emit(F[:, 0], S, lam[b], h[b], k0[b], age, j, mean[b], variance[b])
    return mean, variance


@dataclass(frozen=True)
class KStepPrediction:
    """Predictive moments of the noise-free outputs.

    Attributes:
        mean: (*b, N) departure from the mean response [output].
        variance: (*b, N) [output^2], measurement noise not included.
    """

    mean: Tensor
    variance: Tensor


def predict_k_steps(
    covariance: SemiseparableCovariance, residual: Tensor, horizon: int
) -> KStepPrediction:
    """Predict every sample from the samples at least `horizon` samples before it.

    Args:
        covariance: prior covariance and noise of the samples, infinite where one is missing.
        residual: (*b, N) samples less mean response, zero where missing.
        horizon: k >= 1 [samples]. The first k samples are predicted from the prior.

    Not differentiable: a forward pass for prediction.

    Raises:
        ValueError: where horizon is not a positive whole number.
    """
    if not isinstance(horizon, int | np.integer) or horizon < 1:
        raise invalid("horizon", expected="a whole number of samples >= 1", got=repr(horizon))
    rows = covariance._rows
    flat, batch = flatten_batch(
        [
            rows.re,
            rows.im,
            covariance.modes.poles,
            rows.h,
            rows.g,
            rows.k0,
            covariance.noise_variance,
            rows.S0,
            residual,
        ],
        [2, 2, 1, 2, 2, 1, 1, 2, 1],
    )
    re, im, lam, h, g, k0, v, S0, Y = (array(x) for x in flat)
    grid = covariance.grid
    time: Any = array(grid.time)
    mean, variance = _k_step(re, im, grid.step_index, lam, time, h, g, k0, v, S0, Y, int(horizon))
    shape = (*batch, covariance.size)
    return KStepPrediction(
        torch.from_numpy(mean).reshape(shape),
        torch.from_numpy(np.maximum(variance, 0.0)).reshape(shape),
    )
