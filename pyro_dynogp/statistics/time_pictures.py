"""Pictures and words for effects of time."""

from __future__ import annotations

import numpy as np
import pandas as pd

from pyro_dynogp.statistics.evidence import Curve, Residuals


def over_time(r: Residuals, fitted: np.ndarray, blocks: int = 80) -> Curve:
    """Residual, less its average, and an effect over time, averaged in blocks."""
    x = r.residual - np.nanmean(r.residual)
    block = np.minimum(np.arange(len(r)) * blocks // len(r), blocks - 1)
    block = np.where(np.isfinite(x) & np.isfinite(fitted), block, blocks)
    count = np.bincount(block, minlength=blocks + 1)[:blocks]

    def averaged(values: np.ndarray) -> np.ndarray:
        values = np.bincount(block, np.nan_to_num(values), minlength=blocks + 1)[:blocks]
        return (values / np.maximum(count, 1))[count > 0]

    return Curve(
        x=averaged(r.time),
        y=averaged(x),
        fitted=averaged(fitted),
        x_label=f"time [{r.time_unit}]",
        y_label=f"residual of {r.output_name} [{r.output_unit}]",
    )


def size_in_words(r: Residuals, size: float) -> str:
    """An effect's root mean square."""
    return f"about {size:.2g} {r.output_unit} (rms)".replace("  ", " ")


def in_words(stamp: pd.Timestamp) -> str:
    """A time stamp to the second, with its zone."""
    return f"{stamp:%Y-%m-%d %H:%M:%S %Z}"


def instant(r: Residuals, at: int) -> str:
    """When a sample was taken, in words."""
    if r.stamps is not None:
        return in_words(r.stamps[at])
    return f"time {r.time[at]:.5g} {r.time_unit}"
