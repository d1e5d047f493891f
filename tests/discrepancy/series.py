"""Residuals without a fitted model: a known filter's output, an effect, and coloured noise."""

from collections.abc import Callable

import numpy as np
import pandas as pd
from scipy.signal import lfilter
from scipy.stats import binom

from pyro_dynogp.statistics.evidence import Residuals

STEP = 0.5


def share(u: np.ndarray, gain: float = 1.0) -> np.ndarray:
    """What an input (n,) contributes to the mean."""
    return gain * lfilter([0.0, 0.3], [1.0, -0.7], u)


def residuals(
    seed: int,
    n: int = 300,
    *,
    pole: float = 0.8,
    inputs: int = 1,
    effect: Callable | None = None,
    draw: Callable | None = None,
    step: float = STEP,
    stamps: pd.DatetimeIndex | None = None,
    held_out: np.ndarray | None = None,
    deviation: float = 0.0,
) -> Residuals:
    """Noise of standard deviation one and pole `pole`; `effect`: (time, mean, inputs) -> (n,)."""
    generator = np.random.default_rng(seed)
    U = lfilter([1.0], [1.0, -0.9], generator.standard_normal((n + 200, inputs)), axis=0)[200:]
    mean = sum(share(U[:, j], j + 1.0) for j in range(inputs))
    e = (draw or (lambda g, m: g.standard_normal(m)))(generator, n + 200)
    noise = np.sqrt(1.0 - pole**2) * lfilter([1.0], [1.0, -pole], e)[200:]
    time = np.arange(n) * step
    added = np.zeros(n) if effect is None else effect(time, mean, U)
    wobble = deviation * generator.standard_normal((20, 2)) @ np.stack([mean, np.ones(n)])
    return Residuals(
        time=time,
        output=mean + added + noise,
        mean=mean,
        deviations=wobble,
        innovations=e[200:] / e[200:].std(),
        poles=np.array([-1.0 / j + 0.5j for j in range(1, inputs + 1)]),
        inputs=U,
        input_names=tuple(f"u{j + 1}" for j in range(inputs)),
        candidates={},
        held_out=np.ones(n, dtype=bool) if held_out is None else held_out,
        output_name="speed",
        output_unit="rpm",
        time_unit="s",
        step=step,
        stamps=stamps,
    )


def in_other_units(r: Residuals) -> Residuals:
    """Outputs a thousandth, times sixtyfold, inputs scaled, shifted and in another order."""
    return Residuals(
        time=60.0 * r.time,
        output=1e-3 * r.output,
        mean=1e-3 * r.mean,
        deviations=1e-3 * r.deviations,
        innovations=r.innovations,
        poles=r.poles / 60.0,
        inputs=1e4 * r.inputs[:, ::-1],
        input_names=r.input_names[::-1],
        candidates={},
        held_out=r.held_out,
        output_name=r.output_name,
        output_unit="krpm",
        time_unit="min",
        step=60.0 * r.step,
        stamps=r.stamps,
    )


def check_rate(p_values: list[float], level: float = 0.05) -> None:
    """As many rejections as chance makes at the level, but for one chance in a thousand."""
    count = int((np.array(p_values) <= level).sum())
    assert count <= binom.isf(1e-3, len(p_values), level), f"{count} of {len(p_values)}"
