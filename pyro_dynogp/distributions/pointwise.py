r"""Density of each sample of an observed linear process given others, exact and O(n).

- each given all others: mean y_i - [C^{-1} r]_i / [C^{-1}]_ii and variance 1/[C^{-1}]_ii, C the
  covariance of the samples and r their departure from the mean;
- each given all before it (outputs of one time follow one another): innovations;
- each given those at least k samples before it: the Kalman filter's k-step prediction.

Source: Sundararajan & Keerthi, Neural Computation 13(5):1103 (2001).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from pyro_dynogp.distributions.process import ObservedLTIProcess
from pyro_dynogp.distributions.trajectory import apply, split_missing
from pyro_dynogp.lti.filtering import predict_k_steps
from pyro_dynogp.lti.semiseparable import SemiseparableCovariance


@dataclass(frozen=True, eq=False)
class Moments:
    """Predictive moments of each sample, and the log-density of what was measured [nats].

    Attributes:
        mean, variance: (*b, *event) of the noise-free output, or where the method says so of the
            measured one.
        log_density: (*b, *event), NaN where the sample is missing.
    """

    mean: Tensor
    variance: Tensor
    log_density: Tensor


def left_out(observed: ObservedLTIProcess, y: Tensor) -> Moments:
    """Of each measured sample given all others; `variance` includes its noise."""
    residual, missing, K = _factored(observed, y)
    variance = 1.0 / K.inverse_diagonal()
    return _moments(observed, y, apply(K.solve, K, residual) * variance, variance, missing)


def one_step(observed: ObservedLTIProcess, y: Tensor) -> Moments:
    """Of each measured sample given all before it; `variance` includes its noise.

    Outputs of one time follow one another, so that the log-densities add up to that of the record.
    """
    residual, missing, K = _factored(observed, y)
    return _moments(observed, y, apply(K.innovations, K, residual), K.innovation_variance, missing)


def innovations(observed: ObservedLTIProcess, y: Tensor) -> tuple[Tensor, Tensor]:
    """Errors (*b, *event) of the predictions of `one_step` and their variances.

    Of a missing sample the error is zero and the variance infinite.
    """
    residual, _, K = _factored(observed, y)
    error = apply(K.innovations, K, residual)
    return observed.from_rows(error), observed.from_rows(K.innovation_variance)


def ahead(observed: ObservedLTIProcess, y: Tensor, horizon: int) -> Moments:
    """Of each noise-free sample given those at least `horizon` samples before it."""
    residual, missing, K = _factored(observed, y)
    found = predict_k_steps(K, residual, horizon)
    variance = found.variance + observed.noise_rows
    whole = _moments(observed, y, residual - found.mean, variance, missing)
    mean = observed.process.mean + observed.from_rows(found.mean)
    return Moments(mean, observed.from_rows(found.variance), whole.log_density)


def prediction_errors(observed: ObservedLTIProcess, y: Tensor, horizon: int, count: int) -> Tensor:
    """Draws (count, *b, *event) of the errors of all k-step predictions of a record, jointly.

    Neighbouring errors share innovations: in the steady state of a regular record they are the
    moving average e_t = sum_{j<k} psi_j nu_{t-j} of the innovations nu. Here they are what the
    predictor makes of outputs drawn from the model, so that any clock, gaps, the first samples and
    several outputs are exact, too; one filter pass for each draw.

    Args:
        observed: distribution of the outputs. y: outputs; only which ones are missing counts.
        horizon: k [samples]. count: number of draws.
    """
    _, _, K = _factored(observed, y)
    residual = observed.rows(observed.sample((count,)) - observed.mean)
    known = residual.masked_fill(K.missing, 0.0)
    return observed.from_rows(residual - predict_k_steps(K, known, horizon).mean)


def _factored(
    observed: ObservedLTIProcess, y: Tensor
) -> tuple[Tensor, Tensor | None, SemiseparableCovariance]:
    """Departures (*b, N), zero where missing; where that is; covariance of the samples."""
    residual, missing = split_missing(observed.rows(y - observed.mean))
    return residual, missing, observed.covariance(observed.noise, missing)


def _moments(
    observed: ObservedLTIProcess,
    y: Tensor,
    departure: Tensor,
    variance: Tensor,
    missing: Tensor | None,
) -> Moments:
    log_density = -0.5 * (math.log(2.0 * math.pi) + variance.log() + departure.square() / variance)
    if missing is not None:
        log_density = log_density.masked_fill(missing, torch.nan)
    shaped = (observed.from_rows(x) for x in (departure, variance, log_density))
    error, spread, density = shaped
    return Moments(y - error, spread, density)
