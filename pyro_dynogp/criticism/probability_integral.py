"""Curves of the probability integral transform of one output, each with its band."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import ndtri

from pyro_dynogp.criticism.envelope import envelope
from pyro_dynogp.support.shown import shown

# Multiples of 1/80: they hold the ends of the central 50 and 95 % intervals.
LEVELS = np.arange(1, 80) / 80
NOMINAL = np.arange(1, 20) / 20


@shown
@dataclass(repr=False, frozen=True, eq=False)
class PitCurves:
    """One output; the fields are those of `Calibration` without the axis of outputs."""

    ecdf: np.ndarray
    low: np.ndarray
    high: np.ndarray
    coverage: np.ndarray
    coverage_low: np.ndarray
    coverage_high: np.ndarray
    density: np.ndarray
    density_low: np.ndarray
    density_high: np.ndarray
    p_value: float
    location: float
    location_p: float
    spread: float
    spread_p: float


def pit_curves(
    pit: np.ndarray, replicated: np.ndarray, edges: np.ndarray, level: float
) -> PitCurves:
    """Curves of PIT values (n,) beside those of joint samples (S', n); NaN is left out.

    The ECDF and the coverage share one test: strong dependence in time lets the ECDF stray so far
    that a distribution twice too wide stays inside, while its coverage tells.
    """
    there = np.isfinite(pit)
    every = np.sort(np.vstack([pit[there], replicated[:, there]]), axis=1)
    ecdf = _shares(every, LEVELS)
    coverage = _shares(np.sort(np.abs(2.0 * every - 1.0), axis=1), NOMINAL)
    both = np.hstack([ecdf, coverage])
    band = envelope(both[0], both[1:], level)
    low, coverage_low = np.split(np.clip(band.low, 0.0, 1.0), [len(LEVELS)])
    high, coverage_high = np.split(np.clip(band.high, 0.0, 1.0), [len(LEVELS)])
    density = np.stack([np.histogram(row, edges, density=True)[0] for row in every])
    bars = envelope(density[0], density[1:], level)
    moments = _moments(every)
    diagnosis = envelope(moments[0], moments[1:], level)
    return PitCurves(
        ecdf=ecdf[0],
        low=low,
        high=high,
        coverage=coverage[0],
        coverage_low=coverage_low,
        coverage_high=coverage_high,
        density=density[0],
        density_low=np.maximum(bars.low, 0.0),
        density_high=bars.high,
        p_value=band.p_value,
        location=float(moments[0, 0]),
        location_p=float(diagnosis.p_values[0]),
        spread=float(moments[0, 1] / np.mean(moments[1:, 1])),
        spread_p=float(diagnosis.p_values[1]),
    )


def _shares(ordered: np.ndarray, levels: np.ndarray) -> np.ndarray:
    """Shares (S, K) of ordered values (S, n) at or below each level."""
    counts = [np.searchsorted(row, levels, side="right") for row in ordered]
    return np.stack(counts) / ordered.shape[1]


def _moments(pit: np.ndarray) -> np.ndarray:
    """Location and spread (S, 2) of the normal scores of PIT values (S, n).

    The location is the mean over the standard deviation: a distribution that is only too narrow
    changes its spread and leaves its location as it is.
    """
    scores = ndtri(np.clip(pit, 1e-15, 1.0 - 1e-15))
    mean, sd = scores.mean(axis=1), scores.std(axis=1)
    location = np.divide(mean, sd, out=np.zeros_like(mean), where=sd > 0)
    return np.column_stack([location, sd])
