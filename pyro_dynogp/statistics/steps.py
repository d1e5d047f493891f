"""Steps at any instant, of the level or of what a signal contributes, as variants of an effect."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from pyro_dynogp.statistics.bootstrap import Scan
from pyro_dynogp.statistics.evidence import Residuals
from pyro_dynogp.statistics.prewhitening import (
    Projection,
    Score,
    Scored,
    Variants,
    log_ratio,
    prewhitened,
)
from pyro_dynogp.statistics.settings import LoopSettings

# Levels of a staircase that stands for any step while the first filter is fitted.
LEVELS = 8
# Of instants that are tried around one, by how much they are closer each time.
NARROWER = 30


def step_scan(
    residuals: Residuals,
    signals: np.ndarray,
    nuisance: np.ndarray,
    settings: LoopSettings,
    seed: int,
) -> tuple[Scan, int, int]:
    """Test whether any of some signals (n, K) begins to act at any instant.

    Args:
        signals: finite; ones for the level. nuisance: (n, M) from `spanning`; no step may claim it.
        seed: of the replicates.

    Returns:
        The scan; which signal steps, and at which sample, in the best variant.

    Raises:
        ValueError: where there are too few samples.
    """
    places = instants(len(residuals), settings.step_margin)
    scan = prewhitened(
        residuals.residual,
        steps(signals, places),
        nuisance,
        residuals.deviations,
        settings,
        first=np.column_stack([stairs(signals), nuisance]),
        seed=seed,
    )
    k, place = divmod(scan.best, len(places))
    return scan, k, int(places[place])


def beginning(
    residual: np.ndarray,
    columns: Callable[[np.ndarray], np.ndarray],
    under: Projection,
    places: np.ndarray,
    at: int,
    within: int,
) -> tuple[int, np.ndarray, np.ndarray]:
    """The sample near one at which signals begin that explain most of a residual.

    Some instants are tried, and then those around the best of them, down to every one.

    Args:
        residual: (n,). columns: samples (m,) -> (n, m, K), the signals that begin at each of them.
        under: the filter, and what the signals may not claim. places: samples where it may be.
        at: where to begin, one of `places`. within: how far from there it may be [samples].

    Returns:
        The sample, weights of its signals (K,), and what they explain (n,).
    """
    e, stride = under(residual), within
    while True:
        stride = max(stride // NARROWER, 1)
        around = np.arange(at - within, at + within + 1, stride)
        around = around[(around >= places[0]) & (around <= places[-1])]
        made = columns(around)
        filtered = np.stack([under(column) for column in np.moveaxis(made, 2, 0)], axis=2)
        filtered = filtered.swapaxes(0, 1)
        weights = np.linalg.pinv(filtered, rcond=1e-6) @ e
        left = np.square(e - np.einsum("jmk,jk->jm", filtered, weights)).sum(1)
        best = int(np.argmin(left))
        at, within = int(around[best]), stride
        if stride == 1:
            return at, weights[best], made[:, best] @ weights[best]


def instants(count: int, margin: float) -> np.ndarray:
    """Samples of a record of `count` at which a step is looked for: not in this share at its ends.

    At least five samples are left at each end.
    """
    ends = max(int(margin * count), 5)
    return np.arange(ends, count - ends)


def stairs(signals: np.ndarray) -> np.ndarray:
    """Signals (n, J) times each level of a staircase, (n, 8 J)."""
    n = len(signals)
    levels = np.eye(LEVELS)[np.arange(n) * LEVELS // n]
    return np.concatenate([levels * s[:, None] for s in signals.T], axis=1)


def steps(signals: np.ndarray, places: np.ndarray) -> Variants:
    r"""Signals that begin at an instant: variant k M + j is signal k times a step at places[j].

    With m the signal, a step at s is D_s m = (m_t for t >= s, else 0), a sum of pulses. Under a
    filter W with coefficients c = (1, -a) its product with a series e is the sum from s on of
    m_t (W^T e)_t, and its square the sum from s on of

        m_t^2 G_tt + 2 sum_{k=1..p} m_t m_{t+k} G_{t,t+k},   G = W^T W,

    so that all instants together take O(n p^2).

    Args:
        signals: (n, K), finite; ones for the level. places: (M,) samples where a step may be.
    """
    n, K = signals.shape

    def prepare(under: Projection) -> Score:
        p = under.whiten.order
        c = np.concatenate([[1.0], -under.whiten.coefficients])

        def pulses(values: np.ndarray, weights: np.ndarray) -> np.ndarray:
            """Sum over k of weights_k values_(s+k) for s in 0..n-1; values (m, ...) on rows."""
            full = np.zeros((n + p, *values.shape[1:]))
            full[under.samples] = values
            return np.sum([w * full[k : n + k] for k, w in enumerate(weights) if w], axis=0)

        def from_there(values: np.ndarray) -> np.ndarray:
            """Sums (M, ...) from each place to the end."""
            return np.cumsum(values[::-1], axis=0)[::-1][places]

        ones = np.ones(int(under.rows.sum()))
        squares = np.zeros((n, K))
        for k in range(p + 1):
            G = pulses(ones, np.concatenate([np.zeros(k), c[k:] * c[: p + 1 - k]]))
            later = np.zeros((n, K))
            later[: n - k] = signals[k:]
            squares += (2.0 if k else 1.0) * G[:, None] * signals * later
        norm = from_there(squares)  # (M, K)
        spanned = pulses(under.Q, c)
        taken = [np.square(from_there(spanned * m[:, None])).sum(1) for m in signals.T]
        left = norm.T - np.stack(taken)
        usable = left > 1e-6 * norm.T

        def score(x: np.ndarray) -> Scored:
            e = under(x)
            b = from_there(pulses(e, c)[:, None] * signals).T
            explained = np.where(usable, b**2 / np.where(usable, left, 1.0), 0.0)
            gains = len(e) * log_ratio(explained.ravel(), float(e @ e))

            def fit(j: int) -> tuple[np.ndarray, np.ndarray]:
                k, place = divmod(j, len(places))
                step = np.where(np.arange(n) >= places[place], signals[:, k], 0.0)
                return under.with_nuisance(under.fit(step[:, None], x), x)

            return gains, fit

        return score

    return Variants(prepare, np.ones(K * len(places)))
