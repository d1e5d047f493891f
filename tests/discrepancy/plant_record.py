"""The record of a synthetic plant: engineering units, decoy channels, a clock."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd

import pyro_dynogp as dgp
from tests.discrepancy.plant_dynamics import Array, System, response
from tests.discrepancy.plant_setting import (
    Generator,
    Setting,
    random_pole,
    random_signal,
    standard,
)


@dataclass(frozen=True, eq=False)
class Draft:
    """A plant whose signals have a standard deviation of one, and one sample as unit of time.

    Attributes:
        setting: what it is but for the effect.
        u: inputs as recorded, with lead and tail. y: output (n,). clean: its noise-free part.
        noise_sd, process_sd: of measurement noise, and of what process noise adds to the output.
        truth: true values of the effect. extra: a channel that belongs into the record, or None.
    """

    setting: Setting
    u: Array
    y: Array
    clean: Array
    noise_sd: float
    process_sd: float
    truth: dict[str, Any]
    extra: Array | None = None


@dataclass(frozen=True, eq=False)
class Scales:
    """Engineering units: offset and size of inputs (n_u,) and output."""

    input_offset: Array
    input_size: Array
    output_offset: float
    output_size: float
    units: tuple[str, str]


def random_scales(rng: Generator, n_u: int) -> Scales:
    """Sizes over three decades, offsets of a few sizes."""
    size = np.exp(rng.uniform(np.log(0.1), np.log(100.0), n_u + 1))
    offset = size * rng.uniform(-3.0, 3.0, n_u + 1)
    units = (str(rng.choice(["V", "kW", "N", "%"])), str(rng.choice(["m", "bar", "A", "rpm"])))
    return Scales(offset[:-1], size[:-1], float(offset[-1]), float(size[-1]), units)


def random_decoy(rng: Generator, n: int) -> Array:
    """A channel (n,) that has nothing to do with the plant.

    An autoregression, a random walk, a sinusoid, or what looks like a delayed and filtered input:
    such a copy of a signal that nobody has applied.
    """
    kind = rng.choice(["autoregressive", "random walk", "sinusoid", "copy"])
    if kind == "autoregressive":
        return random_signal(rng, n, "autoregressive")
    if kind == "random walk":
        return np.asarray(np.cumsum(rng.standard_normal(n)))
    if kind == "sinusoid":
        period, phase = rng.uniform(12.0, 150.0), rng.uniform(0, 2 * np.pi)
        wave = np.sin(2 * np.pi * np.arange(n) / period + phase)
        return np.asarray(wave + 0.05 * rng.standard_normal(n))
    delay = int(rng.integers(1, 20))
    source = random_signal(rng, n + delay + 100)
    one = System(np.array([random_pole(rng, (8.0, 40.0))]), np.array([[1.0 + 0.5j]]))
    return response(one, source[:, None])[100 : 100 + n]


def in_units(draft: Draft, rng: Generator) -> tuple[dgp.Record, dict[str, Any], Scales]:
    """Record, true values in its units, and what a unit is."""
    setting, window = draft.setting, draft.setting.window
    scales = random_scales(rng, setting.u.shape[1])
    channels = [random_decoy(rng, len(setting.u)) for _ in range(int(rng.integers(2, 5)))]
    if draft.extra is not None:
        channels.append(draft.extra)
    # Nothing but what they hold tells the true channel from the others.
    order = rng.permutation(len(channels))
    sizes = np.exp(rng.uniform(np.log(0.1), np.log(100.0), len(channels)))
    offsets = sizes * rng.uniform(-3.0, 3.0, len(channels))
    names = [f"w{i + 1}" for i in range(len(channels))]
    extra = {
        names[i]: offsets[i] + sizes[i] * standard(channels[j], window)[window]
        for i, j in enumerate(order)
    }
    clock = draft.truth.get("clock", {"start": setting.start, "step": setting.step})
    record = dgp.Record(
        np.arange(setting.samples) * clock["step"],
        draft.u[window] * scales.input_size + scales.input_offset,
        draft.y * scales.output_size + scales.output_offset,
        input_units=[scales.units[0]] * setting.u.shape[1],
        output_units=[scales.units[1]],
        extra=extra,
        start=clock["start"],
    )
    truth = {k: v for k, v in draft.truth.items() if k != "clock"}
    truth = _true_values(truth, scales, record)
    if draft.extra is not None:
        truth["channel"] = names[int(np.argmax(order))]
    return record, truth, scales


def _true_values(truth: Mapping[str, Any], scales: Scales, record: dgp.Record) -> dict[str, Any]:
    """Times in seconds, instants, levels and widths in the output's unit, names of channels."""
    step, found = record.sampling_time, dict[str, Any]()
    for name, value in truth.items():
        if name in ("delay", "delays", "period", "shift"):
            found[name] = tuple(step * d for d in value) if name == "delays" else step * value
        elif name == "pole":
            found[name] = value / step
        elif name == "first":
            found["time"] = float(record.time[value])
            if record.timestamps is not None:
                found["instant"] = pd.Timestamp(record.timestamps[value])
        elif name == "limits":
            found[name] = tuple(scales.output_offset + scales.output_size * v for v in value)
        elif name == "half_width":
            found[name] = float(scales.input_size[_number(truth["channel"])] * value)
        elif name == "height":
            found[name] = scales.output_size * value
        elif name in ("channel", "follows") and value != "output":
            found[name] = record.input_names[_number(value)]
        else:
            found[name] = value
    return found


def _number(channel: str) -> int:
    """Of an input called "input 0", "input 1", ..."""
    return int(channel.split()[-1])
