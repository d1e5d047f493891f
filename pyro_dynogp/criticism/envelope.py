"""Is one curve like its replicates? One statistic, its Monte Carlo p-value and its band."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pyro_dynogp.support.shown import shown


@shown
@dataclass(repr=False, frozen=True, eq=False)
class Envelope:
    """Simultaneous band of a curve, and how far the observed curve departs.

    Attributes:
        low: (K,) lower limit. high: (K,) upper limit.
        p_value: of the largest standardised departure over all K places.
        p_values: (K,) of each place, adjusted for looking at all K of them.
    """

    low: np.ndarray
    high: np.ndarray
    p_value: float
    p_values: np.ndarray


def envelope(observed: np.ndarray, replicated: np.ndarray, level: float) -> Envelope:
    """Global envelope test of one observed curve against S replicates of it.

    Under the null hypothesis the S + 1 curves are exchangeable. Location and scale are therefore
    those of the pool of all S + 1 curves, so that the departures stay exchangeable, and the rank
    p-value (1 + #{replicated >= observed}) / (1 + S) is at most alpha with a probability of at
    most alpha, for any number of replicates and any dependence along the curve. The width of the
    band is tuned until a share `level` of the replicates lies wholly inside (Säilynoja, Bürkner &
    Vehtari 2022 tune the pointwise level in the same way); the observed curve leaves it exactly
    where the p-value is at most 1 - level. Standardised departures take the place of pointwise
    ranks, which tie once there are hundreds of replicates instead of thousands (Myllymäki et al.
    2017, who also give the two sides different scales). The p-values of single places are those
    of the single-step maxT procedure (Westfall & Young 1993): they keep the probability of any
    false alarm, and unlike Bonferroni's they know how the places depend on each other.

    Args:
        observed: (K,). replicated: (S, K). level: share of curves inside, at most S/(S + 1).
    """
    count = len(replicated)
    centre, below, above, departures = _standardised(np.vstack([observed, replicated]))
    largest = departures.max(axis=1)
    # The order statistic for which "outside the band" and "p-value <= 1 - level" are the same.
    # The small number keeps rounding from turning 0.95 * 200 into more than 190.
    order = int(np.ceil(level * (count + 1) - 1e-9))
    critical = np.sort(largest[1:])[order - 1]
    p_values = (1 + (largest[1:, None] >= departures[0]).sum(axis=0)) / (1 + count)
    return Envelope(
        low=centre - critical * below,
        high=centre + critical * above,
        p_value=float(p_values.min()),
        p_values=p_values,
    )


def _standardised(
    pool: np.ndarray,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Mean (K,), scale below and above it (K,), and departures (S + 1, K) of curves (S + 1, K).

    The two scales are root mean squares of the deviations of each sign, both equal to the standard
    deviation where the distribution is symmetric.
    """
    centre = pool.mean(axis=0)
    deviation = pool - centre
    # Equal values deviate from their mean by rounding only, which must not be standardised.
    tiny = 64 * np.finfo(np.float64).eps * np.abs(pool).max(axis=0)
    deviation[np.abs(deviation) <= tiny] = 0.0
    above = np.sqrt(2.0 * np.mean(np.maximum(deviation, 0.0) ** 2, axis=0))
    below = np.sqrt(2.0 * np.mean(np.minimum(deviation, 0.0) ** 2, axis=0))
    scale = np.where(deviation > 0, above, below)
    departures = np.divide(
        np.abs(deviation), scale, out=np.zeros_like(deviation), where=deviation != 0
    )
    return centre, below, above, departures
