r"""Tests of slow and narrow effects, whose own trace in the residual would spoil its filter.

A drift, a step or a line in the spectrum looks to an autoregressive filter like colour, and is then
filtered away; without it the filter of a short residual is too flat at low frequencies, and noise
looks like drift. Hence in two steps, for the residual and for every replicate alike:

1. under a first filter, the same for all, the best variant of the effect is found and taken out;
2. a second filter is fitted to the rest; under it the residual's gains are looked at.

Where the colour can be estimated beside the effect at little cost (`joint`) that takes the place of
the filters, of which only the second one's order is used.

The replicates are series of that second filter, driven by its own residuals in random order with
replacement: the sieve bootstrap (Bühlmann, Bernoulli 3(2):123-148, 1997), with the filter estimated
anew in each and its bias taken out of the replicates' own. To each a draw of what the parameters'
uncertainty leaves is added.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.signal import lfilter

from pyro_dynogp.statistics.autoregression import fitted_filter
from pyro_dynogp.statistics.scan import tail_probability
from pyro_dynogp.statistics.whitening import Whitener
from pyro_dynogp.support.errors import invalid

# Replicates under the null, and their least number for long records.
REPLICATES, FEWEST = 199, 60
# Samples before a replicate begins, so that it forgets its start.
BURN_IN = 300

# How much each variant explains, 2 x nats (J,); and variant -> what it explains (n,), and what it
# and the nuisance explain (n,).
Scored = tuple[np.ndarray, Callable[[int], tuple[np.ndarray, np.ndarray]]]
Score = Callable[[np.ndarray], Scored]
Prepare = Callable[[Whitener], Score]


@dataclass(frozen=True, eq=False)
class Sieve:
    """Result of `sieve`.

    Attributes:
        statistic: largest standardised gain. p_value: of it.
        best: which variant. gains: (J,) of all [nats].
        fitted: (n,) what the best explains [unit of the residual].
        whitener: the second filter.
    """

    statistic: float
    p_value: float
    best: int
    gains: np.ndarray
    fitted: np.ndarray
    whitener: Whitener

    @property
    def gain(self) -> float:
        """Of the best variant [nats]."""
        return float(self.gains[self.best])

    @property
    def size(self) -> float:
        """Root mean square of what the best explains [unit of the residual]."""
        return float(np.sqrt(np.nanmean(self.fitted**2)))


def sieve(
    residual: np.ndarray,
    prepare: Prepare,
    degrees: np.ndarray,
    *,
    deviations: np.ndarray | None = None,
    first: np.ndarray | None = None,
    joint: bool = False,
    replicates: int = REPLICATES,
    seed: int = 0,
) -> Sieve:
    """Test whether any variant of an effect explains a residual.

    Args:
        residual: (n,), NaN where missing or not looked at.
        prepare: filter -> how much each variant explains of a series that is missing where the
            residual is.
        degrees: (J,) degrees of freedom of each variant.
        deviations: (S, n) what the uncertainty of the parameters may leave in the residual.
        first: (n, M) columns that are taken out, by least squares, before the first filter is
            fitted, so that the effect does not hide itself there.
        joint: the score estimates the colour beside the effect and takes of a filter no more than
            its order. What a strong effect leaves of the order is seen once it is taken out, so
            that the first filter is none.
        replicates: number of replicates under the null. seed: of their random numbers.

    Raises:
        ValueError: where fewer than 30 samples are there.
    """
    K = np.asarray(degrees, dtype=float)
    there = np.isfinite(residual)
    level = float(residual[there].mean()) if there.any() else 0.0
    x = residual - level
    if joint:
        coarse = prepare(Whitener(np.zeros(0)))
    else:
        coarse = prepare(fitted_filter(x if first is None else _without(x, first)))

    def rest(x: np.ndarray) -> np.ndarray:
        gains, fit = coarse(x)
        return x - fit(int(np.argmax((gains - K) / np.sqrt(2.0 * K))))[1]

    def tested(x: np.ndarray) -> tuple[np.ndarray, Score]:
        score = prepare(fitted_filter(rest(x)))
        return score(x)[0], score

    left = rest(x)
    whiten = fitted_filter(left)
    gains, score = tested(x)
    z = (gains - K) / np.sqrt(2.0 * K)
    driven, rows = _driven(whiten, left, replicates, seed), range(0, replicates, 2)
    drawn = _coloured(whiten, driven[rows])
    short = _mean_filter([fitted_filter(rest(s)) for s in np.where(there, drawn, np.nan)])
    null = []
    for series in _replicates(_corrected(whiten, short), driven, there, deviations, seed):
        own = tested(series)[0]
        null.append(float(((own - K) / np.sqrt(2.0 * K)).max()))
    best = int(np.argmax(z))
    return Sieve(
        statistic=float(z[best]),
        p_value=tail_probability(np.array(null), float(z[best])),
        best=best,
        gains=0.5 * gains,
        fitted=score(x)[1](best)[0],
        whitener=whiten,
    )


def _without(x: np.ndarray, columns: np.ndarray) -> np.ndarray:
    """What least squares leave of a series (n,) beside columns and a constant."""
    there = np.isfinite(x)
    Q = spanning(columns)
    return x - Q @ np.linalg.lstsq(Q[there], x[there], rcond=1e-9)[0]


def _driven(whiten: Whitener, rest: np.ndarray, count: int, seed: int) -> np.ndarray:
    """White series (R, n + BURN_IN) of what the filter leaves of `rest`, in random order."""
    e = whiten(rest)
    e = e[np.isfinite(e)]
    e = (e - e.mean()) * np.sqrt(len(e) / max(len(e) - whiten.order - 1, 1))
    drawn = np.random.default_rng(seed).integers(len(e), size=(count, len(rest) + BURN_IN))
    return e[drawn]


def _coloured(whiten: Whitener, driven: np.ndarray) -> np.ndarray:
    """Series (R, n) that the filter would make white, without their run-in."""
    return lfilter([1.0], np.concatenate([[1.0], -whiten.coefficients]), driven)[:, BURN_IN:]


def _replicates(
    whiten: Whitener,
    driven: np.ndarray,
    there: np.ndarray,
    deviations: np.ndarray | None,
    seed: int,
) -> np.ndarray:
    """Series (R, n) under the null, NaN where the residual is missing."""
    series = _coloured(whiten, driven)
    if deviations is not None and len(deviations):
        generator = np.random.default_rng([seed, 1])
        series = series + deviations[generator.integers(len(deviations), size=len(series))]
    return np.where(there, series, np.nan)


def _mean_filter(filters: Sequence[Whitener]) -> np.ndarray:
    """Average coefficients (p,) of filters of several orders."""
    a = np.zeros((len(filters), max(f.order for f in filters)))
    for row, f in zip(a, filters, strict=True):
        row[: f.order] = f.coefficients
    return a.mean(0)


def _corrected(whiten: Whitener, mean: np.ndarray) -> Whitener:
    """A filter less the bias that its own replicates show, kept stable.

    Source: Kilian, Review of Economics and Statistics 80(2):218 (1998).
    """
    p = max(whiten.order, len(mean))
    a, bias = np.zeros(p), np.zeros(p)
    a[: whiten.order] = whiten.coefficients
    bias[: len(mean)] = mean
    bias -= a
    for share in np.linspace(1.0, 0.0, 21):
        # A replicate must forget its start during the run-in.
        poles = np.abs(np.roots(np.concatenate([[1.0], share * bias - a])))
        if poles.max(initial=0.0) ** BURN_IN < 0.05:
            return Whitener(a - share * bias)
    return whiten


def replicates(samples: int, columns: int) -> int:
    """As many replicates as some seconds allow."""
    return int(np.clip(2.5e7 / (samples * max(columns, 1)), FEWEST, REPLICATES))


def spanning(columns: np.ndarray) -> np.ndarray:
    """A constant and an orthonormal basis (n, M) of what the columns add to it; NaN counts as 0."""
    n = len(columns)
    constant = np.full((n, 1), 1.0 / np.sqrt(n))
    x = np.nan_to_num(columns - np.nanmean(columns, axis=0)) if columns.size else np.zeros((n, 0))
    size = np.sqrt(np.square(x).sum(0))
    x = x[:, size > 0] / size[size > 0]
    if not x.shape[1]:
        return constant
    left, values, _ = np.linalg.svd(x, full_matrices=False)
    return np.column_stack([constant, left[:, values > 1e-6 * values[0]]])


def projector(
    whiten: Whitener, nuisance: np.ndarray, missing: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Rows that are there (n - p,), and the whitened nuisance on them as Q R: (m, r) and (r, M).

    On fewer rows columns may depend on each other that did not before, as what is there at the
    first sample alone. Their directions are rounding, and are left out.
    """
    there = np.isfinite(whiten(np.where(missing, np.nan, 0.0)))
    if there.sum() < 30:
        got = f"{int(there.sum())}"
        raise invalid("residual", expected="at least 30 samples beside gaps", got=got)
    Q, values, V = np.linalg.svd(whiten(nuisance)[there], full_matrices=False)
    kept = values > 1e-6 * values[0]
    return there, Q[:, kept], values[kept, None] * V[kept]


def log_ratio(explained: np.ndarray, total: float) -> np.ndarray:
    """Twice the log likelihood ratio of normal noise, -m log(1 - explained / total), over m."""
    return -np.log1p(-np.clip(explained / max(total, 1e-300), -1e6, 1.0 - 1e-9))


def columns_score(
    columns: np.ndarray, variants: Sequence[np.ndarray], nuisance: np.ndarray, missing: np.ndarray
) -> Prepare:
    """Score of effects that are columns with free weights.

    Args:
        columns: (n, M), finite. variants: indices of columns of each variant.
        nuisance: (n, M0) from `spanning`. missing: (n,) where the residual is.
    """
    size = np.sqrt(np.square(columns).sum(0))
    scaled = columns / np.where(size > 0, size, 1.0)

    def prepare(whiten: Whitener) -> Score:
        there, Q, R = projector(whiten, nuisance, missing)
        w = whiten(scaled)
        w = w if there.all() else w[there]
        own = np.maximum(np.sqrt(np.einsum("ij,ij->j", w, w)), 1e-12)
        P = (Q.T @ w) / own
        inverses = []
        for v in variants:  # each by itself: variants are many, and share few columns
            G = (w[:, v].T @ w[:, v]) / (own[v][:, None] * own[v]) - P[:, v].T @ P[:, v]
            # The ridge makes columns that the nuisance spans explain nothing.
            inverses.append(np.linalg.inv(G + 1e-8 * np.eye(len(v))))

        def score(x: np.ndarray) -> Scored:
            e0 = whiten(x)[there]
            q = Q.T @ e0
            e = e0 - Q @ q
            b = (w.T @ e) / own
            found = np.array([b[v] @ S @ b[v] for v, S in zip(variants, inverses, strict=True)])
            gains = len(e) * log_ratio(found, float(e @ e))

            def fit(j: int) -> tuple[np.ndarray, np.ndarray]:
                v = variants[j]
                weights = inverses[j] @ b[v]
                effect = scaled[:, v] @ (weights / own[v])
                beside = nuisance @ solved(R, q - P[:, v] @ weights)
                return effect - effect.mean(), effect + beside

            return gains, fit

        return score

    return prepare


def solved(R: np.ndarray, q: np.ndarray) -> np.ndarray:
    """R^-1 q by least squares: whitening may have made the nuisance dependent."""
    return np.linalg.lstsq(R, q, rcond=1e-10)[0]


def explained_by(
    whiten: Whitener, there: np.ndarray, columns: np.ndarray, nuisance: np.ndarray, x: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """What columns explain of a series, and what they and the nuisance explain, both (n,)."""
    joined = np.column_stack([columns, nuisance])
    weights = np.linalg.lstsq(whiten(joined)[there], whiten(x)[there], rcond=1e-9)[0]
    effect = columns @ weights[: columns.shape[1]]
    return effect - effect.mean(), joined @ weights
