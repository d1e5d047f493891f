"""Autoregressive filters of many series: fast, and stable whatever samples are missing."""

from __future__ import annotations

import numpy as np
from numba import njit
from scipy.fft import irfft, next_fast_len, rfft

from pyro_dynogp.statistics.whitening import ORDER, Whitener
from pyro_dynogp.support.compiled import OPTIONS
from pyro_dynogp.support.errors import invalid


def fitted_filter(x: np.ndarray, highest: int = ORDER) -> Whitener:
    """Autoregressive filter by Yule and Walker, its order by Akaike's criterion; O(n log n).

    Products are averaged over the pairs that are there; the recursion ends where they are no
    autocovariance any more, so that the filter is stable. Its order leaves at least half of the
    samples with all of their past where samples are missing here and there.

    Args:
        x: (n,), NaN where missing. highest: order tried; no more than a tenth of the samples.

    Raises:
        ValueError: where fewer than 30 samples are there.
    """
    there = np.isfinite(x)
    count = int(there.sum())
    if count < 30:
        raise invalid("residual", expected="at least 30 samples to look at", got=str(count))
    edges = np.flatnonzero(np.diff(np.concatenate([[0], there.astype(int), [0]])))
    runs = edges[1::2] - edges[::2]
    whole = np.maximum(runs - np.arange(highest + 1)[:, None], 0).sum(1)
    highest = min(highest, count // 10, int(np.flatnonzero(whole >= count // 2)[-1]))
    filled = np.where(there, x - x[there].mean(), 0.0)
    length = next_fast_len(len(x) + highest + 1, real=True)
    power = np.abs(rfft(filled, length)) ** 2
    r = irfft(power, length)[: highest + 1]
    if len(runs) > 1 or count < len(x):
        pairs = irfft(np.abs(rfft(there.astype(float), length)) ** 2, length)[: highest + 1]
        r = r / np.maximum(pairs, 1.0) * (count - np.arange(highest + 1.0))
    if r[0] <= 0:
        return Whitener(np.zeros(0))
    return Whitener(_levinson(r, count))


@njit(**OPTIONS)
def _levinson(r: np.ndarray, count: int) -> np.ndarray:
    """Levinson and Durbin's recursion, all orders at the cost of the highest: coefficients (p,)."""
    highest = len(r) - 1
    a, last = np.zeros(highest), np.zeros(highest)
    chosen, order = np.zeros(highest), 0
    variance = r[0]
    best = count * np.log(variance)
    for p in range(1, highest + 1):
        k = r[p]
        for i in range(p - 1):
            k -= a[i] * r[p - 1 - i]
        k /= variance
        last[:] = a
        for i in range(p - 1):
            a[i] = last[i] - k * last[p - 2 - i]
        a[p - 1] = k
        variance *= 1.0 - k * k
        if np.abs(k) >= 1.0 or variance <= 1e-12 * r[0]:
            break
        criterion = count * np.log(variance) + 2.0 * p
        if criterion < best:
            best, order = criterion, p
            chosen[:] = a
    return chosen[:order].copy()
