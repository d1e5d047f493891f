"""The continuous ranked probability score, and how much of it is miscalibration."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import ndtri

from pyro_dynogp.prediction.prediction import Prediction

MEMBERS = 99


@dataclass(frozen=True, eq=False)
class CrpsDecomposition:
    """Mean score = miscalibration - discrimination + uncertainty, each (n_y,) [output].

    Source: Hersbach (2000), Weather and Forecasting 15, 559-570, who calls the parts reliability,
    resolution and uncertainty. The ensemble consists of 99 quantiles of the prediction at each
    time; its score equals that of the prediction up to a fraction of a per cent.

    Attributes:
        mean: continuous ranked probability score of the ensemble, averaged over time.
        miscalibration: what a relabelling of the probabilities would save; zero at best.
        discrimination: how much better the recalibrated prediction is than one and the same
            distribution at all times, that of the measured outputs. May be negative.
        uncertainty: score of that distribution of all measured outputs.
        mean_expected: the mean score that the prediction expects of itself.
        miscalibration_expected: the miscalibration that a calibrated prediction would show in a
            record of this length, as chance leaves some: its mean over joint samples.
    """

    mean: np.ndarray
    miscalibration: np.ndarray
    discrimination: np.ndarray
    uncertainty: np.ndarray
    mean_expected: np.ndarray
    miscalibration_expected: np.ndarray


def decomposition(
    prediction: Prediction, outputs: np.ndarray, samples: np.ndarray
) -> CrpsDecomposition:
    """Decompose the score of outputs (n, n_y), and of samples (S', n, n_y) for comparison."""
    members = quantile_members(prediction)
    rows = []
    for a in range(outputs.shape[1]):
        there = np.isfinite(outputs[:, a])
        x, y = members[:, there, a], outputs[there, a]
        miscalibration, potential = hersbach(x, y)
        uncertainty = climatological(y)
        replicated = np.array([hersbach(x, one) for one in samples[:, there, a]])
        rows.append(
            (
                miscalibration + potential,
                miscalibration,
                uncertainty - potential,
                uncertainty,
                replicated.sum(axis=1).mean(),
                replicated[:, 0].mean(),
            )
        )
    return CrpsDecomposition(*np.array(rows).T)


def quantile_members(prediction: Prediction, count: int = MEMBERS) -> np.ndarray:
    """Quantiles (count, n, n_y) of measured outputs at the levels (i - 1/2)/count.

    These levels make the ensemble score equal to the midpoint rule for the integral of the
    quantile score. The distribution function is tabulated and inverted on the scale of normal
    quantiles, which is exact for a Gaussian prediction and saves the bisection for each level.
    """
    mean, sd = prediction.mean, prediction.sd
    steps = np.linspace(-8.0, 8.0, 161)
    table = np.stack([prediction.probability_integral(mean + z * sd) for z in steps])
    scores = ndtri(np.clip(table, 1e-15, 1.0 - 1e-15))
    wanted = ndtri((np.arange(count) + 0.5) / count)
    out = np.empty((count, *mean.shape))
    for t, a in np.ndindex(mean.shape):
        out[:, t, a] = mean[t, a] + sd[t, a] * np.interp(wanted, scores[:, t, a], steps)
    return out


def hersbach(members: np.ndarray, y: np.ndarray) -> tuple[float, float]:
    """Reliability and potential score of an ensemble, which add up to its mean score.

    Args:
        members: (M, n) in increasing order. y: (n,) what happened.

    Returns:
        Equations 36 and 37 of Hersbach (2000), [unit of y].
    """
    count = len(members)
    widths = np.diff(members, axis=0)
    # Mean stretch of each interval between members that lies below and above the outcome.
    below = np.clip(y - members[:-1], 0.0, widths).mean(axis=1)
    above = widths.mean(axis=1) - below
    inner = below + above
    share = np.divide(above, inner, out=np.zeros_like(above), where=inner > 0)
    under, over = members[0] - y, y - members[-1]  # outcomes outside the ensemble
    first, last = float(np.mean(under > 0)), float(np.mean(over > 0))
    gap = np.concatenate(
        [
            [np.maximum(under, 0.0).mean() / first if first else 0.0],
            inner,
            [np.maximum(over, 0.0).mean() / last if last else 0.0],
        ]
    )
    frequency = np.concatenate([[first], share, [1.0 - last]])
    probability = np.arange(count + 1) / count
    reliability = float(np.sum(gap * (frequency - probability) ** 2))
    return reliability, float(np.sum(gap * frequency * (1.0 - frequency)))


def climatological(y: np.ndarray) -> float:
    """Mean score of the distribution of all outcomes (n,), used as the prediction of each."""
    ordered = np.sort(y)
    share = np.arange(1, len(y)) / len(y)
    return float(np.sum(np.diff(ordered) * share * (1.0 - share)))
