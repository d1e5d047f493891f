"""Excitations of the machines, and channels that have nothing to do with them."""

from __future__ import annotations

import functools
from collections.abc import Mapping
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from scipy.signal import lfilter

import pyro_dynogp as dgp

Array = NDArray[np.float64]
Generator = np.random.Generator
EXCITATIONS = ("measured", "steps", "multisine", "filtered noise", "binary")
MEASURED: tuple[tuple[str, Mapping[str, Any]], ...] = (
    ("coupled_drives", {"record": 1}),
    ("coupled_drives", {"record": 2}),
    ("coupled_drives_prbs", {"record": 2}),
    ("gas_furnace", {}),
    ("heat_exchanger", {}),
    ("robot_arm", {}),
    ("actuator", {}),
    ("wh_process_noise", {}),
)
# Which half of each measured record a split may use.
HALVES = {"development": 0, "final": 1}


def excitation(rng: Generator, n: int, memory: float, split: str, kind: str | None = None) -> Array:
    """An input (n,) within [-1, 1] whose mean is about zero.

    Args:
        rng: source of what is random. n: samples.
        memory: slowest time constant of the machine [samples], which the signal suits.
        split: "development" or "final": which half of the measured records is used.
        kind: one of EXCITATIONS, by default drawn.
    """
    kind = kind or str(rng.choice(EXCITATIONS))
    if kind == "measured":
        x = _measured(rng, n, memory, split)
    elif kind == "steps":
        held = 1 + rng.geometric(1 / (memory * rng.uniform(0.3, 2.0) + 1), n)
        x = np.repeat(rng.uniform(-1, 1, n), held)[:n]
    elif kind == "binary":
        held = 1 + rng.geometric(1 / (memory * rng.uniform(0.3, 1.5) + 1), n)
        x = np.repeat(np.where(np.arange(n) % 2, 1.0, -1.0), held)[:n]
    elif kind == "multisine":
        highest = rng.uniform(0.5, 2.0) / memory / 2
        frequencies = rng.uniform(1 / n, max(highest, 4 / n), int(rng.integers(15, 40)))
        phases = rng.uniform(0, 2 * np.pi, len(frequencies))
        angle = 2 * np.pi * frequencies * np.arange(n)[:, None]
        x = np.cos(angle + phases).sum(axis=1)
    else:
        pole = np.exp(-1 / (memory * rng.uniform(0.2, 1.0)))
        x = lfilter([1 - pole], [1, -pole], rng.standard_normal(n + 500))[500:]
    return scaled(x)


def scaled(x: Array) -> Array:
    """Mean zero, largest absolute value one."""
    centred = x - x.mean()
    return np.asarray(centred / np.abs(centred).max())


@functools.cache
def _loaded(place: int) -> Array:
    name, options = MEASURED[place]
    data = dgp.datasets.load(name, **options)
    record = data.full if data.full is not None else data.train
    assert isinstance(record, dgp.Record)
    return np.array(record.inputs[:, 0])


def _measured(rng: Generator, n: int, memory: float, split: str) -> Array:
    """A piece of a measured input, stretched to the machine; there and back where it is short."""
    whole = _loaded(int(rng.integers(len(MEASURED))))
    middle = len(whole) // 2
    half = whole[:middle] if HALVES[split] == 0 else whole[middle:]
    stretch = float(np.clip(memory * rng.uniform(0.3, 1.2) / correlation_length(half), 0.25, 8.0))
    there_and_back = np.concatenate([half, half[::-1]])
    at = rng.uniform(0, len(there_and_back)) + np.arange(n) / stretch
    return np.asarray(
        np.interp(at % len(there_and_back), np.arange(len(there_and_back)), there_and_back)
    )


def correlation_length(x: Array) -> float:
    """Lag at which the autocorrelation falls below 1 / e [samples], one at least."""
    e = x - x.mean()
    r = np.correlate(e, e, mode="full")[len(e) - 1 :]
    below = np.flatnonzero(r < r[0] / np.e)
    return float(max(below[0], 1)) if len(below) else float(len(x))


def without_slow_part(x: Array, width: int, kept: float) -> Array:
    """The signal less a share 1 - kept of its moving average, three times.

    The average is over 2 width + 1 samples; three times, so that little of the slow part is left.
    """
    span = 2 * width + 1
    for _ in range(3):
        sums = np.cumsum(np.concatenate([[0.0], np.pad(x, width, mode="reflect")]))
        x = x - (1 - kept) * (sums[span:] - sums[:-span]) / span
    return x


@functools.cache
def _temperatures() -> tuple[Array, pd.DatetimeIndex]:
    """Hourly temperature of Melbourne [degC] with its stamps."""
    full = dgp.datasets.load("vic_elec").full
    assert full is not None
    assert full.timestamps is not None
    return np.array(full.inputs[::2, 0]), full.timestamps[::2]


def temperature(rng: Generator, n: int, split: str) -> tuple[Array, pd.DatetimeIndex]:
    """A piece of the hourly temperature of Melbourne, (n,) [degC], and its stamps."""
    values, stamps = _temperatures()
    middle = len(values) // 2
    if n > middle:
        raise ValueError(f"samples: expected at most {middle} hours with lead, got {n}.")
    first = HALVES[split] * middle + int(rng.integers(middle - n + 1))
    return values[first : first + n], stamps[first : first + n]


def decoy(rng: Generator, like: Array, memory: float, split: str) -> Array:
    """A channel (n,) that does not act: a slow walk, something periodic, or another excitation."""
    n, kind = len(like), str(rng.choice(["walk", "periodic", "elsewhere"]))
    if kind == "walk":
        x = np.cumsum(rng.standard_normal(n))
    elif kind == "periodic":
        period = float(np.exp(rng.uniform(np.log(10.0), np.log(n / 5))))
        x = np.sin(2 * np.pi * (np.arange(n) / period + rng.uniform()))
        x += 0.1 * rng.standard_normal(n)
    else:
        x = excitation(rng, n, memory, split)
    return np.asarray(like.mean() + like.std() * (scaled(x) * rng.uniform(1.0, 3.0)))
