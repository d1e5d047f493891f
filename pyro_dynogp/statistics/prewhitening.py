r"""Tests of slow and narrow effects, whose own trace in the residual would spoil its filter.

A drift, a step or a line in the spectrum looks to an autoregressive filter like colour, and is then
filtered away; without it the filter of a short residual is too flat at low frequencies, and noise
looks like drift. Hence in two steps, for the residual and for every replicate alike:

1. under a first filter, the same for all, the best variant of the effect is found and taken out;
2. a second filter is fitted to the rest; under it the residual's gains are looked at.

Where the colour can be estimated beside the effect at little cost (`joint`) that takes the place of
the filters, of which only the second one's order is used. The null is the second filter's, fitted
anew in every replicate (`bootstrap`).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from pyro_dynogp.statistics.autoregression import Whitener, check_samples, fitted_filter
from pyro_dynogp.statistics.bootstrap import Scan, noise_of, scanned, standardised_gains
from pyro_dynogp.statistics.settings import LoopSettings

# Numbers of filtered columns that are multiplied at once.
AT_ONCE = 1_000_000
# Share of a column's size that may be rounding of its mean.
ROUNDING = 1e-12


class Projection:
    """Series under a filter of the noise, less what a nuisance explains of them there.

    On fewer rows columns may depend on each other that did not before, as what is there at the
    first sample alone. Their directions are rounding, and are left out.

    Args:
        whiten: the filter. nuisance: (n, M). missing: (n,). settings: thresholds.

    Raises:
        ValueError: where there are too few rows.
    """

    def __init__(
        self, whiten: Whitener, nuisance: np.ndarray, missing: np.ndarray, settings: LoopSettings
    ) -> None:
        self.whiten, self.nuisance, self.missing = whiten, nuisance, missing
        #: (n - p,) where a sample and all of its past are there.
        self.rows = np.isfinite(whiten(np.where(missing, np.nan, 0.0)))
        check_samples(int(self.rows.sum()), settings, "samples beside gaps")

    @property
    def samples(self) -> np.ndarray:
        """(m,) places of these rows among all samples."""
        return np.flatnonzero(self.rows) + self.whiten.order

    @cached_property
    def _decomposed(self) -> tuple[np.ndarray, np.ndarray]:
        """What the filter makes of the nuisance, as Q R."""
        Q, values, V = np.linalg.svd(self.filtered(self.nuisance), full_matrices=False)
        kept = values > 1e-6 * values[0]
        return Q[:, kept], values[kept, None] * V[kept]

    @property
    def Q(self) -> np.ndarray:
        """(m, r) orthonormal: what the filter makes of the nuisance."""
        return self._decomposed[0]

    def filtered(self, x: np.ndarray) -> np.ndarray:
        """Series (n,) or (n, K) under the filter, (m,) or (m, K)."""
        w = self.whiten(x)
        return w if self.rows.all() else w[self.rows]

    def __call__(self, x: np.ndarray) -> np.ndarray:
        """The same less what the nuisance explains."""
        w = self.filtered(x)
        return w - self.Q @ (self.Q.T @ w)

    def explained(self, x: np.ndarray) -> np.ndarray:
        """What the nuisance explains of a series (n,), before whitening."""
        Q, R = self._decomposed
        # Least squares: whitening may have made the nuisance dependent.
        return self.nuisance @ np.linalg.lstsq(R, Q.T @ self.filtered(x), rcond=1e-10)[0]

    def with_nuisance(self, effect: np.ndarray, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """An effect (n,), centred, and what it and the nuisance explain of a series (n,)."""
        return effect - effect.mean(), effect + self.explained(x - effect)

    def fit(self, columns: np.ndarray, x: np.ndarray) -> np.ndarray:
        """What columns (n, K) explain of a series beside the nuisance, (n,)."""
        return columns @ np.linalg.lstsq(self(columns), self(x), rcond=1e-9)[0]


# Of a series (n,) how much each variant explains, 2 x nats (J,); and variant -> what it explains
# (n,), and what it and the nuisance explain (n,).
Scored = tuple[np.ndarray, Callable[[int], tuple[np.ndarray, np.ndarray]]]
Score = Callable[[np.ndarray], Scored]


@dataclass(frozen=True, eq=False)
class Variants:
    """All variants of an effect.

    Attributes:
        prepare: filter and nuisance -> score of a series that is missing where the residual is.
        degrees: (J,) degrees of freedom of each. width: columns that a score handles, for the time
            that it takes.
        joint: whether the score estimates the colour beside the effect and takes of a filter no
            more than its order. What a strong effect leaves of the order is seen once it is taken
            out, so that the first filter is none.
    """

    prepare: Callable[[Projection], Score]
    degrees: np.ndarray
    width: int = 0
    joint: bool = False


def prewhitened(
    residual: np.ndarray,
    variants: Variants,
    nuisance: np.ndarray,
    deviations: np.ndarray,
    settings: LoopSettings,
    *,
    first: np.ndarray | None = None,
    seed: int = 0,
) -> Scan:
    """Test whether any variant of an effect explains a residual.

    Args:
        residual: (n,), NaN where missing or not looked at. variants: of the effect.
        nuisance: (n, M) from `spanning`, what no variant may claim.
        deviations: (S, n) what the uncertainty of the parameters may leave in the residual.
        settings: thresholds.
        first: (n, M) columns that are taken out, by least squares, before the first filter is
            fitted, so that the effect does not hide itself there.
        seed: of the replicates.

    Raises:
        ValueError: where there are too few samples.
    """
    K, missing = np.asarray(variants.degrees, dtype=float), ~np.isfinite(residual)
    check_samples(int((~missing).sum()), settings, "samples to look at")
    x = residual - float(residual[~missing].mean())
    around = x if first is None else _without(x, first)
    start = Whitener(np.zeros(0)) if variants.joint else fitted_filter(around, settings)

    def score_under(whiten: Whitener) -> Score:
        return variants.prepare(Projection(whiten, nuisance, missing, settings))

    coarse = score_under(start)

    def rest(series: np.ndarray) -> np.ndarray:
        gains, fit = coarse(series)
        return series - fit(int(np.argmax(standardised_gains(gains, K))))[1]

    def filter_of(series: np.ndarray) -> Whitener:
        return fitted_filter(rest(series), settings)

    def gains_of(batch: np.ndarray) -> np.ndarray:
        return np.array([score_under(filter_of(series))(series)[0] for series in batch])

    left = rest(x)
    whiten = fitted_filter(left, settings)
    gains, fit = score_under(whiten)(x)
    # As many replicates as some seconds allow.
    most = int(2.5e7 / (len(x) * (variants.width + 2 * nuisance.shape[1])))
    count = min(max(most, settings.fewest_replicates), settings.replicates)
    noise = noise_of(whiten.coefficients, whiten(left), whiten.order + 1, missing, deviations)
    noise = noise.unbiased(lambda b: [filter_of(s).coefficients for s in b], count, seed)
    null = map(gains_of, noise.replicates(count, seed))
    return scanned(gains, K, null, lambda best: (fit(best)[0], whiten), ~missing, settings)


def _without(x: np.ndarray, columns: np.ndarray) -> np.ndarray:
    """What least squares leave of a series (n,) beside columns and a constant."""
    measured = np.isfinite(x)
    Q = spanning(columns)
    return x - Q @ np.linalg.lstsq(Q[measured], x[measured], rcond=1e-9)[0]


def spanning(columns: np.ndarray) -> np.ndarray:
    """A constant and an orthonormal basis (n, M) of what the columns add to it; NaN counts as 0."""
    n = len(columns)
    constant = np.full((n, 1), 1.0 / np.sqrt(n))
    x = np.nan_to_num(columns - np.nanmean(columns, axis=0)) if columns.size else np.zeros((n, 0))
    size = np.sqrt(np.square(x).sum(0))
    # A constant column less its mean is zero, or rounding: a constant once more.
    varies = size > ROUNDING * np.sqrt(np.nansum(np.square(columns), axis=0))
    x = x[:, varies] / size[varies]
    if not x.shape[1]:
        return constant
    left, values, _ = np.linalg.svd(x, full_matrices=False)
    return np.column_stack([constant, left[:, values > 1e-6 * values[0]]])


def log_ratio(explained: np.ndarray, total: float) -> np.ndarray:
    """Twice the log likelihood ratio of normal noise, -m log(1 - explained / total), over m."""
    return -np.log1p(-np.clip(explained / max(total, 1e-300), -1e6, 1.0 - 1e-9))


def free_columns(
    columns: np.ndarray, variants: Sequence[np.ndarray], degrees: Sequence[int] | None = None
) -> Variants:
    """Variants that are columns with free weights.

    Args:
        columns: (n, M), finite. variants: indices of columns of each variant.
        degrees: of freedom of each variant, by default its columns.
    """
    size = np.sqrt(np.square(columns).sum(0))
    scaled = columns / np.where(size > 0, size, 1.0)
    # Variants of one size together, as many as fit into so many numbers.
    parts: list[tuple[list[int], np.ndarray]] = []
    for k in sorted({len(v) for v in variants}):
        alike = [j for j, v in enumerate(variants) if len(v) == k]
        step = max(1, AT_ONCE // (max(k, 1) * len(columns)))
        for some in (alike[i : i + step] for i in range(0, len(alike), step)):
            parts.append((some, np.array([variants[j] for j in some]).reshape(len(some), k)))

    def prepare(under: Projection) -> Score:
        w = np.ascontiguousarray(under.filtered(scaled).T)  # (K, m)
        norm = np.maximum(np.sqrt(np.einsum("ij,ij->i", w, w)), 1e-12)
        P = (w @ under.Q) / norm[:, None]
        inverses: dict[int, np.ndarray] = {}
        stacked = []
        for some, V in parts:  # not of all columns: variants are many, and share few
            X, p, scale = w[V], P[V], norm[V]
            G = (X @ X.swapaxes(1, 2)) / (scale[:, :, None] * scale[:, None])
            # The ridge makes columns that the nuisance spans explain nothing.
            S = np.linalg.inv(G - p @ p.swapaxes(1, 2) + 1e-8 * np.eye(V.shape[1]))
            stacked.append(S)
            inverses.update(zip(some, S, strict=True))

        def score(x: np.ndarray) -> Scored:
            e = under(x)
            b = (w @ e) / norm
            explained = np.empty(len(variants))
            for (some, V), S in zip(parts, stacked, strict=True):
                explained[some] = np.einsum("ji,jik,jk->j", b[V], S, b[V])
            gains = len(e) * log_ratio(explained, float(e @ e))

            def fit(j: int) -> tuple[np.ndarray, np.ndarray]:
                v = variants[j]
                return under.with_nuisance(scaled[:, v] @ (inverses[j] @ b[v] / norm[v]), x)

            return gains, fit

        return score

    K = [len(v) for v in variants] if degrees is None else degrees
    return Variants(prepare, np.array(K), columns.shape[1])
