"""Records with the channels of a model, and channels as plain data."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import fields
from typing import Any

import numpy as np

from pyro_dynogp.data.channels.base import Channel
from pyro_dynogp.data.channels.clock import (
    Calendar,
    Ramp,
    RampOfGain,
    ShiftedClock,
    Sinusoid,
    Step,
    StepInput,
    StepOfGain,
    Trend,
    TrendOfGain,
)
from pyro_dynogp.data.channels.signal import DeadZone, Delayed, Play, Product, Recorded, Transformed
from pyro_dynogp.data.record import Record

# The channels that a file may name: a file never decides what code is run.
KINDS: dict[str, type[Channel]] = {
    kind.__name__: kind
    for kind in (
        Recorded, Delayed, DeadZone, Play, Transformed, Product, Step, StepInput, StepOfGain, Trend,
        TrendOfGain, Ramp, RampOfGain, Sinusoid, Calendar, ShiftedClock,
    )
}  # fmt: skip


def prepared(record: Record, channels: Sequence[Channel]) -> Record:
    """The record with the channels as inputs; as it is where it has them already.

    Channels that act directly come last, as `direct` of the models expects them. An input that was
    replaced becomes an extra channel.

    Raises:
        ValueError: where the record lacks what a channel is made from.
    """
    replaced = {channel.replaces for channel in channels}
    made = {name for channel in channels for name in channel.names} - replaced
    if made <= set(record.input_names):
        return record
    names, last = list(record.input_names), list[str]()
    values = {name: record.inputs[:, i] for i, name in enumerate(names)}
    units = dict(zip(names, record.input_units, strict=True))
    here = record
    for channel in channels:
        columns = channel.columns(here)
        values |= {name: columns[:, k] for k, name in enumerate(channel.names)}
        units |= dict(zip(channel.names, channel.units(here), strict=True))
        if channel.direct:
            last += list(channel.names)
        elif channel.replaces:
            place = names.index(channel.replaces)
            names[place : place + 1] = channel.names
        else:
            names += list(channel.names)
        here = _with_inputs(record, [*names, *last], values, units)
    return here


def _with_inputs(
    record: Record, names: list[str], values: Mapping[str, np.ndarray], units: Mapping[str, str]
) -> Record:
    lost = [name for name in values if name not in names]
    extra = {k: v for k, v in record.extra.items() if k not in names}
    extra |= {name: values[name] for name in lost}
    return dataclasses.replace(
        record,
        inputs=np.column_stack([values[name] for name in names]),
        input_names=tuple(names),
        input_units=tuple(units[name] for name in names),
        extra=extra,
        extra_units={k: record.extra_units.get(k, units.get(k, "")) for k in extra},
    )


def count_direct(channels: Sequence[Channel]) -> int:
    """Number of columns that act on the output at once."""
    return sum(len(channel.names) for channel in channels if channel.direct)


def to_plain(channel: Channel) -> dict[str, Any]:
    """A channel as JSON has it."""
    values = {f.name: getattr(channel, f.name) for f in fields(channel)}
    return {"kind": type(channel).__name__, **values}


def from_plain(plain: Mapping[str, Any]) -> Channel:
    """Inverse of `to_plain`.

    Raises:
        ValueError: on a kind of channel that the package does not know.
    """
    given = dict(plain)
    kind = given.pop("kind")
    if kind not in KINDS:
        raise ValueError(f"load: unknown channel {kind!r}; known are {sorted(KINDS)}.")
    return KINDS[kind](**{k: tuple(v) if isinstance(v, list) else v for k, v in given.items()})
