r"""One bootstrap for all tests: a residual as it would be if an effect were absent, many times.

A test has a statistic, and a null that is data: the filter of the noise, the errors that drive it
in random order with replacement (the sieve bootstrap: Bühlmann, Bernoulli 3(2):123-148, 1997), what
is re-estimated in every replicate, and what the parameters' uncertainty may leave beside the noise.
Estimated filters are too short-lived, the more so beside many columns; how much so the replicates
themselves show, and are made again without it (Kilian, Review of Economics and Statistics 80:218,
1998). What is white under the null is drawn by `batches` in another way: in another order, with
other signs, normal.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy import stats
from scipy.signal import lfilter

from pyro_dynogp.statistics.autoregression import Whitener
from pyro_dynogp.statistics.settings import LoopSettings

# Replicates that are made at once: as many as there are, no fewer and no more than so many. Most
# residuals show within two dozen that an effect is absent; memory grows with the record.
FEWEST, MOST = 10, 50
# Samples before a replicate begins, so that it forgets its start, and largest pole that does.
BURN_IN, SLOWEST = 300, 0.99


@dataclass(frozen=True, eq=False)
class Scan:
    """The best of all variants of an effect.

    Attributes:
        statistic: largest standardised gain. p_value: of it.
        best: which variant. gains: (J,) of all [nats].
        size: standard deviation of what the best explains, before whitening, where the residual is
            looked at [its unit]. fitted: (n,) what it explains.
        whitener: the filter of the noise beside it.
    """

    statistic: float
    p_value: float
    best: int
    gains: np.ndarray
    size: float
    fitted: np.ndarray
    whitener: Whitener

    @property
    def gain(self) -> float:
        """Of the best variant [nats]."""
        return float(self.gains[self.best])


@dataclass(frozen=True, eq=False)
class Noise:
    """The null of a residual: an autoregression that its own errors drive in random order.

    Attributes:
        coefficients: (p,) of the filter. errors: (m,) that drive it.
        missing: (n,) where replicates are NaN.
        deviations: (S, n) of which one is added to each, (0, n) for none.
    """

    coefficients: np.ndarray
    errors: np.ndarray
    missing: np.ndarray
    deviations: np.ndarray

    def replicates(self, count: int, seed: int) -> Iterator[np.ndarray]:
        """Series (R, n) under the null by the batch, `count` in all."""
        a, n = np.concatenate([[1.0], -self.coefficients]), len(self.missing)
        added = np.random.default_rng([seed, 1])

        def drawn(order: np.random.Generator, size: int) -> np.ndarray:
            driving = self.errors[order.integers(len(self.errors), size=(size, n + BURN_IN))]
            series = lfilter([1.0], a, driving)[:, BURN_IN:]
            if len(self.deviations):
                series = series + self.deviations[added.integers(len(self.deviations), size=size)]
            return np.where(self.missing, np.nan, series)

        return batches(drawn, count, seed)

    def unbiased(
        self, estimated: Callable[[np.ndarray], Iterable[np.ndarray]], count: int, seed: int
    ) -> Noise:
        """Less the bias that replicates show, as much of it as leaves the filter stable.

        Args:
            estimated: series (R, n) -> what the coefficients are estimated as, in each.
            count: of replicates, of which a quarter are enough: of 50 the mean is known to a
                seventh of what estimates scatter by. seed: of them.
        """
        plain = replace(self, deviations=self.deviations[:0])
        again = [a for batch in plain.replicates((count + 3) // 4, seed) for a in estimated(batch)]
        p = max(len(self.coefficients), *map(len, again))
        a = _padded(self.coefficients, p)
        bias = np.mean([_padded(other, p) for other in again], axis=0) - a
        for share in np.linspace(1.0, 0.0, 21):
            if radius(a - share * bias) <= SLOWEST:
                return replace(self, coefficients=a - share * bias)
        return self


def noise_of(
    coefficients: np.ndarray,
    errors: np.ndarray,
    parameters: int,
    missing: np.ndarray,
    deviations: np.ndarray,
) -> Noise:
    """The null with what a filter leaves, centred, and scaled by its degrees of freedom.

    Args:
        coefficients: (p,). errors: (m,), NaN where missing. parameters: estimated in all.
        missing: (n,). deviations: (S, n).
    """
    e = errors[np.isfinite(errors)]
    e = (e - e.mean()) * np.sqrt(len(e) / max(len(e) - parameters, 1))
    return Noise(coefficients, e, missing, deviations)


def _padded(a: np.ndarray, p: int) -> np.ndarray:
    return np.concatenate([a, np.zeros(p - len(a))])


def radius(coefficients: np.ndarray) -> float:
    """Largest absolute pole of an autoregression."""
    return float(np.abs(np.roots(np.concatenate([[1.0], -coefficients]))).max(initial=0.0))


def batches(
    drawn: Callable[[np.random.Generator, int], np.ndarray], count: int, seed: int | Sequence[int]
) -> Iterator[np.ndarray]:
    """Replicates by the batch: `drawn` makes as many as it is told, from a generator."""
    generator, made = np.random.default_rng(seed), 0
    while made < count:
        size = min(max(made, FEWEST), MOST, count - made)
        yield drawn(generator, size)
        made += size


def standardised_gains(gains: np.ndarray, degrees: np.ndarray) -> np.ndarray:
    """Twice the gains (..., J) [nats], less what chance makes of their degrees of freedom."""
    return (gains - degrees) / np.sqrt(2.0 * degrees)


def scanned(
    gains: np.ndarray,
    degrees: np.ndarray,
    null: Iterable[np.ndarray],
    fit: Callable[[int], tuple[np.ndarray, Whitener]],
    rows: np.ndarray,
    settings: LoopSettings,
) -> Scan:
    """The best variant, and the p-value of its standardised gain.

    No more replicates are made once as many as count are as large (Besag & Clifford, Biometrika
    78:301, 1991): where an effect is absent a tenth of them says so.

    Args:
        gains: (J,) twice the log likelihood ratios. degrees: (J,) of freedom.
        null: gains (R, J) of replicates. fit: of a variant: what it explains (n,), and the filter.
        rows: (n,) that are looked at. settings: thresholds.
    """
    z = standardised_gains(gains, degrees)
    best = int(np.argmax(z))
    largest = np.zeros(0)
    for made in null:
        largest = np.concatenate([largest, standardised_gains(made, degrees).max(1)])
        if (largest >= z[best]).sum() >= settings.exceedances:
            break
    p_value = tail_probability(largest, float(z[best]), settings)
    fitted, whiten = fit(best)
    size = float(fitted[rows].std())
    return Scan(float(z[best]), p_value, best, 0.5 * gains, size, fitted, whiten)


def tail_probability(null: np.ndarray, value: float, settings: LoopSettings) -> float:
    """Probability of a value as large, from draws (R,) under the null.

    Counted where enough draws are as large, (1 + count) / (1 + R); beyond them from a Gumbel
    distribution with the mean and standard deviation of the draws: what they are are maxima.
    """
    above = int((null >= value).sum())
    counted = (1 + above) / (1 + len(null))
    scale = float(null.std()) * np.sqrt(6.0) / np.pi
    if above >= settings.exceedances or scale <= 0:
        return counted
    location = float(null.mean()) - np.euler_gamma * scale
    fitted = float(stats.gumbel_r.sf(value, location, scale))
    return min(counted, max(fitted, 1e-300)) if above == 0 else min(counted, 2.0 * fitted + 1e-300)
