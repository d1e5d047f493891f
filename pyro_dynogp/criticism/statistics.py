"""Statistics of one measured series that show whether its dynamics are as predicted.

Each takes time (n,) and one output y (n,) with NaN at missing samples, and returns a number; NaN
where the series is too short or has too many gaps for it. Lags and frequencies count samples: a
record with irregular times is compared with replicates at the same times, so that both are
distorted in the same way.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from types import MappingProxyType

import numpy as np

Statistic = Callable[[np.ndarray, np.ndarray], float]

FEWEST_PAIRS = 10


def mean(time: np.ndarray, y: np.ndarray) -> float:
    """Mean [output]."""
    return float(np.nanmean(y))


def standard_deviation(time: np.ndarray, y: np.ndarray) -> float:
    """Standard deviation [output]."""
    return float(np.nanstd(y))


def minimum(time: np.ndarray, y: np.ndarray) -> float:
    """Smallest value [output]."""
    return float(np.nanmin(y))


def maximum(time: np.ndarray, y: np.ndarray) -> float:
    """Largest value [output]."""
    return float(np.nanmax(y))


def largest_increment(time: np.ndarray, y: np.ndarray) -> float:
    """Largest absolute difference of neighbouring samples [output]; both have to be there."""
    steps = np.abs(np.diff(y))
    return float(np.nanmax(steps)) if np.isfinite(steps).any() else float("nan")


def autocorrelation(time: np.ndarray, y: np.ndarray, lag: int) -> float:
    """Correlation of samples `lag` apart, over all pairs of which both are there (ten or more)."""
    if lag >= len(y):
        return float("nan")
    centred = y - np.nanmean(y)
    product = centred[lag:] * centred[: len(y) - lag]
    power = np.nanmean(centred**2)
    if np.isfinite(product).sum() < FEWEST_PAIRS or power == 0.0:
        return float("nan")
    return float(np.nanmean(product) / power)


def increment_autocorrelation(time: np.ndarray, y: np.ndarray, lag: int) -> float:
    """Autocorrelation of the differences of neighbouring samples."""
    steps = np.diff(y)
    if not np.isfinite(steps).any():
        return float("nan")
    return autocorrelation(time[1:], steps, lag)


def log_power(time: np.ndarray, y: np.ndarray, low: float, high: float) -> float:
    """Decadic logarithm of the mean of the periodogram in a band [log10 of output squared].

    The mean is taken off first, and missing samples then are zero: this convolves the periodogram
    with that of the gaps, in the replicates as in the measured series.

    Args:
        time: (n,). y: (n,). low, high: the band (low, high] in cycles per sample.
    """
    there = np.isfinite(y)
    filled = np.where(there, y - np.nanmean(y), 0.0)
    frequency = np.fft.rfftfreq(len(y))
    band = (frequency > low) & (frequency <= high)
    if not band.any():
        return float("nan")
    power = np.mean(np.abs(np.fft.rfft(filled)[band]) ** 2) / there.sum()
    return float(np.log10(power)) if power > 0 else float("nan")


def mean_crossings(time: np.ndarray, y: np.ndarray) -> float:
    """Number of times that the series crosses its mean, between samples that are there."""
    side = y[np.isfinite(y)] > np.nanmean(y)
    return float(np.count_nonzero(side[1:] != side[:-1]))


_BANDS = ((0.0, 0.02), (0.02, 0.1), (0.1, 0.25), (0.25, 0.5))

STATISTICS: Mapping[str, Statistic] = MappingProxyType(
    {
        "mean": mean,
        "standard deviation": standard_deviation,
        "minimum": minimum,
        "maximum": maximum,
        "largest absolute increment": largest_increment,
        "crossings of the mean": mean_crossings,
        **{f"autocorrelation, lag {k}": partial(autocorrelation, lag=k) for k in (1, 2, 5, 10)},
        **{
            f"autocorrelation of increments, lag {k}": partial(increment_autocorrelation, lag=k)
            for k in (1, 2)
        },
        **{
            f"log power, {low:g} to {high:g} cycles/sample": partial(log_power, low=low, high=high)
            for low, high in _BANDS
        },
    }
)


def unit(name: str, output_unit: str) -> str:
    """Unit of the statistic of that name; empty where it is not known."""
    if name not in STATISTICS:
        return ""
    if name.startswith("log power"):
        compound = not output_unit.isalpha()
        squared = f"({output_unit})²" if compound else f"{output_unit}²"
        return f"log10 {squared}" if output_unit else ""
    return "-" if name.startswith(("autocorrelation", "crossings")) else output_unit
