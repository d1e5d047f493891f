r"""Noise of an output inside the filter: a mixture of Gaussians, and its exact moments; compiled.

The Gaussians have variances R multiple_k (one component: Gaussian noise; several: Student-t). With
residual r and variance s of the noise-free output, an output changes the joint Gaussian by

    m <- m + c alpha,  P <- P - beta c c',  alpha = -dl/dr,  beta = -d^2 l/dr^2,
    l = log sum_k share_k N(r; 0, s + R multiple_k),  c = Cov(a, output),

which are the exact first two moments.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from pyro_dynogp.support.compiled import BORROWING

_LOG_2PI = math.log(2.0 * math.pi)


@njit(**BORROWING)
def _log_term(r, S, share):
    return math.log(share) - 0.5 * math.log(S) - 0.5 * r * r / S


@njit(**BORROWING)
def _noise_weights(r, s, R, share, multiple):
    """Largest logarithm of the components' densities, sum beside it, E 1/S and E 1/S^2 by them."""
    K = share.shape[0]
    top = -np.inf
    for k in range(K):
        top = max(top, _log_term(r, s + R * multiple[k], share[k]))
    total = 0.0
    first = 0.0
    second = 0.0
    for k in range(K):
        S = s + R * multiple[k]
        inverse = 1.0 / S
        weight = math.exp(_log_term(r, S, share[k]) - top)
        total += weight
        first += weight * inverse
        second += weight * inverse * inverse
    return top, total, first / total, second / total


@njit(**BORROWING)
def noise_terms(r, s, R, share, multiple):
    """Value l, alpha = -dl/dr and beta = -d^2 l/dr^2 of the log-density of a residual."""
    top, total, first, second = _noise_weights(r, s, R, share, multiple)
    beta = first - r * r * (second - first * first)
    return top + math.log(total) - 0.5 * _LOG_2PI, r * first, beta


@njit(**BORROWING)
def noise_adjoint(r, s, R, share, multiple, l_bar, alpha_bar, beta_bar):
    """Gradients of `noise_terms` by r, s and R."""
    top, total, first, second = _noise_weights(r, s, R, share, multiple)
    r_bar = alpha_bar * first - 2.0 * beta_bar * r * (second - first * first)
    first_bar = alpha_bar * r + beta_bar * (1.0 + 2.0 * r * r * first)
    second_bar = -beta_bar * r * r
    mean_bar = first_bar * first + second_bar * second
    s_bar = 0.0
    R_bar = 0.0
    for k in range(share.shape[0]):
        S = s + R * multiple[k]
        a = 1.0 / S
        weight = math.exp(_log_term(r, S, share[k]) - top) / total
        inverse_bar = weight * (first_bar + 2.0 * second_bar * a)
        term_bar = weight * (first_bar * a + second_bar * a * a - mean_bar + l_bar)
        S_bar = -a * a * inverse_bar + 0.5 * a * term_bar * (r * r * a - 1.0)
        r_bar -= term_bar * r * a
        s_bar += S_bar
        R_bar += S_bar * multiple[k]
    return r_bar, s_bar, R_bar
