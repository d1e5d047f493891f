"""What detectors share: the scan of lasting effects, a finer look at a parameter, binned means."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from functools import partial

import numpy as np

from pyro_dynogp.statistics.evidence import Curve, Evidence, Residuals
from pyro_dynogp.statistics.regression import gains_under, noise_filter, regress, with_past
from pyro_dynogp.statistics.scan import Scan
from pyro_dynogp.statistics.whitening import Whitener

# Finer looks cost time and are for what may be reported.
NOTICED = 0.1


def looked(residuals: Residuals) -> np.ndarray:
    """Residual (n,) where neither fit nor scaling has seen the output, NaN elsewhere."""
    return np.where(residuals.held_out, residuals.residual, np.nan)


def lasting(
    residuals: Residuals,
    variants: Sequence[np.ndarray],
    nuisance: np.ndarray | None = None,
    seed: int = 0,
) -> Scan:
    """Test of an effect that lasts: where neither fit nor scaling has seen the output.

    Variants are (n,) or (n, K); what is not a bank of responses has its past joined by `with_past`.
    """
    deviations = residuals.deviations
    return regress(looked(residuals), variants, nuisance=nuisance, deviations=deviations, seed=seed)


def regained(residuals: Residuals) -> Residuals:
    """With the mean times the gain that suits the output best where it is tested.

    A wrong gain is a parameter's affair. Beside the residual's own past a column for the mean does
    not take it out: the noise's filter would need the past of the mean too, and that has the input
    in it, of which dead time and dynamics are made.
    """
    m = residuals.mean - residuals.mean.mean()
    e = looked(residuals)
    whiten = noise_filter(e, with_past(m))
    columns, rest = whiten(np.column_stack([np.ones(len(m)), m])), whiten(e)
    there = np.isfinite(rest)
    gain = np.linalg.lstsq(columns[there], rest[there], rcond=None)[0][1]
    return dataclasses.replace(residuals, mean=residuals.mean + gain * m)


def profiled(
    residuals: Residuals,
    variants: Sequence[np.ndarray],
    nuisance: np.ndarray,
    beside: np.ndarray,
    weight: float | None = None,
) -> np.ndarray:
    """Gains of variants [nats], (J,), under the noise's filter beside nuisance and a variant."""
    e = looked(residuals)
    whiten = noise_filter(e, np.column_stack([nuisance, with_past(beside)]))
    return gains_under(whiten, e, variants, nuisance, weight)


def located(
    residuals: Residuals,
    columns: Callable[[float], np.ndarray],
    start: float,
    grid: np.ndarray,
    nuisance: np.ndarray,
    weight: float | None = None,
) -> float:
    """Parameter of an effect's columns at which they gain most.

    Twice: under the noise's filter as estimated beside the columns at the start, then at the
    first result. `weight`: of the columns, by default the best.
    """
    e = looked(residuals)
    for _ in range(2):
        whiten = noise_filter(e, np.column_stack([nuisance, with_past(columns(start))]))

        def gain(at: np.ndarray, whiten: Whitener = whiten) -> np.ndarray:
            return gains_under(whiten, e, [columns(float(x)) for x in at], nuisance, weight)

        start = finest(gain, grid)
    return start


def finest(gain: Callable[[np.ndarray], np.ndarray], grid: np.ndarray, times: int = 2) -> float:
    """Argument of the largest gain: the best of a grid, then of finer ones around it."""
    grid = np.unique(grid)
    for _ in range(times):
        best = int(np.argmax(gain(grid)))
        grid = np.linspace(grid[max(best - 1, 0)], grid[min(best + 1, len(grid) - 1)], 9)
    return float(grid[np.argmax(gain(grid))])


def located_limits(
    residuals: Residuals,
    column: Callable[[float, float], np.ndarray],
    limits: tuple[float, float],
    grid: np.ndarray,
    nuisance: np.ndarray,
) -> tuple[float, float]:
    """Limits (low, high) of the largest gain, one after the other; infinite ones stay."""
    low, high = limits
    for _ in range(2):
        if np.isfinite(low):
            of_low = partial(_swapped, column, high)
            low = located(residuals, of_low, low, grid[grid < high], nuisance)
        if np.isfinite(high):
            high = located(residuals, partial(column, low), high, grid[grid > low], nuisance)
    return low, high


def _swapped(column: Callable[[float, float], np.ndarray], high: float, low: float) -> np.ndarray:
    return column(low, high)


def binned(
    residuals: Residuals,
    x: np.ndarray,
    y: np.ndarray,
    fitted: np.ndarray,
    labels: tuple[str, str],
    bins: int = 25,
) -> Curve:
    """Means of y and of what was fitted to it in bins of x with equal counts, where tested."""
    there = residuals.held_out & np.isfinite(x) & np.isfinite(y)
    order = np.flatnonzero(there)[np.argsort(x[there], kind="stable")]
    parts = [p for p in np.array_split(order, bins) if len(p)]
    a, b, c = (np.array([v[p].mean() for p in parts]) for v in (x, y, fitted))
    return Curve(a, b, c, *labels)


def unexplained(residuals: Residuals, nuisance: np.ndarray, fitted: np.ndarray) -> np.ndarray:
    """Residual (n,) less what the nuisance explains of it beside the effect, for pictures."""
    e = residuals.residual
    there = residuals.held_out & np.isfinite(e)
    N = np.column_stack([np.ones(len(e)), nuisance, fitted])
    size = np.where((size := np.abs(N).max(0)) > 0, size, 1.0)
    weights = np.linalg.lstsq(N[there] / size, e[there], rcond=1e-8)[0] / size
    return e - N[:, :-1] @ weights[:-1]


def unit(text: str) -> str:
    """A unit after a number: a space before it, or nothing."""
    return f" {text}" if text else ""


def labelled(name: str, unit: str) -> str:
    """Name of an axis, its unit in brackets where there is one."""
    return f"{name} [{unit}]" if unit else name


def of_positive_weight(found: Scan) -> Scan:
    """For one column (and its past) each, of an effect that cannot act backwards: one side.

    Under the null either sign is as probable, whatever the size.
    """
    half = 0.5 * found.p_value
    positive = float(found.weights.sum()) > 0
    return dataclasses.replace(found, p_value=half if positive else 1.0 - half)


def about(residuals: Residuals, found: Scan) -> str:
    """Words for the size of an effect."""
    return f", about {found.size:.2g}{unit(residuals.output_unit)} (rms)"


def evidence(
    effect: str,
    found: Scan,
    where: dict[str, float | str],
    sentence: str,
    curve: Curve | None,
) -> Evidence:
    """Evidence with the numbers of a scan."""
    return Evidence(
        effect=effect,
        statistic=found.statistic,
        p_value=found.p_value,
        gain=found.gain,
        size=found.size,
        where=where,
        sentence=sentence,
        curve=curve,
    )
