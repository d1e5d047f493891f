"""Whitening of residuals, and of what may explain them, by one autoregressive filter."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import solve_toeplitz

from pyro_dynogp._errors import invalid

# Highest order that is tried.
ORDER = 24


@dataclass(frozen=True, eq=False)
class Whitener:
    """An autoregressive filter: w_t = x_t - sum_k a_k x_(t-k).

    Attributes:
        coefficients: (p,) a.
    """

    coefficients: np.ndarray

    @property
    def order(self) -> int:
        """p, which is also the number of leading samples that are lost."""
        return len(self.coefficients)

    def __call__(self, x: np.ndarray) -> np.ndarray:
        """Filtered along the first dimension: (n, ...) to (n - p, ...); NaN spreads over p + 1."""
        p, n = self.order, len(x)
        out = x[p:].astype(float, copy=True)
        for k, a in enumerate(self.coefficients, start=1):
            out -= a * x[p - k : n - k]
        return out


def autoregression(x: np.ndarray, highest: int = ORDER) -> Whitener:
    """Autoregressive filter of a series by Yule and Walker, its order by Akaike's criterion.

    Args:
        x: (n,) with a mean near zero; NaN where missing (pairs with a gap are left out).
        highest: order that is tried at most; no more than a tenth of the samples.

    Raises:
        ValueError: where fewer than 30 samples are there.
    """
    there = np.isfinite(x)
    count = int(there.sum())
    if count < 30:
        raise invalid("x", expected="at least 30 samples that are not missing", got=str(count))
    filled = np.where(there, x - x[there].mean(), 0.0)
    highest = min(highest, count // 10)
    products = np.correlate(filled, filled, "full")[len(x) - 1 : len(x) + highest]
    pairs = np.correlate(there.astype(float), there.astype(float), "full")
    seen = np.maximum(pairs[len(x) - 1 : len(x) + highest], 1.0)
    # Without gaps the biased estimate, whose filter is stable.
    covariance = products / (count if there.all() else seen)
    if covariance[0] <= 0:
        return Whitener(np.zeros(0))
    best, chosen = count * np.log(covariance[0]), np.zeros(0)
    for p in range(1, highest + 1):
        a = solve_toeplitz(covariance[:p], covariance[1 : p + 1])
        variance = covariance[0] - a @ covariance[1 : p + 1]
        if variance <= 0:
            break
        criterion = count * np.log(variance) + 2 * p
        if criterion < best:
            best, chosen = criterion, a
    return Whitener(chosen)
