"""Readers: the arguments of a Record from a DataFrame, a text file of columns, a Dataset."""

from __future__ import annotations

from collections.abc import Mapping
from numbers import Real
from os import PathLike
from pathlib import Path
from typing import Any, Unpack

import numpy as np
import pandas as pd
import xarray as xr

from pyro_dynogp.data.checks import Array, Names
from pyro_dynogp.data.fields import RecordFields
from pyro_dynogp.data.reader_options import ColumnOptions, TextOptions, checked_options
from pyro_dynogp.data.text_table import localise, named_column, no_number, read_table
from pyro_dynogp.support.errors import PATH, instance, invalid


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
        extra: "all" keeps every other column as an extra channel, a list keeps those, None none.
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
    inputs, outputs = checked_options(options, ColumnOptions, inputs, outputs)
    instance("frame", frame, pd.DataFrame)
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
    clock = _clock(source, options.get("sampling_time"), len(frame))
    chosen = _choose(columns, inputs, outputs, options, time)
    values = {key: _series_numbers(key, columns[key]) for keys in chosen for key in keys}
    units = {str(k): str(v) for k, v in frame.attrs.get("units", {}).items()}
    label = options.get("name")
    return _fields(
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
    inputs, outputs = checked_options(options, ColumnOptions, inputs, outputs)
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


def read_csv(
    path: str | PathLike[str],
    inputs: Names = (),
    outputs: Names = None,
    **options: Unpack[TextOptions],
) -> RecordFields:
    """Record from a text file of columns; local files, also .gz, .bz2 and .xz.

    Names of columns: those of the first line. A line that holds only numbers, time stamps and
    missing values is data: without a header the names are "0", "1", ... A name followed by
    columns without one heads a block: `r,,,u` names r_0, r_1, r_2, u. Empty columns without a
    name at the right (a comma at the end of each line) are dropped.

    Cells: numbers; TRUE and FALSE are 1 and 0; empty cells, NA, N/A, NaN and null are missing.
    Lines that begin with # or % and blank lines are skipped; short lines end in missing cells.

    Args:
        path: the file.
        inputs: names of the input columns.
        outputs: names of the output columns; missing cells are missing samples.
        output: the same as `outputs`; give one of the two.
        time: name of the column of times: numbers, or ISO 8601 stamps such as
            2012-01-01T00:30:00Z, 2012-01-01 11:30+11:00, or local ones together with `timezone`.
        sampling_time: step [time_unit], where there is no such column.
        timezone: zone such as "Australia/Melbourne": stamps without a zone are read in it,
            stamps with a zone are converted to it.
        time_unit: unit of numeric times.
        extra: "all" keeps every other column as an extra channel, a list keeps those, None none.
        input_units: units of the inputs.
        output_units: units of the outputs.
        extra_units: name -> unit of the extra channels.
        name: label; by default the file's name without its suffixes.
        header: whether the first line holds names; by default found as told above.
        names: names of all columns, in place of a header.
        delimiter: character between columns, or " " for white space. By default the first of
            semicolon, tab, comma that every line has, else white space.
        decimal: "." or ","; by default "," where the delimiter is not a comma and numbers are
            written with a comma, else ".".
        encoding: of the file.

    Returns:
        The arguments of `Record`.

    Raises:
        ValueError: unknown columns; cells that are no numbers (their line and column); lines of
            too many cells; no times or two sources of them; stamps without a zone, or that
            daylight saving makes ambiguous.
    """
    inputs, outputs = checked_options(options, TextOptions, inputs, outputs)
    PATH.check("path", path)
    table = read_table(
        Path(path), options.get("header"), options.get("names"), options.get("delimiter"),
        options.get("decimal"), options.get("encoding", "utf-8-sig"),
    )  # fmt: skip
    time, name = options.get("time"), options.get("name")
    source = None if time is None else table.times(time, options.get("timezone"))
    chosen = _choose(table.columns, inputs, outputs, options, time)
    return _fields(
        _clock(source, options.get("sampling_time"), len(table.lines)),
        {key: table.numbers(key) for keys in chosen for key in keys},
        chosen, {}, options, time_unit=options.get("time_unit") or "s",
        name=Path(path).name.split(".")[0] if name is None else name, start=None,
    )  # fmt: skip


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


def _choose(
    columns: Mapping[str, Any], inputs: Names, outputs: Names, options: ColumnOptions,
    time: str | None,
) -> tuple[list[str], list[str], list[str]]:  # fmt: skip
    """Names of the inputs, outputs and extra channels, all of them known."""
    output, extra = options.get("output"), options.get("extra", "all")
    if outputs is not None and output is not None:
        raise invalid("output", expected="either output or outputs", got="both")
    chosen = []
    for argument, value in (
        ("inputs", inputs),
        ("outputs", output if outputs is None else outputs),
    ):
        keys = [value] if isinstance(value, str) else list(value or ())
        for key in keys:
            named_column(columns, argument, key)
        chosen.append(keys)
    if extra == "all":
        rest = [key for key in columns if key not in (*chosen[0], *chosen[1], time)]
    else:
        rest = [extra] if isinstance(extra, str) else list(extra or ())
        for key in rest:
            named_column(columns, "extra", key)
    return chosen[0], chosen[1], rest


def _clock(source: Any, sampling_time: float | None, n: int) -> Any:
    """Take the times from their column, or from the step; exactly one of the two."""
    if source is None and sampling_time is None:
        raise invalid(
            "time", expected="the name of a column of times, or a sampling_time", got="neither",
            advice="Give time=... (\"index\" for the index of a frame) or, for equal steps, "
            "sampling_time=... in the unit of time.",
        )  # fmt: skip
    if source is not None and sampling_time is not None:
        raise invalid(
            "sampling_time", expected="None where the data have times", got=repr(sampling_time),
            advice="Leave it out; to override an index of times use frame.reset_index(drop=True).",
        )  # fmt: skip
    if source is not None:
        return source
    step = sampling_time
    if isinstance(step, bool) or not isinstance(step, Real) or not 0 < step < np.inf:
        raise invalid("sampling_time", expected="a positive number", got=repr(sampling_time))
    return np.arange(n) * float(step)


def _fields(
    clock: Any, values: Mapping[str, Array], chosen: tuple[list[str], list[str], list[str]],
    units: Mapping[str, str], options: ColumnOptions, *, time_unit: str, name: str,
    start: pd.Timestamp | None,
) -> RecordFields:  # fmt: skip
    u, y, rest = chosen
    empty = np.empty((len(clock), 0))
    u_units, y_units = options.get("input_units"), options.get("output_units")
    extra_units = options.get("extra_units") or {}
    return {
        "time": clock,
        "inputs": np.column_stack([empty, *(values[key] for key in u)]),
        "outputs": np.column_stack([empty, *(values[key] for key in y)]),
        "input_names": u,
        "output_names": y,
        "input_units": [units.get(key, "") for key in u] if u_units is None else u_units,
        "output_units": [units.get(key, "") for key in y] if y_units is None else y_units,
        "extra": {key: values[key] for key in rest},
        "extra_units": {key: units.get(key, "") for key in rest} | dict(extra_units),
        "time_unit": time_unit,
        "name": name,
        "start": start,
    }
