"""What one test of many variants of an effect comes to, and its p-value from replicates."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import stats

# Fewer exceedances than this leave the tail to a fitted one.
EXCEEDANCES = 10


@dataclass(frozen=True, eq=False)
class Scan:
    """The best of all variants of an effect.

    Attributes:
        statistic: largest standardised gain. p_value: of it.
        best: which variant. gain: its gain [nats]. gains: (J,) of all.
        weights: (K,) of the best variant's columns. size: root mean square of what they explain,
            before whitening [unit of the residual].
        fitted: (n,) what they explain.
    """

    statistic: float
    p_value: float
    best: int
    gain: float
    gains: np.ndarray
    weights: np.ndarray
    size: float
    fitted: np.ndarray


def tail_probability(null: np.ndarray, value: float) -> float:
    """Probability of a value as large, from draws (R,) under the null.

    Counted where enough draws are as large, (1 + count) / (1 + R); beyond them from a Gumbel
    distribution with the mean and standard deviation of the draws: what they are are maxima.
    """
    above = int((null >= value).sum())
    counted = (1 + above) / (1 + len(null))
    if above >= EXCEEDANCES:
        return counted
    scale = float(null.std()) * np.sqrt(6.0) / np.pi
    if scale <= 0:
        return counted
    location = float(null.mean()) - np.euler_gamma * scale
    fitted = float(stats.gumbel_r.sf(value, location, scale))
    return min(counted, max(fitted, 1e-300)) if above == 0 else min(counted, 2.0 * fitted + 1e-300)
