r"""Test for lasting effects: regression of a residual on its own past and on an effect's columns.

    e_t = \sum_i a_i e_(t-i) + \beta' N_t + \gamma' x_t + \epsilon_t

with and without the columns x of the effect. The noise's colour a is estimated together with the
effect: a filter that is fitted to the residual beforehand takes a slow effect for colour and
filters it away. Effect and nuisance come with their own past (see `with_past`), which stands for
the noise's filter, (1 - A) x; responses of a bank of filters have it among themselves.

The statistic is the largest standardised log likelihood ratio over all variants of the effect, the
null that of the regression without the effect, with a estimated anew in each (`bootstrap`).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from pyro_dynogp.statistics.autoregression import Whitener, check_samples, fitted_filter
from pyro_dynogp.statistics.bootstrap import SLOWEST, Scan, noise_of, radius, scanned
from pyro_dynogp.statistics.settings import LoopSettings
from pyro_dynogp.support.errors import invalid


def with_past(columns: np.ndarray) -> np.ndarray:
    """Columns (n,) or (n, K) beside themselves one sample before, (n, 2 K)."""
    columns = columns[:, None] if columns.ndim == 1 else columns
    return np.column_stack([columns, np.concatenate([columns[:1], columns[:-1]])])


def regress(
    residual: np.ndarray,
    variants: Sequence[np.ndarray],
    nuisance: np.ndarray | None,
    deviations: np.ndarray,
    settings: LoopSettings,
    seed: int = 0,
) -> Scan:
    """Test whether any variant of an effect explains a residual beside its own past.

    Args:
        residual: (n,), NaN where missing or not looked at.
        variants: each (n, K) columns, finite. nuisance: (n, M), finite; a constant always is one.
        deviations: (S, n) what the uncertainty of the parameters may leave in the residual.
        settings: thresholds. seed: of the replicates.

    Raises:
        ValueError: where whole are no variants, or too few samples beyond what the nuisance and the
            past take.
    """
    if not len(variants):
        raise invalid("variants", expected="at least one", got="none")
    n = len(residual)
    series = _lags(residual, max(fitted_filter(residual, settings).order, 1))
    whole, p = np.isfinite(series).all(0), len(series) - 1
    N = np.ones((n, 1)) if nuisance is None else np.column_stack([np.ones(n), nuisance])
    m = int(whole.sum())
    Z = basis(N[whole]) if m else N[whole]
    samples = m - Z.shape[1] - p
    check_samples(samples, settings, "samples beyond nuisance and past")
    bases = [basis((x := v[whole]) - Z @ (Z.T @ x), against=x) for v in variants]
    X = np.column_stack(bases)
    K = np.array([max(b.shape[1], 1) for b in bases], dtype=float)
    ends = np.cumsum([b.shape[1] for b in bases])
    free = series[:, whole] - (series[:, whole] @ Z) @ Z.T
    gains = _ratios((free @ free.T)[None], (free @ X)[None], ends, samples)[0]
    rows = np.flatnonzero(whole) - np.arange(p + 1)[:, None]

    def products(lags: np.ndarray) -> np.ndarray:
        """Of series and their past (R, p + 1, m), less the nuisance."""
        taken = lags @ Z  # replicates are noise: little is lost in the difference
        return lags @ lags.swapaxes(1, 2) - taken @ taken.swapaxes(1, 2)

    def estimated(batch: np.ndarray) -> np.ndarray:
        G = products(batch[:, rows])
        return np.linalg.solve(G[:, 1:, 1:], G[:, 1:, :1])[:, :, 0]

    def gains_of(batch: np.ndarray) -> np.ndarray:  # X has nothing of the nuisance
        return _ratios(products(lags := batch[:, rows]), lags @ X, ends, samples)

    design = np.concatenate([series[1:].T, N], axis=1)[whole]
    weights = solve(design, residual[whole])
    e, a = residual[whole] - design @ weights, weights[:p]
    # Least squares may leave a pole outside the circle or next to it.
    a = a * min(1.0, SLOWEST / max(radius(a), 1e-300)) ** np.arange(1, p + 1)
    noise = noise_of(a, e, design.shape[1], ~np.isfinite(residual), deviations)
    noise = noise.unbiased(estimated, settings.replicates, seed)
    null = map(gains_of, noise.replicates(settings.replicates, seed))

    def fit(best: int) -> tuple[np.ndarray, Whitener]:
        both = np.column_stack([variants[best], N])
        whiten = _colour(series, both, whole)
        kept = whole[whiten.order :]
        weights = solve(whiten(both)[kept], whiten(residual)[kept])
        fitted = variants[best] @ weights[: variants[best].shape[1]]
        return fitted - fitted[whole].mean(), whiten

    return scanned(gains, K, null, fit, whole, settings)


def noise_filter(residual: np.ndarray, columns: np.ndarray, settings: LoopSettings) -> Whitener:
    """Filter of the noise: a residual's own past (n,), NaN where missing, beside columns (n, M)."""
    series = _lags(residual, max(fitted_filter(residual, settings).order, 1))
    whole = np.isfinite(series).all(0)
    return _colour(series, np.column_stack([np.ones(len(residual)), columns]), whole)


def _lags(x: np.ndarray, p: int) -> np.ndarray:
    """The series and itself 1, ..., p samples before, (p + 1, n), NaN before the beginning."""
    out = np.full((p + 1, len(x)), np.nan)
    for i in range(p + 1):
        out[i, i:] = x[: len(x) - i]
    return out


def _ratios(products: np.ndarray, cross: np.ndarray, ends: np.ndarray, samples: int) -> np.ndarray:
    """Twice the log likelihood ratio of each variant, (R, J).

    Args:
        products: (R, p + 1, p + 1) of a series and its past, less what the nuisance explains.
        cross: (R, p + 1, K1 + ... + KJ) with orthonormal columns of each variant, likewise.
        ends: (J,) of them. samples: degrees of freedom.
    """
    past = products[:, 1:, 1:]
    # What the past explains of the present and of the columns; rounding must not make it singular.
    past = past + 1e-10 * np.trace(past, axis1=1, axis2=2)[:, None, None] * np.eye(past.shape[1])
    a = np.linalg.solve(past, np.concatenate([products[:, 1:, :1], cross[:, 1:]], axis=2))
    total = products[:, 0, 0] - (products[:, 0, 1:] * a[:, :, 0]).sum(1)
    b = cross[:, 0] - np.einsum("ri,rik->rk", products[:, 0, 1:], a[:, :, 1:])
    explained = []
    for start, end in zip(np.concatenate([[0], ends[:-1]]), ends, strict=True):
        part = slice(start, end)
        G = np.eye(end - start) - cross[:, 1:, part].swapaxes(1, 2) @ a[:, :, 1:][:, :, part]
        G = G + 1e-9 * np.eye(end - start)
        weights = np.linalg.solve(G, b[:, part, None])[:, :, 0]
        explained.append((b[:, part] * weights).sum(1))
    share = np.stack(explained, axis=1) / np.maximum(total, 1e-300)[:, None]
    return -samples * np.log1p(-np.clip(share, 0.0, 1.0 - 1e-12))


def _colour(series: np.ndarray, columns: np.ndarray, whole: np.ndarray) -> Whitener:
    """The residual's own past beside columns."""
    design = np.concatenate([series[1:].T, columns], axis=1)[whole]
    return Whitener(solve(design, series[0, whole])[: len(series) - 1])


def solve(columns: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Least squares of y (n,) on columns (n, K), whatever the units of the columns."""
    size = np.sqrt(np.square(columns).mean(0))
    size = np.where(size > 0, size, 1.0)
    return np.linalg.lstsq(columns / size, y, rcond=1e-8)[0] / size


def basis(columns: np.ndarray, against: np.ndarray | None = None) -> np.ndarray:
    """Orthonormal columns of the same span, without those that are next to nothing.

    Sizes are about the mean, which a constant explains, so that offsets do not matter.
    """
    reference = columns if against is None else against
    size = np.sqrt(np.square(reference - reference.mean(0)).sum(0))
    level = np.sqrt(np.square(reference).sum(0))
    size = np.where(size > 1e-9 * level, size, level)
    if against is None:  # a constant among them takes the offsets
        columns = np.column_stack([np.ones(len(columns)), columns - columns.mean(0)])
        size = np.concatenate([[np.sqrt(len(columns))], size])
    left, values, _ = np.linalg.svd(columns / np.where(size > 0, size, 1.0), full_matrices=False)
    return left[:, values > 1e-5 * max(1.0, float(values.max(initial=0.0)))]
