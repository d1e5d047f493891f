"""Conversion and checks of what a user gives to a Record, before it becomes one."""

from __future__ import annotations

import datetime
import hashlib
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd
import torch
from numpy.typing import NDArray
from torch import Tensor

from pyro_dynogp.support.errors import invalid

Array = NDArray[np.float64]
Names = str | Sequence[str] | None
# Seconds from 1970 to the last stamp in nanoseconds, rounded down.
LATEST = 2**63 / 1e9 - 1.0


def frozen(array: Array) -> Array:
    """A copy (n, ...) in float64 that cannot be written to."""
    copy = np.array(array, dtype=np.float64, order="C")
    copy.setflags(write=False)
    return copy


def real_numbers(argument: str, value: Any) -> Array:
    """Real numbers as float64, not copied where they are; what is no number is refused."""
    if isinstance(value, Tensor):
        value = value.detach().cpu()
        value = (value if value.is_complex() else value.to(torch.float64)).numpy()
    elif isinstance(value, np.ma.MaskedArray):  # np.asarray would drop the mask
        value = np.ma.filled(value.astype(np.float64), np.nan)
    expected = "real numbers"
    try:
        array = np.asarray(value)
        if array.dtype.kind == "O":  # None, pandas' NA, Decimal
            text = next((v for v in array.ravel() if isinstance(v, (str, bytes))), None)
            if text is not None:
                raise invalid(argument, expected=expected, got=f"the text {text!r}")
            array = np.where(pd.isna(array), np.nan, array).astype(np.float64)
    except (TypeError, ValueError) as error:
        if str(error).startswith(f"{argument}: "):
            raise
        raise invalid(
            argument, expected=expected, got=f"{type(value).__name__}: {error}"
        ) from error
    if array.dtype.kind not in "biuf":
        raise invalid(
            argument, expected=expected, got=f"an array of type {array.dtype}",
            advice="Convert it first; text columns are read by Record.from_csv.",
        )  # fmt: skip
    return array.astype(np.float64, copy=False)


def as_channels(argument: str, value: Any, n: int, columns: int | None = None) -> Array:
    """Channels as (n, number of channels)."""
    array = np.empty((n, 0)) if value is None else real_numbers(argument, value)
    if array.ndim == 1:
        array = array[:, None]
    if array.ndim != 2 or len(array) != n or (columns is not None and array.shape[1] != columns):
        turned = array.ndim == 2 and array.shape[1] == n
        raise invalid(
            argument,
            expected=f"shape ({n},)" + ("" if columns == 1 else f" or ({n}, channels)"),
            got=f"shape {np.shape(value)}",
            advice="Transpose it: one row for each sample." if turned else "",
        )
    return array


def check_finite(
    argument: str, array: Array, names: tuple[str, ...], *, missing_allowed: bool
) -> None:
    """Refuse an array with infinite numbers, or missing ones where these are not allowed."""
    bad = np.isinf(array) if missing_allowed else ~np.isfinite(array)
    if not bad.any():
        return
    column = int(np.argmax(bad.any(axis=0)))
    rows = np.flatnonzero(bad[:, column])
    shown = ", ".join(map(str, rows[:5])) + (", ..." if len(rows) > 5 else "")
    raise invalid(
        argument,
        expected="finite numbers" + (" or NaN (missing)" if missing_allowed else ""),
        got=f"{array[rows[0], column]} in column {names[column]!r}, {len(rows)} rows: {shown}",
        advice="Write NaN where a sample is missing."
        if missing_allowed
        else "Fill the gaps by what the input was, or drop them by slicing into several records.",
    )


def as_names(value: str | Sequence[str], argument: str = "names") -> tuple[str, ...]:
    """One name or several as a tuple.

    Raises:
        ValueError: for anything else.
    """
    if isinstance(value, str):
        return (value,)
    if isinstance(value, bytes | Mapping) or not isinstance(value, Iterable):
        expected = "a name, or a list of names"
        raise invalid(argument, expected=expected, got=f"a {type(value).__name__}")
    return tuple(value)


def check_unique(names: tuple[str, ...]) -> None:
    """Refuse names that occur twice."""
    for name in names:
        if names.count(name) > 1:
            raise invalid(
                "names", expected="each channel name once among inputs, outputs and extra",
                got=f"{name!r} {names.count(name)} times",
            )  # fmt: skip


def as_texts(
    argument: str, value: Names, count: int, *, default: str = "", unique: bool = True
) -> tuple[str, ...]:
    """Names or units, one for each channel."""
    if value is None:
        several = default and count > 1
        return tuple(f"{default}{i + 1}" if several else default for i in range(count))
    if not isinstance(value, str | Sequence | np.ndarray):
        raise invalid(argument, expected=f"{count} texts", got=repr(value))
    texts = as_names(value, argument)
    wrong = [t for t in texts if not isinstance(t, str) or (unique and not t)]
    if wrong or len(texts) != count:
        raise invalid(argument, expected=f"{count} non-empty texts" if unique else f"{count} texts",
                      got=f"{len(texts)}: {list(texts)}")  # fmt: skip
    return texts


def nanoseconds(stamp: pd.Timestamp) -> int:
    """A time stamp as nanoseconds since 1970."""
    return int(stamp.as_unit("ns").value)


def naive_stamps(argument: str) -> ValueError:
    """The error for time stamps without a time zone."""
    return invalid(
        argument,
        expected="time stamps with a time zone",
        got="stamps without one",
        advice="Local times without their zone are ambiguous (daylight saving). Localise them: "
        'pd.DatetimeIndex(...).tz_localize("UTC"), or the time zone of the plant.',
    )


def as_instant(argument: str, value: Any) -> pd.Timestamp:
    """A time stamp with a zone from what a user gave."""
    try:
        stamp = pd.Timestamp(value)
    except (TypeError, ValueError) as error:
        raise invalid(argument, expected="a time stamp", got=repr(value)) from error
    if pd.isna(stamp) or stamp.tz is None:
        raise naive_stamps(argument)
    return stamp


def as_stamps(value: Any) -> pd.DatetimeIndex | None:
    """Time stamps with their zone, or None where `value` holds no stamps."""
    if isinstance(value, Tensor):
        return None
    if not isinstance(value, (pd.DatetimeIndex, pd.Series)):
        array = np.asarray(value)
        if array.dtype.kind == "M":
            raise naive_stamps("time")
        if array.ndim != 1 or not any(isinstance(t, datetime.datetime) for t in array[:1]):
            return None
        if any(getattr(t, "tzinfo", None) is None for t in array):
            raise naive_stamps("time")
        # Daylight saving gives one zone two offsets, so convert by way of UTC.
        return pd.DatetimeIndex(pd.to_datetime(list(array), utc=True)).tz_convert(array[0].tzinfo)
    if not pd.api.types.is_datetime64_any_dtype(value.dtype):
        return None
    index = pd.DatetimeIndex(value)
    if index.tz is None:
        raise naive_stamps("time")
    return index


def read_clock(time: Any, start: Any, time_unit: str) -> tuple[Array, pd.Timestamp | None]:
    """Time (n,) as increasing numbers, and the instant of time zero."""
    origin = None if start is None else as_instant("start", start)
    index = as_stamps(time)
    if index is not None:
        if not len(index):
            raise invalid("time", expected="one sample or more", got="an empty record")
        if index.hasnans:
            row = int(np.flatnonzero(index.isna())[0])
            raise invalid("time", expected="a time stamp for each sample", got=f"none in row {row}")
        if origin is None:
            origin = index[0]
        clock = (index.as_unit("ns").asi8 - nanoseconds(origin)) / 1e9
    else:
        clock = real_numbers("time", time)
    if origin is not None and time_unit != "s":
        raise invalid("time_unit", expected='"s" with time stamps', got=repr(time_unit))
    if clock.ndim != 1:
        raise invalid("time", expected="shape (n,)", got=f"shape {clock.shape}")
    if not len(clock):
        raise invalid("time", expected="one sample or more", got="an empty record")
    if not np.isfinite(clock).all():
        row = int(np.flatnonzero(~np.isfinite(clock))[0])
        raise invalid("time", expected="finite numbers", got=f"{clock[row]} in row {row}")
    if origin is not None and np.abs(clock + nanoseconds(origin) / 1e9).max() > LATEST:
        raise invalid(
            "time", expected="instants from 1677 to 2262, which stamps can name",
            got=f"{clock[0]:g} to {clock[-1]:g} s after {origin}",
        )  # fmt: skip
    steps = np.diff(clock)
    if (steps <= 0).any():
        k = int(np.flatnonzero(steps <= 0)[0])
        pair = (clock[k], clock[k + 1]) if index is None else (index[k], index[k + 1])
        raise invalid(
            "time",
            expected="strictly increasing times",
            got=f"{'a repeated time stamp' if steps[k] == 0 else 'a step back'} at index {k + 1}: "
            f"{pair[0]} then {pair[1]}",
            advice="Sort the rows by time; keep one row for each time, or give repeated "
            "experiments as several records.",
        )
    return clock, origin


def fingerprint_of(text: str, arrays: Sequence[Array]) -> str:
    """Hex SHA-256 of a text and arrays: equal for equal values."""
    digest = hashlib.sha256(text.encode())
    for array in arrays:
        # One bit pattern for each value: -0.0 + 0.0 is 0.0, and NaN has many patterns.
        plain = np.where(np.isnan(array), np.nan, array + 0.0).astype("<f8")
        digest.update(repr(plain.shape).encode() + plain.tobytes())
    return digest.hexdigest()
