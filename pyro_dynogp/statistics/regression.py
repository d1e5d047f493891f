r"""Test for lasting effects: regression of a residual on its own past and on an effect's columns.

    e_t = \sum_i a_i e_(t-i) + \beta' N_t + \gamma' x_t + \epsilon_t

with and without the columns x of the effect. The noise's colour a is estimated together with the
effect: a filter that is fitted to the residual beforehand takes a slow effect for colour and
filters it away. Effect and nuisance come with their own past (see `with_past`), which stands for
the noise's filter, (1 - A) x; responses of a bank of filters have it among themselves.

The statistic is the largest standardised log likelihood ratio over all variants of the effect. Its
null distribution is that of series made by the regression without the effect, its innovations in
random order with replacement, with a estimated anew in each (the sieve bootstrap: Bühlmann,
Bernoulli 3(2):123, 1997); to each a draw of what the parameters' uncertainty leaves is added.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence

import numpy as np
from scipy.signal import lfilter

from pyro_dynogp.statistics.autoregression import fitted_filter
from pyro_dynogp.statistics.scan import Scan, tail_probability
from pyro_dynogp.statistics.whitening import Whitener
from pyro_dynogp.support.errors import invalid

REPLICATES, CHUNK = 200, 50
# Samples before a replicate begins.
RUN_IN = 300
# Largest pole of the noise in replicates, which must forget their start in the run-in.
SLOWEST = 0.99


def with_past(columns: np.ndarray) -> np.ndarray:
    """Columns (n,) or (n, K) beside themselves one sample before, (n, 2 K)."""
    columns = columns[:, None] if columns.ndim == 1 else columns
    return np.column_stack([columns, np.concatenate([columns[:1], columns[:-1]])])


def regress(
    residual: np.ndarray,
    variants: Sequence[np.ndarray],
    *,
    nuisance: np.ndarray | None = None,
    deviations: np.ndarray | None = None,
    replicates: int = REPLICATES,
    seed: int = 0,
) -> Scan:
    """Test whether any variant of an effect explains a residual beside its own past.

    Args:
        residual: (n,), NaN where missing or not looked at.
        variants: each (n, K) columns, finite. nuisance: (n, M), finite; a constant always is one.
        deviations: (S, n) what the uncertainty of the parameters may leave in the residual.
        replicates: number of replicates under the null; with none the p-value is one.
        seed: of their random numbers.

    Returns:
        Result; `weights` and `fitted` are those of the best variant's columns under the noise's
        filter as estimated beside them.

    Raises:
        ValueError: where there are no variants, or fewer than 30 samples beyond what the nuisance
            and the past take.
    """
    if not len(variants):
        raise invalid("variants", expected="at least one", got="none")
    n = len(residual)
    p = max(fitted_filter(residual).order, 1)
    series = _lags(residual, p)
    there = np.isfinite(series).all(0)
    N = np.ones((n, 1)) if nuisance is None else np.column_stack([np.ones(n), nuisance])
    m = int(there.sum())
    Z = _basis(N[there]) if m else N[there]
    samples = m - Z.shape[1] - p
    if samples < 30:
        raise invalid("residual", expected="at least 30 samples to look at", got=str(samples))
    bases = [_basis((x := v[there]) - Z @ (Z.T @ x), against=x) for v in variants]
    X = np.column_stack(bases)
    K = np.array([max(b.shape[1], 1) for b in bases], dtype=float)
    ends = np.cumsum([b.shape[1] for b in bases])
    free = series[:, there] - (series[:, there] @ Z) @ Z.T
    own = _ratios((free @ free.T)[None], (free @ X)[None], ends, samples)[0]
    z = (own - K) / np.sqrt(2.0 * K)
    best = int(np.argmax(z))
    p_value = 1.0
    if replicates:
        rows = np.flatnonzero(there) - np.arange(p + 1)[:, None]

        def beside(made: np.ndarray) -> Iterator[tuple[np.ndarray, np.ndarray]]:
            """Some series and their past (R, p + 1, m), and products of all less the nuisance."""
            for start in range(0, len(made), CHUNK):
                lags = made[start : start + CHUNK, rows]
                taken = lags @ Z  # replicates are noise: little is lost in the difference
                yield lags, lags @ lags.swapaxes(1, 2) - taken @ taken.swapaxes(1, 2)

        made = _replicates(residual, series, N, there, beside, deviations, replicates, seed)
        # X has nothing of the nuisance.
        null = np.concatenate([_ratios(G, lags @ X, ends, samples) for lags, G in beside(made)])
        z_null = ((null - K) / np.sqrt(2.0 * K)).max(1)
        p_value = tail_probability(z_null, float(z[best]))
    weights, fitted = _fit(residual, series, variants[best], N, there)
    gains = 0.5 * own
    return Scan(
        statistic=float(z[best]),
        p_value=p_value,
        best=best,
        gain=float(gains[best]),
        gains=gains,
        weights=weights,
        size=float(fitted[there].std()),
        fitted=fitted,
    )


def noise_filter(residual: np.ndarray, columns: np.ndarray) -> Whitener:
    """Filter of the noise: a residual's own past (n,), NaN where missing, beside columns (n, M)."""
    series = _lags(residual, max(fitted_filter(residual).order, 1))
    there = np.isfinite(series).all(0)
    return _colour(series, np.column_stack([np.ones(len(residual)), columns]), there)


def gains_under(
    whiten: Whitener,
    residual: np.ndarray,
    variants: Sequence[np.ndarray],
    nuisance: np.ndarray,
    weight: float | None = None,
) -> np.ndarray:
    """Gains [nats] of variants, (J,), under one filter of the noise: to find where an effect is.

    With a filter for each, as in `regress`, the residual's own past would do much of what the
    variant should: it makes any resonance.

    Args:
        whiten: of the noise. residual: (n,), NaN where missing or not looked at.
        variants: each (n,) or (n, K), finite. nuisance: (n, M).
        weight: of the columns; by default the best.
    """
    N = whiten(np.column_stack([np.ones(len(residual)), nuisance]))
    e = whiten(residual)
    rows = np.isfinite(e)
    Q = _basis(N[rows])
    e = e[rows] - Q @ (Q.T @ e[rows])
    gains = []
    for v in variants:
        w = whiten(v[:, None] if v.ndim == 1 else v)[rows]
        w = w - Q @ (Q.T @ w)
        fit = w @ (_solve(w, e) if weight is None else np.full(w.shape[1], weight))
        gains.append(0.5 * len(e) * np.log((e @ e) / np.square(e - fit).sum()))
    return np.array(gains)


def _lags(x: np.ndarray, p: int) -> np.ndarray:
    """The series and itself 1, ..., p samples before, (p + 1, n), NaN before the beginning."""
    out = np.full((p + 1, len(x)), np.nan)
    for i in range(p + 1):
        out[i, i:] = x[: len(x) - i]
    return out


def _ratios(own: np.ndarray, cross: np.ndarray, ends: np.ndarray, samples: int) -> np.ndarray:
    """Twice the log likelihood ratio of each variant, (R, J).

    Args:
        own: (R, p + 1, p + 1) products of a series and its past, less what the nuisance explains.
        cross: (R, p + 1, K1 + ... + KJ) with orthonormal columns of each variant, likewise.
        ends: (J,) of them. samples: degrees of freedom.
    """
    past = own[:, 1:, 1:]
    # What the past explains of the present and of the columns; rounding must not make it singular.
    past = past + 1e-10 * np.trace(past, axis1=1, axis2=2)[:, None, None] * np.eye(past.shape[1])
    a = np.linalg.solve(past, np.concatenate([own[:, 1:, :1], cross[:, 1:]], axis=2))
    total = own[:, 0, 0] - (own[:, 0, 1:] * a[:, :, 0]).sum(1)
    b = cross[:, 0] - np.einsum("ri,rik->rk", own[:, 0, 1:], a[:, :, 1:])
    explained = []
    for start, end in zip(np.concatenate([[0], ends[:-1]]), ends, strict=True):
        part = slice(start, end)
        G = np.eye(end - start) - cross[:, 1:, part].swapaxes(1, 2) @ a[:, :, 1:][:, :, part]
        G = G + 1e-9 * np.eye(end - start)
        weights = np.linalg.solve(G, b[:, part, None])[:, :, 0]
        explained.append((b[:, part] * weights).sum(1))
    share = np.stack(explained, axis=1) / np.maximum(total, 1e-300)[:, None]
    return -samples * np.log1p(-np.clip(share, 0.0, 1.0 - 1e-12))


def _replicates(
    residual: np.ndarray,
    series: np.ndarray,
    N: np.ndarray,
    there: np.ndarray,
    beside: Callable[[np.ndarray], Iterator[tuple[np.ndarray, np.ndarray]]],
    deviations: np.ndarray | None,
    count: int,
    seed: int,
) -> np.ndarray:
    """Series (R, n) under the null, NaN where the residual is missing.

    Least squares make the noise too short-lived, the more so beside many columns: how much so the
    replicates themselves show, and are made again without it (Kilian, Review of Economics and
    Statistics 80:218, 1998).
    """
    p = len(series) - 1
    design = np.concatenate([series[1:].T, N], axis=1)[there]
    found = _solve(design, residual[there])
    e = residual[there] - design @ found
    e = (e - e.mean()) * np.sqrt(len(e) / max(len(e) - design.shape[1], 1))
    generator = np.random.default_rng(seed)
    drawn = e[generator.integers(len(e), size=(count, len(residual) + RUN_IN))]

    def made(a: np.ndarray, driven: np.ndarray) -> np.ndarray:
        return lfilter([1.0], np.concatenate([[1.0], -a]), driven)[:, RUN_IN:]

    a = _stable(found[:p])
    own = [G for _, G in beside(made(a, drawn[: 2 * CHUNK]))]
    again = np.concatenate([np.linalg.solve(G[:, 1:, 1:], G[:, 1:, :1])[:, :, 0] for G in own])
    out = made(_stable(2.0 * a - again.mean(0)), drawn)
    if deviations is not None and len(deviations):
        out = out + deviations[generator.integers(len(deviations), size=count)]
    return np.where(np.isfinite(residual), out, np.nan)


def _stable(a: np.ndarray) -> np.ndarray:
    """Coefficients whose poles, where outside the circle or next to it, are drawn in."""
    radius = np.abs(np.roots(np.concatenate([[1.0], -a]))).max(initial=0.0)
    shrink = min(1.0, SLOWEST / radius) if radius > 0 else 1.0
    return a * shrink ** np.arange(1, len(a) + 1)


def _colour(series: np.ndarray, columns: np.ndarray, there: np.ndarray) -> Whitener:
    """The residual's own past beside columns."""
    design = np.concatenate([series[1:].T, columns], axis=1)[there]
    return Whitener(_solve(design, series[0, there])[: len(series) - 1])


def _fit(
    residual: np.ndarray, series: np.ndarray, x: np.ndarray, N: np.ndarray, there: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Weights (K,) of columns, and what they explain (n,), mean removed."""
    both = np.column_stack([x, N])
    whiten = _colour(series, both, there)
    rows = there[whiten.order :]
    weights = _solve(whiten(both)[rows], whiten(residual)[rows])[: x.shape[1]]
    fitted = x @ weights
    return weights, fitted - fitted[there].mean()


def _solve(columns: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Least squares, whatever the units of the columns."""
    size = np.sqrt(np.square(columns).mean(0))
    size = np.where(size > 0, size, 1.0)
    return np.linalg.lstsq(columns / size, y, rcond=1e-8)[0] / size


def _basis(columns: np.ndarray, against: np.ndarray | None = None) -> np.ndarray:
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
