"""Writers: a Record as a DataFrame, as an xarray Dataset, as a table to read."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd
import xarray as xr

from pyro_dynogp.data.checks import Array

if TYPE_CHECKING:
    from pyro_dynogp.data.record import Record


def columns_of(record: Record) -> tuple[dict[str, Array], dict[str, str]]:
    """All channels by name, inputs, outputs and extra ones in this order, and their units."""
    values = {name: record.inputs[:, i] for i, name in enumerate(record.input_names)}
    values |= {name: record.outputs[:, i] for i, name in enumerate(record.output_names)}
    units = dict(zip(record.input_names, record.input_units, strict=True))
    units |= dict(zip(record.output_names, record.output_units, strict=True))
    return values | dict(record.extra), units | dict(record.extra_units)


def to_frame(record: Record) -> pd.DataFrame:
    """Channels as columns; see `Record.to_frame`."""
    values, units = columns_of(record)
    index = record.timestamps if record.start is not None else pd.Index(record.time)
    frame = pd.DataFrame(values, index=index).rename_axis("time")
    frame.attrs = {"units": units, "time_unit": record.time_unit, "name": record.name}
    if record.start is not None:
        frame.attrs["start"] = record.start.isoformat()
    return frame


def to_xarray(record: Record) -> xr.Dataset:
    """Channels as variables over "time"; see `Record.to_xarray`."""
    values, units = columns_of(record)
    clock = {"units": record.time_unit}
    coords: dict[str, Any] = {"time": ("time", record.time, clock)}
    if record.timestamps is not None and record.start is not None:
        clock |= {"start": record.start.isoformat(), "time_zone": str(record.start.tz)}
        utc = record.timestamps.tz_convert("UTC").tz_localize(None)
        coords["timestamp"] = ("time", utc.to_numpy())
    channels = {k: ("time", v, {"units": units[k]}) for k, v in values.items()}
    return xr.Dataset(channels, coords, {"name": record.name})


def summary(record: Record) -> str:
    """Table of the channels; see `Record.summary`."""
    values, units = columns_of(record)
    lines = [repr(record), f"{'channel':<20}{'role':<8}{'unit':<10}"]
    lines[1] += "".join(f"{head:>12}" for head in ("min", "mean", "max", "missing"))
    for name, column in values.items():
        seen = column[~np.isnan(column)]
        role = "input" if name in record.input_names else "extra"
        role = "output" if name in record.output_names else role
        numbers = (seen.min(), seen.mean(), seen.max()) if len(seen) else (np.nan,) * 3
        cells = "".join(f"{number:>12.5g}" for number in numbers)
        gaps = len(column) - len(seen)
        lines.append(f"{name:<20}{role:<8}{units[name] or '-':<10}{cells}{gaps:>12}")
    return "\n".join(lines)
