"""Delays of inputs, found by regressions of the output on its own past and delayed inputs."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np

from pyro_dynogp.data.record import Record

# Lags of the output and of each input in the regression, and how many delays are kept.
PAST, LAGS, KEPT = 4, 4, 3


def likely_delays(
    output: np.ndarray, inputs: np.ndarray, delayed: Sequence[int], most: int
) -> list[int]:
    """Delays [samples] at which a regression leaves least, best first; local minima alone.

    Args:
        output: (n,), NaN where missing. inputs: (n, n_u). delayed: columns that are delayed
            together; the others act at once. most: largest delay.

    Source: autoregressions with exogenous inputs over a range of delays, Ljung, System
    Identification (2nd ed., 1999), section 16.4.
    """
    n, U = len(output), inputs - inputs.mean(0)
    first = most + max(PAST, LAGS)
    if n - first < 4 * (PAST + LAGS * inputs.shape[1]):
        return []
    rows = np.arange(first, n)

    def lagged(x: np.ndarray, lags: Sequence[int]) -> np.ndarray:
        return np.stack([x[rows - k] for k in lags], axis=1)

    others = [j for j in range(U.shape[1]) if j not in delayed]
    fixed = [np.ones((len(rows), 1)), lagged(output, range(1, PAST + 1))]
    fixed += [lagged(U[:, j], range(LAGS)) for j in others]
    start = np.concatenate(fixed, axis=1)
    measured = np.isfinite(start).all(1) & np.isfinite(output[rows])
    if measured.sum() < 4 * (PAST + LAGS * inputs.shape[1]):
        return []
    Q, _ = np.linalg.qr(start[measured])
    y = output[rows][measured]
    y = y - Q @ (Q.T @ y)
    left = np.empty(most + 1)
    for d in range(most + 1):
        X = np.concatenate([lagged(U[:, j], range(d, d + LAGS)) for j in delayed], axis=1)
        X = X[measured]
        X = X - Q @ (Q.T @ X)
        fit = X @ np.linalg.lstsq(X, y, rcond=1e-8)[0]
        left[d] = np.square(y - fit).sum()
    around = np.concatenate([[np.inf], left, [np.inf]])
    low = np.flatnonzero((left <= around[:-2]) & (left <= around[2:]))
    return [int(d) for d in low[np.argsort(left[low], kind="stable")][:KEPT]]


def resolved(delays: Iterable[float], record: Record) -> list[float]:
    """Delays that a record can tell apart: on an even clock whole samples, one at least.

    A held input that arrives within a sample is, at the samples, one that arrives with the next and
    acts with another numerator: x[k+1] = phi x[k] + g1 u[k] + g2 u[k+1] for every fraction of it
    (Franklin, Powell & Workman, Digital Control of Dynamic Systems, 3rd ed., section 4.3).
    """
    if not record.is_regular:
        return sorted(delays)
    step = record.sampling_time
    return [step * count for count in sorted({max(round(delay / step), 1) for delay in delays})]
