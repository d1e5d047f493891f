"""What detectors of effects share: the test of lasting effects, and a finer look at a parameter."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from functools import partial

import numpy as np

from pyro_dynogp.statistics.bootstrap import Scan
from pyro_dynogp.statistics.evidence import Residuals
from pyro_dynogp.statistics.regression import basis, noise_filter, regress, solve, with_past
from pyro_dynogp.statistics.settings import LoopSettings


def looked(residuals: Residuals) -> np.ndarray:
    """Residual (n,) where neither fit nor scaling has seen the output, NaN elsewhere."""
    return np.where(residuals.held_out, residuals.residual, np.nan)


def lasting(
    residuals: Residuals,
    variants: Sequence[np.ndarray],
    nuisance: np.ndarray | None,
    settings: LoopSettings,
    seed: int = 0,
) -> Scan:
    """Test of an effect that lasts: where neither fit nor scaling has seen the output.

    Args:
        residuals: of one output (n,).
        variants: each (n, K); what is not a bank of responses has its past joined by `with_past`.
        nuisance: (n, M) what no variant may claim. settings: thresholds. seed: of the replicates.
    """
    deviations = residuals.deviations
    return regress(looked(residuals), variants, nuisance, deviations, settings, seed)


def one_sided(scan: Scan, variants: Sequence[np.ndarray]) -> Scan:
    """For one column (and its past) each, of an effect that cannot act backwards: one side.

    Under the null either sign is as probable, whatever the size.
    """
    column = variants[scan.best] - variants[scan.best].mean(0)
    positive = float(solve(column, scan.fitted - scan.fitted.mean()).sum()) > 0
    half = 0.5 * scan.p_value
    return dataclasses.replace(scan, p_value=half if positive else 1.0 - half)


def regained(residuals: Residuals, settings: LoopSettings) -> Residuals:
    """With the mean times the gain that suits the output best where it is tested.

    A wrong gain is a parameter's affair. Beside the residual's own past a column for the mean does
    not take it out: the noise's filter would need the past of the mean too, and that has the input
    in it, of which dead time and dynamics are made.
    """
    m = residuals.mean - residuals.mean.mean()
    e = looked(residuals)
    whiten = noise_filter(e, with_past(m), settings)
    columns, rest = whiten(np.column_stack([np.ones(len(m)), m])), whiten(e)
    rows = np.isfinite(rest)
    gain = np.linalg.lstsq(columns[rows], rest[rows], rcond=None)[0][1]
    return dataclasses.replace(residuals, mean=residuals.mean + gain * m)


@dataclasses.dataclass(frozen=True, eq=False)
class Search:
    """Finer looks at the parameters of columns, under the noise's filter beside some of them.

    Attributes:
        residuals: of one output (n,). nuisance: (n, M). settings: thresholds.
        weight: of the columns; by default the best.
    """

    residuals: Residuals
    nuisance: np.ndarray
    settings: LoopSettings
    weight: float | None = None

    def gains(self, variants: Sequence[np.ndarray], beside: np.ndarray) -> np.ndarray:
        """Of variants (n,) or (n, K) [nats], (J,), under the filter as estimated beside one.

        With a filter for each, as in `regress`, the residual's own past would do much of what the
        variant should: it makes any resonance.
        """
        x = looked(self.residuals)
        whiten = noise_filter(x, np.column_stack([self.nuisance, with_past(beside)]), self.settings)
        rest = whiten(x)
        rows = np.isfinite(rest)
        Q = basis(whiten(np.column_stack([np.ones(len(x)), self.nuisance]))[rows])

        def free(w: np.ndarray) -> np.ndarray:
            return w[rows] - Q @ (Q.T @ w[rows])

        e, gains = free(rest), []
        for v in variants:
            w = free(whiten(v[:, None] if v.ndim == 1 else v))
            weights = solve(w, e) if self.weight is None else np.full(w.shape[1], self.weight)
            gains.append(0.5 * len(e) * np.log((e @ e) / np.square(e - w @ weights).sum()))
        return np.array(gains)

    def located(
        self, columns: Callable[[float], np.ndarray], start: float, grid: np.ndarray
    ) -> float:
        """Parameter of an effect's columns at which they gain most.

        Twice: under the noise's filter as estimated beside the columns at the start, then at the
        first result.
        """
        for _ in range(2):
            beside = columns(start)

            def gain(at: np.ndarray, beside: np.ndarray = beside) -> np.ndarray:
                return self.gains([columns(float(x)) for x in at], beside)

            start = finest(gain, grid)
        return start

    def located_limits(
        self,
        column: Callable[[float, float], np.ndarray],
        limits: tuple[float, float],
        grid: np.ndarray,
    ) -> tuple[float, float]:
        """Limits (low, high) of the largest gain, one after the other; infinite ones stay."""
        low, high = limits
        for _ in range(2):
            if np.isfinite(low):
                of_low = partial(lambda high, low: column(low, high), high)
                low = self.located(of_low, low, grid[grid < high])
            if np.isfinite(high):
                high = self.located(partial(column, low), high, grid[grid > low])
        return low, high


def finest(gain: Callable[[np.ndarray], np.ndarray], grid: np.ndarray, times: int = 2) -> float:
    """Argument of the largest gain: the best of a grid, then of finer ones around it."""
    grid = np.unique(grid)
    for _ in range(times):
        best = int(np.argmax(gain(grid)))
        grid = np.linspace(grid[max(best - 1, 0)], grid[min(best + 1, len(grid) - 1)], 9)
    return float(grid[np.argmax(gain(grid))])
