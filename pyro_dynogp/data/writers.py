"""Channels as tensors, as a DataFrame, as an xarray Dataset, as a table to read."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd
import xarray as xr
from torch import Tensor

from pyro_dynogp.data.checks import Array
from pyro_dynogp.data.clock import stamps_of


@dataclass(frozen=True)
class RecordTensors:
    """The numbers of a record as torch.float64 tensors, for writing Pyro models.

    Attributes:
        time: time of each sample, shape (n,) [time unit of the record].
        inputs: u, shape (n, n_u) [input units].
        outputs: y, shape (n, n_y) [output units]; NaN marks a missing sample.
    """

    time: Tensor
    inputs: Tensor
    outputs: Tensor

    @property
    def observations(self) -> Tensor:
        """Outputs as models observe them: (n,) of one output, (n, n_y) of several [output units].

        NaN marks a missing sample.
        """
        return self.outputs if self.outputs.shape[1] != 1 else self.outputs[:, 0]


@dataclass(frozen=True)
class Channels:
    """All channels of a record by name, on its clock: inputs, outputs, extra ones in this order.

    Attributes:
        values: name -> (n,). units: name -> unit.
        time: (n,) [time_unit]; seconds since `start` where there is one.
    """

    values: Mapping[str, Array]
    units: Mapping[str, str]
    time: Array
    time_unit: str
    start: pd.Timestamp | None
    name: str


def to_frame(channels: Channels) -> pd.DataFrame:
    """Channels as columns; see `Record.to_frame`."""
    time, start = channels.time, channels.start
    index = pd.Index(time) if start is None else stamps_of(time, start)
    frame = pd.DataFrame(dict(channels.values), index=index).rename_axis("time")
    frame.attrs = {
        "units": dict(channels.units), "time_unit": channels.time_unit, "name": channels.name
    }  # fmt: skip
    if start is not None:
        frame.attrs["start"] = start.isoformat()
    return frame


def to_xarray(channels: Channels) -> xr.Dataset:
    """Channels as variables over "time"; see `Record.to_xarray`."""
    clock = {"units": channels.time_unit}
    coords: dict[str, Any] = {"time": ("time", channels.time, clock)}
    if channels.start is not None:
        clock |= {"start": channels.start.isoformat(), "time_zone": str(channels.start.tz)}
        utc = stamps_of(channels.time, channels.start).tz_convert("UTC").tz_localize(None)
        coords["timestamp"] = ("time", utc.to_numpy())
    variables = {
        name: ("time", column, {"units": channels.units[name]})
        for name, column in channels.values.items()
    }
    return xr.Dataset(variables, coords, {"name": channels.name})


def summary(
    title: str, channels: Channels, inputs: Collection[str], outputs: Collection[str]
) -> str:
    """Table of the channels under a title; see `Record.summary`."""
    lines = [title, f"{'channel':<20}{'role':<8}{'unit':<10}"]
    lines[1] += "".join(f"{head:>12}" for head in ("min", "mean", "max", "missing"))
    for name, column in channels.values.items():
        seen = column[~np.isnan(column)]
        role = "output" if name in outputs else "input" if name in inputs else "extra"
        numbers = (seen.min(), seen.mean(), seen.max()) if len(seen) else (np.nan,) * 3
        cells = "".join(f"{number:>12.5g}" for number in numbers)
        gaps = len(column) - len(seen)
        lines.append(f"{name:<20}{role:<8}{channels.units[name] or '-':<10}{cells}{gaps:>12}")
    return "\n".join(lines)
