"""Autoregressive filters: whitening of series, and their fit, stable whatever is missing."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from scipy.fft import irfft, next_fast_len, rfft

from pyro_dynogp.statistics.settings import LoopSettings
from pyro_dynogp.support.compiled import OPTIONS
from pyro_dynogp.support.errors import invalid

# Numbers that stay in the processor's nearest memory while all coefficients go over them.
BLOCK = 1024


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
        flat = np.ascontiguousarray(x, dtype=float).reshape(-1)
        width = flat.size // max(len(x), 1)
        return _filtered(self.coefficients, flat, width).reshape(-1, *x.shape[1:])


@njit(**OPTIONS)
def _filtered(a: np.ndarray, x: np.ndarray, width: int) -> np.ndarray:
    """Rows of `width` numbers, one after the other, filtered."""
    p = len(a)
    out = x[p * width :].copy()
    for begin in range(0, len(out), BLOCK):
        block = out[begin : begin + BLOCK]
        for k in range(p):
            shift = begin + (p - 1 - k) * width
            past = x[shift : shift + len(block)]
            for i in range(len(block)):
                block[i] -= a[k] * past[i]
    return out


def check_samples(count: int, settings: LoopSettings, what: str) -> None:
    """Refuse fewer samples than a test needs.

    Args:
        count: of measured samples. settings: of which `measured_samples` is the least.
        what: they are, for the message.

    Raises:
        ValueError: where there are fewer.
    """
    fewest = settings.measured_samples
    if count < fewest:
        raise invalid("residuals", expected=f"at least {fewest} {what}", got=str(count))


def fitted_filter(x: np.ndarray, settings: LoopSettings) -> Whitener:
    """Autoregressive filter by Yule and Walker, its order by Akaike's criterion; O(n log n).

    Products are averaged over the pairs that are there; the recursion ends where they are no
    autocovariance any more, so that the filter is stable. Its order leaves at least half of the
    samples with all of their past where samples are missing here and there, and no fewer than a
    test needs.

    Args:
        x: (n,), NaN where missing.
        settings: of which `filter_order` is the highest that is tried; no more than a tenth of the
            samples.

    Raises:
        ValueError: where fewer than `measured_samples` are there.
    """
    measured = np.isfinite(x)
    count = int(measured.sum())
    check_samples(count, settings, "samples to look at")
    edges = np.flatnonzero(np.diff(np.concatenate([[0], measured.astype(int), [0]])))
    runs = edges[1::2] - edges[::2]
    whole = np.maximum(runs - np.arange(settings.filter_order + 1)[:, None], 0).sum(1)
    fewest = max(count // 2, settings.measured_samples)
    highest = min(settings.filter_order, count // 10, int(np.flatnonzero(whole >= fewest)[-1]))
    filled = np.where(measured, x - x[measured].mean(), 0.0)
    length = next_fast_len(len(x) + highest + 1, real=True)
    power = np.abs(rfft(filled, length)) ** 2
    r = irfft(power, length)[: highest + 1]
    if len(runs) > 1 or count < len(x):
        pairs = irfft(np.abs(rfft(measured.astype(float), length)) ** 2, length)[: highest + 1]
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
