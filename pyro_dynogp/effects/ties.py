"""Exact ties at the largest measured value: what a sensor at its limit leaves."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import stats
from scipy.signal import lfilter

from pyro_dynogp.statistics.autoregression import fitted_filter
from pyro_dynogp.statistics.scan import tail_probability

# Values as near as this to each other, against the range, are the same number.
SAME = 1e-9


@dataclass(frozen=True)
class Ties:
    """Samples at the largest value.

    Attributes:
        limit: that value [output]. count: of samples there.
        p_value: probability of as many were there no limit.
        size: root mean square of what is cut off, by the mean [output].
    """

    limit: float
    count: int
    p_value: float
    size: float


def ties_at_the_top(
    output: np.ndarray, mean: np.ndarray, *, replicates: int = 200, seed: int = 0
) -> Ties:
    """Test whether more samples are at the largest value than the model has there.

    Under the null the record is mean plus residual (its innovations in random order through the
    autoregressive filter), rounded to the record's own resolution: a slow record of few digits
    has ties at each of its peaks without any limit.

    Args:
        output: (n,) measured, NaN where missing [output]. mean: (n,) [output].
        replicates: of the null. seed: of their random order.

    Raises:
        ValueError: where fewer than 30 samples are measured.
    """
    there = np.isfinite(output) & np.isfinite(mean)
    y = output[there]
    top, spread = float(y.max(initial=-np.inf)), float(np.ptp(y)) if len(y) else 0.0
    count = int((y >= top - SAME * spread).sum())
    over = np.maximum(mean[there] - top, 0.0)
    size = float(np.sqrt(np.mean(over**2)))
    if count < 3 or spread == 0:
        return Ties(top, count, 1.0, size)
    residual = np.where(there, output - mean, np.nan)
    whiten = fitted_filter(residual)
    q = _resolution(y, spread)
    e = whiten(residual)
    e = e[np.isfinite(e)]
    generator = np.random.default_rng(seed)
    drawn = generator.choice(e, size=(replicates, there.size + 50))
    noise = lfilter([1.0], np.concatenate([[1.0], -whiten.coefficients]), drawn, axis=1)[:, 50:]
    made = (mean + noise)[:, there]
    if q > 0:
        made = np.round((made - top) / q)
    null = (made >= made.max(1, keepdims=True)).sum(1).astype(float)
    # Most records have one sample at their maximum: a distribution of counts has a tail, too.
    p = max(tail_probability(null, count), float(stats.poisson.sf(count - 2, max(null.mean(), 1))))
    if null.std() == 0:
        p = float(stats.poisson.sf(count - 2, 1.0))
    return Ties(top, count, min(1.0, p), size)


def _resolution(y: np.ndarray, spread: float) -> float:
    """Step to which values are rounded, zero where they are not."""
    distinct = np.unique(np.round(y / (SAME * spread)))
    gaps = np.diff(distinct) * SAME * spread
    if len(distinct) > 0.8 * len(y) or not len(gaps):
        return 0.0
    q = float(gaps.min())
    steps = gaps / q
    return q if np.abs(steps - np.round(steps)).max() < 0.05 else 0.0
