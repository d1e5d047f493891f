"""Readers: the arguments of a Record from a DataFrame or a Dataset."""

from __future__ import annotations

from typing import Any, Unpack

import numpy as np
import pandas as pd
import xarray as xr

from pyro_dynogp.data.checks import Array, Names
from pyro_dynogp.data.columns import (
    ColumnOptions,
    check_options,
    choose,
    named_column,
    record_fields,
    sample_times,
)
from pyro_dynogp.data.fields import RecordFields
from pyro_dynogp.data.numerals import no_number
from pyro_dynogp.data.time_stamps import localise
from pyro_dynogp.support.errors import instance, invalid


def read_frame(
    frame: pd.DataFrame,
    inputs: Names = (),
    outputs: Names = None,
    **options: Unpack[ColumnOptions],
) -> RecordFields:
    """Record from the columns of a DataFrame.

    Args:
        frame: one row for each sample.
        inputs: names of the input columns (boolean columns become 0 and 1).
        outputs: names of the output columns; missing values are missing samples.
        output: the same as `outputs`; give one of the two.
        time: name of the column of times, or "index"; by default an index of time stamps or of
            floating-point numbers is taken.
        sampling_time: step [time_unit], where there are no times: sample k is at k * step.
        timezone: zone such as "Europe/Vienna": stamps without a zone are read in it, stamps with
            a zone are converted to it.
        time_unit: unit of numeric times; by default that in `frame.attrs`, or "s".
        extra: "all" keeps every other column of numbers as an extra channel and warns of those it
            leaves out, a list keeps those, None none.
        input_units: units of the inputs; by default those in `frame.attrs["units"]`, or "".
        output_units: units of the outputs, likewise.
        extra_units: name -> unit of the extra channels, likewise.
        name: label; by default that in `frame.attrs`, or "".

    Returns:
        The arguments of `Record`.

    Raises:
        ValueError: unknown columns, cells that are no numbers, no times or two sources of them,
            stamps without a zone, local times that daylight saving makes ambiguous.
    """
    check_options(options, ColumnOptions)
    columns = {str(key): frame[key] for key in frame.columns}
    if len(columns) != frame.shape[1]:
        raise invalid("frame", expected="unique column names", got=f"{list(map(str, frame))}")
    stamped = isinstance(frame.index, pd.DatetimeIndex)
    timed_index = stamped or pd.api.types.is_float_dtype(frame.index.dtype)
    time = options.get("time")
    if time is None and timed_index:
        time = "index"
    if time == "index" and time not in columns:
        source: Any = frame.index
    else:
        source = None if time is None else named_column(columns, "time", time)
    origin = None
    if source is not None and pd.api.types.is_datetime64_any_dtype(source.dtype):
        source = localise(pd.DatetimeIndex(source), options.get("timezone"))
        begin = frame.attrs.get("start")
        origin = None if begin is None else pd.Timestamp(begin).tz_convert(source.tz)
    clock = sample_times(source, options.get("sampling_time"), len(frame))
    chosen, values = choose(
        columns, inputs, outputs, options, time, lambda key: _series_numbers(key, columns[key])
    )
    units = {str(k): str(v) for k, v in frame.attrs.get("units", {}).items()}
    label = options.get("name")
    return record_fields(
        clock, values, chosen, units, options,
        time_unit=options.get("time_unit") or frame.attrs.get("time_unit", "s"),
        name=frame.attrs.get("name", "") if label is None else label, start=origin,
    )  # fmt: skip


def read_xarray(
    dataset: xr.Dataset,
    inputs: Names = (),
    outputs: Names = None,
    **options: Unpack[ColumnOptions],
) -> RecordFields:
    """Record from the variables of a Dataset that run over the dimension of time alone.

    Args:
        dataset: the data; units are read from `attrs["units"]` of the variables and of time.
        inputs: names of the input variables.
        outputs: names of the output variables; NaN is a missing sample.
        **options: as in `read_frame`, but for `time`: name of the dimension and coordinate of
            time, "time" by default: numbers (with the attribute "start" the instant of zero), or
            datetime64 together with `timezone`.

    Returns:
        The arguments of `Record`.

    Raises:
        ValueError: no such time coordinate, unknown variables, and as in `read_frame`.
    """
    check_options(options, ColumnOptions)
    instance("dataset", dataset, xr.Dataset)
    time = options.get("time") or "time"
    if time not in dataset.coords or dataset[time].dims != (time,):
        raise invalid(
            "time", expected=f"a coordinate of a dimension of that name {list(dataset.coords)}",
            got=repr(time), advice="dataset.assign_coords(time=...) adds one.",
        )  # fmt: skip
    clock = dataset[time]
    frame = pd.DataFrame(
        {str(k): v.values for k, v in dataset.data_vars.items() if v.dims == (time,)},
        index=pd.Index(clock.values, name=time),
    )
    units = {str(k): str(dataset[k].attrs.get("units", "")) for k in frame.columns}
    frame.attrs = {"units": units, "name": str(dataset.attrs.get("name", ""))}
    if "units" in clock.attrs:
        frame.attrs["time_unit"] = clock.attrs["units"]
    options["time"] = "index"
    fields = read_frame(frame, inputs, outputs, **options)
    if "start" in clock.attrs and fields["start"] is None:
        start = pd.Timestamp(clock.attrs["start"]).tz_convert(clock.attrs.get("time_zone"))
        fields["start"] = start
    return fields


def _series_numbers(key: str, series: pd.Series) -> Array:
    kind = series.dtype
    if pd.api.types.is_numeric_dtype(kind) and not pd.api.types.is_complex_dtype(kind):
        return np.asarray(
            series.astype("Float64").to_numpy(np.float64, na_value=np.nan), np.float64
        )
    values = np.empty(len(series))
    for row, cell in enumerate(series):
        if not isinstance(cell, (bool, int, float, np.number, np.bool_)) and not pd.isna(cell):
            raise no_number(f"row {series.index[row]}", key, cell)
        values[row] = np.nan if pd.isna(cell) else cell
    return values
