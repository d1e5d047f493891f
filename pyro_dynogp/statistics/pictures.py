"""What tests say: evidence, its picture, and words for sizes and times."""

from __future__ import annotations

import numpy as np
import pandas as pd

from pyro_dynogp.statistics.bootstrap import Scan
from pyro_dynogp.statistics.evidence import Curve, Evidence, Residuals
from pyro_dynogp.statistics.regression import solve


def evidence(
    effect: str,
    scan: Scan,
    where: dict[str, float | str],
    sentence: str,
    curve: Curve | None,
    size: float | None = None,
) -> Evidence:
    """Evidence with the numbers of a scan; `size` [output] where it is not that of the scan."""
    return Evidence(
        effect=effect,
        statistic=scan.statistic,
        p_value=scan.p_value,
        gain=scan.gain,
        size=scan.size if size is None else size,
        where=where,
        sentence=sentence,
        curve=curve,
    )


def unit(text: str) -> str:
    """A unit after a number: a space before it, or nothing."""
    return f" {text}" if text else ""


def labelled(name: str, unit: str) -> str:
    """Name of an axis, its unit in brackets where there is one."""
    return f"{name} [{unit}]" if unit else name


def residual_axis(r: Residuals) -> str:
    """Name of the axis of a residual."""
    return labelled(f"residual of {r.output_name}", r.output_unit)


def about(r: Residuals, size: float) -> str:
    """Words for the root mean square of an effect."""
    return f"about {size:.2g}{unit(r.output_unit)} (rms)"


def in_words(stamp: pd.Timestamp) -> str:
    """A time stamp to the second, with its zone."""
    return f"{stamp:%Y-%m-%d %H:%M:%S %Z}"


def instant(r: Residuals, at: int) -> str:
    """When a sample was taken, in words."""
    return f"time {r.time[at]:.5g} {r.time_unit}" if r.stamps is None else in_words(r.stamps[at])


def binned(
    r: Residuals,
    x: np.ndarray,
    y: np.ndarray,
    fitted: np.ndarray,
    labels: tuple[str, str],
    bins: int = 25,
) -> Curve:
    """Means of y and of what was fitted to it in bins of x with equal counts, where tested."""
    rows = np.flatnonzero(r.held_out & np.isfinite(x) & np.isfinite(y))
    order = rows[np.argsort(x[rows], kind="stable")]
    parts = [p for p in np.array_split(order, bins) if len(p)]
    a, b, c = (np.array([v[p].mean() for p in parts]) for v in (x, y, fitted))
    return Curve(a, b, c, *labels)


def averages(groups: np.ndarray, count: int, *values: np.ndarray) -> list[np.ndarray]:
    """Means of values (n,) in groups 0, ..., count - 1 (n,), those of empty groups left out."""
    samples = np.bincount(groups, minlength=count)
    sums = [np.bincount(groups, v, minlength=count) for v in values]
    return [(s / np.maximum(samples, 1))[samples > 0] for s in sums]


def over_time(r: Residuals, fitted: np.ndarray, blocks: int = 80) -> Curve:
    """Residual, less its average, and an effect over time, averaged in blocks."""
    x = r.residual - np.nanmean(r.residual)
    rows = np.isfinite(x) & np.isfinite(fitted)
    block = (np.arange(len(r)) * blocks // len(r))[rows]
    time, left, effect = averages(block, blocks, r.time[rows], x[rows], fitted[rows])
    return Curve(time, left, effect, f"time [{r.time_unit}]", residual_axis(r))


def against(
    r: Residuals, x: np.ndarray, label: str, nuisance: np.ndarray, fitted: np.ndarray
) -> Curve:
    """Residual and effect over a signal x (n,): less what the nuisance explains beside the effect.

    Args:
        r: residuals. label: of x. nuisance: (n, M). fitted: (n,) the effect.
    """
    e = r.residual
    rows = r.held_out & np.isfinite(e)
    columns = np.column_stack([np.ones(len(e)), nuisance, fitted])
    rest = e - columns[:, :-1] @ solve(columns[rows], e[rows])[:-1]
    return binned(r, x, rest, fitted, (label, residual_axis(r)))
