"""Shifts of an input's clock from any instant on: what each adds to the mean, and its gain."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pyro_dynogp.data.signals import shifted
from pyro_dynogp.statistics.autoregression import Whitener
from pyro_dynogp.statistics.evidence import Residuals
from pyro_dynogp.statistics.prewhitening import Projection, Score, Scored, Variants, log_ratio
from pyro_dynogp.statistics.settings import LoopSettings

# Shifts that are tried [steps], both ways; and one hour where there are stamps.
SHIFTS = (1, 2, 3, 4, 6, 8, 12, 16, 24, 32)
# Instants of change on the first pass.
INSTANTS = 60


@dataclass(frozen=True, eq=False)
class Shifts:
    """All shifts of all channels.

    Attributes:
        changes: (n, J) what each shift adds to the mean where it holds [output].
        shifts: (J,) [time unit]. channels: (J,) index of a share.
        edges: (I,) samples at which a shift may begin, to last to the end.
        parts: (P, n) where rules of daylight saving have their hour, or do not have it.
    """

    changes: np.ndarray
    shifts: np.ndarray
    channels: np.ndarray
    edges: np.ndarray
    parts: np.ndarray

    def effect(self, variant: int) -> np.ndarray:
        """What a variant adds to the mean (n,): first all parts, then all edges."""
        place, j = divmod(variant, self.changes.shape[1])
        if place < len(self.parts):
            return self.parts[place] * self.changes[:, j]
        at = self.edges[place - len(self.parts)]
        return np.where(np.arange(len(self.changes)) >= at, self.changes[:, j], 0.0)


def shifts_of(
    r: Residuals, shares: np.ndarray, parts: np.ndarray, settings: LoopSettings
) -> Shifts:
    """All shifts that are tried.

    Args:
        r: residuals (n,). shares: (n, c) of the mean by channel [output].
        parts: (P, n) where rules of daylight saving have their hour, or do not have it.
    """
    n = len(r)
    lengths = {float(k) * r.step for k in SHIFTS if k <= n // 10}
    if r.stamps is not None:
        seconds = (r.stamps[-1] - r.stamps[0]).total_seconds() / (r.time[-1] - r.time[0])
        hour = 3600.0 / seconds
        # A whole number of steps up to rounding is that number, and tried once.
        steps = round(hour / r.step, 6)
        if 0.25 <= steps <= n // 10:
            lengths.add(steps * r.step)
    shifts = np.array([sign * d for d in sorted(lengths) for sign in (1.0, -1.0)])
    changes = [shifted(s, r.time, -d) - s for s in shares.T for d in shifts]
    low, high = max(int(settings.clock_margin * n), 5), n - max(int(settings.clock_margin * n), 5)
    edges = np.unique(np.linspace(low, high, min(INSTANTS, high - low)).astype(int))
    return Shifts(
        changes=np.column_stack(changes),
        shifts=np.tile(shifts, shares.shape[1]),
        channels=np.repeat(np.arange(shares.shape[1]), len(shifts)),
        edges=edges,
        parts=parts,
    )


def score_of_shifts(tried: Shifts) -> Variants:
    """All shifts from all edges, by sums over what lies between two edges.

    At an edge the whitened effect differs from the part of the whitened change for as many samples
    as the filter has coefficients; that is left out.
    """

    def prepare(under: Projection) -> Score:
        rows = under.samples
        w = under.filtered(tried.changes)
        starts = np.searchsorted(rows, tried.edges)
        masks = tried.parts[:, rows]
        ends = [*starts[1:], len(rows)]
        blocks = [slice(a, b) for a, b in zip(starts, ends, strict=True)]

        def against(values: np.ndarray) -> np.ndarray:
            """Products of w with values (m, ...) over each place: rules, then edges to the end."""
            later = np.cumsum([w[b].T @ values[b] for b in blocks][::-1], axis=0)[::-1]
            ruled = [w.T @ (values.T * m).T for m in masks]
            return np.concatenate([np.array(ruled).reshape(-1, *later.shape[1:]), later])

        squares = np.square(w)
        later = np.concatenate([np.cumsum(squares[::-1], axis=0)[::-1], 0.0 * squares[:1]])[starts]
        norm = np.concatenate([masks @ squares, later]) - np.square(against(under.Q)).sum(2)

        def score(x: np.ndarray) -> Scored:
            e = under(x)
            explained = np.maximum(2.0 * against(e) - norm, 0.0).ravel()
            gains = len(e) * log_ratio(explained, float(e @ e))

            def fit(variant: int) -> tuple[np.ndarray, np.ndarray]:
                return under.with_nuisance(tried.effect(variant), x)

            return gains, fit

        return score

    J = tried.changes.shape[1]
    count = J * (len(tried.parts) + len(tried.edges))
    return Variants(prepare, np.ones(count), J)


def refined_shift(
    r: Residuals,
    whiten: Whitener,
    nuisance: np.ndarray,
    share: np.ndarray,
    at: int,
    shift: float,
    edges: np.ndarray,
    settings: LoopSettings,
) -> tuple[int, float, np.ndarray]:
    """Instant and shift near those on the grids, alternately, and their effect (n,)."""
    x = r.residual
    under = Projection(whiten, nuisance, ~np.isfinite(x), settings)
    e = under(x)

    def effect(at: int, shift: float) -> np.ndarray:
        change = shifted(share, r.time, -shift) - share
        return np.where(np.arange(len(x)) >= at, change, 0.0)

    def left(at: int, shift: float) -> float:
        return float(np.square(e - under(effect(at, shift))).sum())

    stride = int(np.diff(edges).max(initial=1))
    for _ in range(2):
        finer = np.linspace(shift / 1.5, shift * 1.5, 31)
        shift = float(min([shift, *finer], key=lambda s: left(at, float(s))))
        near = range(max(at - stride, 1), min(at + stride + 1, len(x) - 1))
        at = min([at, *near], key=lambda k: left(k, shift))
    return at, shift, effect(at, shift)
