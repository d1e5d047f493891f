"""Data of other libraries: tables, MATLAB files, nonlinear_benchmarks, holidays."""

from __future__ import annotations

import zlib
from collections.abc import Mapping
from os import PathLike
from pathlib import Path
from typing import Any, Unpack

import numpy as np
import pandas as pd

from pyro_dynogp.data.checks import Names, real_numbers
from pyro_dynogp.data.columns import (
    ColumnOptions,
    check_options,
    keys_of,
    named_column,
    sample_times,
)
from pyro_dynogp.data.fields import RecordFields
from pyro_dynogp.data.readers import read_frame
from pyro_dynogp.support.errors import RULES, invalid


def as_frame(table: Any) -> pd.DataFrame:
    """A pandas DataFrame of any table, column by column, so that pyarrow is not needed.

    Raises:
        ValueError: no table, or one of another library where narwhals is not installed.
    """
    if isinstance(table, pd.DataFrame):
        return table
    expected, got = "a table such as a pandas or polars DataFrame", type(table).__name__
    try:
        import narwhals
    except ImportError as error:
        advice = "Tables of other libraries than pandas need the package narwhals."
        raise invalid("frame", expected=expected, got=got, advice=advice) from error
    try:
        frame: Any = narwhals.from_native(table, eager_only=True)
    except TypeError as error:
        raise invalid("frame", expected=expected, got=got) from error
    columns = {}
    for name in frame.columns:
        values = pd.Series(frame[name].to_numpy())
        zone = getattr(frame[name].dtype, "time_zone", None)
        # NumPy has the instants in UTC, without their zone.
        columns[name] = values if zone is None else values.dt.tz_localize("UTC").dt.tz_convert(zone)
    return pd.DataFrame(columns)


def read_mat(
    path: str | PathLike[str], inputs: Names = (), outputs: Names = None,
    **options: Unpack[ColumnOptions],
) -> RecordFields:  # fmt: skip
    """Record from the vectors of a MATLAB file (up to version 7.2), read by `scipy.io.loadmat`.

    A vector is a column of its name, a matrix of k columns is name_0, name_1, ..., and what is in a
    structure is `structure.name`. Arrays of another length than the channels are left out.

    Args:
        path: the file. inputs: names of the input vectors. outputs: names of the output vectors.
        options: as in `readers.read_frame`; `time` is the name of a vector of times.

    Raises:
        ValueError: no file of this kind, unknown names, channels of different lengths, and as in
            `readers.read_frame`.
    """
    import scipy.io  # for this alone: every import of the package would wait for it

    check_options(options, ColumnOptions)
    RULES["path"].check("path", path)
    try:
        with open(path, "rb") as file:
            found = scipy.io.loadmat(file, simplify_cells=True)
    except NotImplementedError as error:
        raise invalid(
            "path", expected="a MATLAB file of version 7.2 or before", got=f"{path}, a later one",
            advice="Save it in MATLAB with save(..., '-v7').",
        ) from error  # fmt: skip
    except (ValueError, TypeError, zlib.error, scipy.io.matlab.MatReadError) as error:
        raise invalid("path", expected="a MATLAB file", got=f"{path} ({error})") from error
    except OSError as error:
        if error.filename is not None:  # no damage, but no file
            raise
        raise invalid("path", expected="a whole MATLAB file", got=f"{path} ({error})") from error
    columns = _columns({k: v for k, v in found.items() if not k.startswith("__")})
    given = outputs if outputs is not None else options.get("output")
    asked = {"inputs": inputs, "outputs": given, "time": options.get("time")}
    named = [(argument, key) for argument, keys in asked.items()
             for key in keys_of(argument, keys)]  # fmt: skip
    lengths = {key: len(named_column(columns, argument, key)) for argument, key in named}
    if not lengths:
        raise invalid(
            "outputs", expected=f"names among {list(columns)}", got="none",
            advice="They say which vectors belong together.",
        )  # fmt: skip
    if len(set(lengths.values())) > 1:
        raise invalid("outputs", expected="channels of one length", got=f"{lengths}")
    n = next(iter(lengths.values()))
    frame = pd.DataFrame({key: values for key, values in columns.items() if len(values) == n})
    frame.attrs = {"name": Path(path).name.split(".")[0]}
    return read_frame(frame, inputs, outputs, **options)


def _columns(found: Mapping[str, Any], before: str = "") -> dict[str, np.ndarray]:
    """Vectors of numbers by name, those of structures and of matrices among them."""
    columns: dict[str, np.ndarray] = {}
    for name, value in found.items():
        key = before + name
        if isinstance(value, Mapping):
            columns |= _columns(value, f"{key}.")
        elif isinstance(value, np.ndarray) and value.dtype.kind in "biuf":
            if value.ndim == 1 or (value.ndim == 2 and 1 in value.shape):
                columns[key] = value.ravel()
            elif value.ndim == 2:
                tall = value if value.shape[0] >= value.shape[1] else value.T
                columns |= {f"{key}_{i}": tall[:, i] for i in range(tall.shape[1])}
    return columns


def read_benchmark(data: Any, sampling_time: float | None) -> RecordFields:
    """Record from an object with `u`, `y` and `sampling_time`; see `Record.from_benchmark`."""
    for name in ("u", "y"):
        if not hasattr(data, name):
            raise invalid(
                "data", expected="an object with u, y and sampling_time",
                got=f"{type(data).__name__} without {name}",
            )  # fmt: skip
    own = getattr(data, "sampling_time", None)
    step = sampling_time
    if step is None and own is not None:
        step = float(real_numbers("data.sampling_time", own).item())
    if step is None:
        raise invalid("sampling_time", expected="a step, as the data have none", got="None")
    u, y = (real_numbers(f"data.{name}", getattr(data, name)) for name in ("u", "y"))
    label = getattr(data, "name", None)
    return {
        "time": sample_times(None, step, len(y)),
        "inputs": u, "outputs": y, "input_names": None, "output_names": None, "input_units": None,
        "output_units": None, "time_unit": "s", "extra": {}, "extra_units": {},
        "name": "" if label is None else str(label), "start": None,
    }  # fmt: skip


def holidays_of(
    stamps: pd.DatetimeIndex | None, country: str, subdivision: str | None
) -> np.ndarray:
    """1.0 where a local date is a public holiday, else 0.0, shape (n,).

    Args:
        stamps: in the zone of the plant. country: code such as "AT" (ISO 3166), as of
            `holidays.country_holidays`. subdivision: of it, such as "BY" of "DE"; None for none.

    Raises:
        ImportError: where the package holidays is not installed.
        ValueError: no time stamps, or no such country or subdivision.
    """
    if stamps is None:
        raise invalid(
            "record", expected="time stamps, whose dates may be holidays", got="plain times"
        )
    for argument, value in (("country", country), ("subdivision", subdivision)):
        if not isinstance(value, str) and not (argument == "subdivision" and value is None):
            raise invalid(argument, expected='a code such as "AT"', got=repr(value))
    try:
        import holidays
    except ImportError as error:
        raise ImportError(
            "with_holidays needs the package holidays: pip install holidays", name="holidays"
        ) from error
    years = range(stamps[0].year, stamps[-1].year + 1)
    try:
        dates: Any = holidays.country_holidays(country, subdiv=subdivision, years=years)
    except NotImplementedError as error:
        argument = "subdivision" if "subdivision" in str(error) else "country"
        got = repr(subdivision if argument == "subdivision" else country)
        raise invalid(
            argument, expected="a code that the package holidays has", got=f"{got} ({error})"
        ) from error
    return np.isin(stamps.date, list(dates)).astype(np.float64)
