"""Whether ranks of true values among posterior draws are uniform: tests, and what they show."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from pyro_dynogp.criticism.envelope import Envelope, envelope
from pyro_dynogp.support.shown import shown

# Null replicates of all ranks of one quantity; more where many quantities share the level.
REPLICATES = 1999
# Places at which the distribution of ranks is looked at, at most, and bins of the histogram.
PLACES, BINS = 19, 10
# Ranks expected in a bin.
PER_BIN = 5
# Standard errors from which on a shape has a name.
SURE = 2.0


def rank_of(draws: np.ndarray, true: float, generator: np.random.Generator) -> int:
    """Number of draws (L,) below the true value, 0 to L, ties broken at random.

    Draws of a posterior that keeps a site at a point are ties of each other, not of the truth.
    """
    close = np.isclose(draws, true, rtol=1e-9, atol=0.0)
    below = int((draws[~close] < true).sum())
    return below + int(generator.integers(int(close.sum()) + 1))


@shown
@dataclass(repr=False, frozen=True, eq=False)
class Uniformity:
    """What the ranks of one quantity say.

    Attributes:
        p_chi_square: Monte Carlo p-value of the chi-square statistic of the rank histogram.
        band: simultaneous band of the distribution of the ranks at `levels`, and its p-value.
        levels: (K,) probabilities. ecdf: (K,) share of the ranks at or below each.
        p_value: of both tests together, the smaller of their p-values doubled.
        shape: in words how the ranks depart, the surest first; empty where nothing has a name.
    """

    p_chi_square: float
    band: Envelope
    levels: np.ndarray
    ecdf: np.ndarray
    p_value: float
    shape: tuple[str, ...]

    @property
    def p_ecdf(self) -> float:
        """P-value of the largest departure of the ECDF."""
        return self.band.p_value


def uniformity(
    ranks: Mapping[str, np.ndarray], draws: int, *, level: float = 0.95, seed: int = 0
) -> dict[str, Uniformity]:
    """Test the ranks (N,) of each quantity, numbers 0 to `draws`, by simulated uniform ranks.

    Null distributions are simulated, so that p-values hold for few replicates and ties of ranks,
    too. The chi-square statistic sees a ragged histogram, the ECDF's band (Säilynoja, Bürkner &
    Vehtari 2022) smooth departures: bias and width.

    Args:
        ranks: by quantity. draws: L. level: of the bands. seed: of the null replicates.
    """
    count = len(next(iter(ranks.values())))
    bins = _bins(count, draws)
    places = np.unique(np.linspace(0, draws, min(PLACES, draws) + 2)[1:-1].astype(int))
    size = max(REPLICATES, 80 * len(ranks) - 1)
    null = np.random.default_rng(seed).integers(0, draws + 1, (size, count))
    null_curves = _ecdf(null, places)
    null_chi = _chi_square(null, bins, draws)
    found = {}
    for name, own in ranks.items():
        curve = _ecdf(own[None], places)[0]
        chi = _chi_square(own[None], bins, draws)[0]
        p_chi = float((1 + (null_chi >= chi - 1e-9).sum()) / (1 + size))
        band = envelope(curve, null_curves, level)
        both = min(1.0, 2.0 * min(p_chi, band.p_value))
        levels = (places + 1) / (draws + 1)
        found[name] = Uniformity(p_chi, band, levels, curve, both, _shape(own, draws))
    return found


def holm(p_values: np.ndarray) -> np.ndarray:
    """P-values (m,) adjusted for there being m of them (Holm 1979).

    The same as statsmodels' ``multipletests(method="holm")``, in four lines: users need no
    statsmodels, whose first import takes 1 s.
    """
    order = np.argsort(p_values)
    raised = p_values[order] * np.arange(len(p_values), 0, -1)
    out = np.empty_like(p_values)
    out[order] = np.minimum(1.0, np.maximum.accumulate(raised))
    return out


def _bins(count: int, draws: int) -> np.ndarray:
    """First rank of each bin, and one past the last: five ranks expected in each, if possible."""
    number = int(np.clip(count // PER_BIN, 2, min(BINS, draws + 1)))
    return np.linspace(0, draws + 1, number + 1).round().astype(int)


def _chi_square(ranks: np.ndarray, bins: np.ndarray, draws: int) -> np.ndarray:
    """Statistic (S,) of ranks (S, N); bins need not be of equal size."""
    which = np.searchsorted(bins, ranks, side="right") - 1
    counts = np.stack([(which == b).sum(1) for b in range(len(bins) - 1)], axis=1)
    expected = ranks.shape[1] * np.diff(bins) / (draws + 1)
    return ((counts - expected) ** 2 / expected).sum(1)


def _ecdf(ranks: np.ndarray, places: np.ndarray) -> np.ndarray:
    """Share (S, K) of ranks (S, N) at or below each place (K,)."""
    return np.stack([(ranks <= place).mean(1) for place in places], axis=1)


def _shape(ranks: np.ndarray, draws: int) -> tuple[str, ...]:
    """Bias and width by the first two moments of the ranks, scaled to (0, 1)."""
    u = (ranks + 0.5) / (draws + 1)
    root = np.sqrt(len(u))
    bias = (u.mean() - 0.5) * root / np.sqrt(1.0 / 12.0)
    # (u - 1/2)^2 has mean 1/12 and variance 1/180.
    width = (np.mean((u - 0.5) ** 2) - 1.0 / 12.0) * root / np.sqrt(1.0 / 180.0)
    words = [
        (abs(width), "posterior too narrow" if width > 0 else "posterior too wide"),
        (abs(bias), "posterior too low" if bias > 0 else "posterior too high"),
    ]
    return tuple(text for size, text in sorted(words, reverse=True) if size > SURE)
