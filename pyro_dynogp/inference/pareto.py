"""Pareto-smoothed importance sampling: weights of draws, and whether they are to be trusted.

Every default fit of a linear model asks for it, and ArviZ, to which it is equal in the tests, takes
1.4 seconds to import: as long as the climb itself.
"""

from __future__ import annotations

import numpy as np
from scipy.special import logsumexp

# Weight of the prior on k, as of so many draws of a tail whose k is 0.5.
PRIOR_COUNT, PRIOR_K = 10, 0.5


def good_k(draws: int) -> float:
    """Largest Pareto shape at which importance sampling with S draws is reliable (Vehtari 2024)."""
    return min(1.0 - 1.0 / np.log10(draws), 0.7) if draws > 10 else 0.0


def psis(log_ratio: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Pareto-smoothed importance sampling (Vehtari, Simpson, Gelman, Yao & Gabry 2024).

    Args:
        log_ratio: (..., S) of target over proposal, up to a constant for each row.

    Returns:
        Normalised log weights (..., S), and Pareto shapes k (...); NaN with fewer than 25 draws
        and zero where all ratios of a row are equal.
    """
    log_ratio = np.asarray(log_ratio, dtype=float)
    count = log_ratio.shape[-1]
    flat = log_ratio.reshape(-1, count)
    flat = flat - flat.max(-1, keepdims=True)
    k = np.full(len(flat), np.nan)
    for row, each in enumerate(flat):
        if np.ptp(each) < 1e-12:
            k[row] = 0.0
        elif count >= 25:
            k[row] = _smooth(each)
    flat = flat - logsumexp(flat, -1, keepdims=True)
    return flat.reshape(log_ratio.shape), k.reshape(log_ratio.shape[:-1])


def effective(log_weights: np.ndarray) -> float:
    """How many equal weights say as much as these normalised ones (S,)."""
    return float(np.exp(-logsumexp(2.0 * log_weights)))


def _smooth(x: np.ndarray) -> float:
    """Replace the largest of the ratios x (S,), the greatest 0, by quantiles of a Pareto tail: k.

    The tail are the largest 3 sqrt(S), at most a fifth of all.
    """
    count = len(x)
    size = int(np.ceil(min(0.2 * count, 3.0 * np.sqrt(count))))
    order = np.argsort(x, kind="stable")
    cutoff = max(x[order[-size - 1]], np.log(np.finfo(float).tiny))
    tail = order[x[order] > cutoff]
    if len(tail) <= 4:
        return np.inf
    k, sigma = fit_tail(np.exp(x[tail]) - np.exp(cutoff))
    if np.isfinite(k) and sigma > 0.0:
        above = np.log1p(-np.arange(0.5, len(tail)) / len(tail))
        with np.errstate(over="ignore"):  # what is out of range is as large as the largest
            excess = sigma * (np.expm1(-k * above) / k if abs(k) > 1e-15 else -above)
        x[tail] = np.minimum(np.log(excess + np.exp(cutoff)), 0.0)
    return k


def fit_tail(x: np.ndarray) -> tuple[float, float]:
    """Shape k and scale of a generalised Pareto distribution of sorted positive numbers (m,).

    Source: Zhang & Stephens, Technometrics 51(3):316 (2009), with the weak prior on k of Vehtari et
    al. (2024).
    """
    m = len(x)
    grid = 30 + int(np.sqrt(m))
    b = 1.0 - np.sqrt(grid / (np.arange(1, grid + 1) - 0.5))
    b = b / (3.0 * x[int(m / 4 + 0.5) - 1]) + 1.0 / x[-1]
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        each = np.log1p(-b[:, None] * x).mean(1)
        profile = m * (np.log(-b / each) - each - 1.0)
        weight = 1.0 / np.exp(profile - profile[:, None]).sum(1)
        weight = np.where(weight >= 10.0 * np.finfo(float).eps, weight, 0.0)
        mean = float((b * weight).sum() / weight.sum())
        k = float(np.log1p(-mean * x).mean())
    return (m * k + PRIOR_COUNT * PRIOR_K) / (m + PRIOR_COUNT), -k / mean
