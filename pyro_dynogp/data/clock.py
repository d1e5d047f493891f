"""The time axis of a record: steps, stamps, and which samples a part of it has."""

from __future__ import annotations

import datetime

import numpy as np
import pandas as pd

from pyro_dynogp.data.checks import Array, as_instant, nanoseconds
from pyro_dynogp.support.errors import invalid


def is_regular(time: Array) -> bool:
    """Whether all steps of times (n,) are equal up to rounding (1e-9 of the step)."""
    steps = np.diff(time)
    if len(steps) < 2:
        return True
    # Each stamp is rounded to half a unit in the last place, and so is their difference.
    rounding = 4 * np.spacing(np.abs(time).max())
    median = np.median(steps)
    return bool(np.abs(steps - median).max() <= max(1e-9 * median, rounding))


def sampling_time(time: Array) -> float:
    """Median step of times (n,).

    Raises:
        ValueError: fewer than two samples.
    """
    if len(time) < 2:
        raise invalid("record", expected="two samples or more (a step)", got="one sample")
    if is_regular(time):  # the mean of equal steps carries less rounding than one of them
        return float(time[-1] - time[0]) / (len(time) - 1)
    return float(np.median(np.diff(time)))


def stamps_of(time: Array, start: pd.Timestamp) -> pd.DatetimeIndex:
    """Time stamps (n,) of seconds since `start`, in its zone.

    Rounded to the nanosecond; to the microsecond beyond 100 days, where float64 seconds resolve
    no more.
    """
    tick = 1 if np.abs(time).max() < 100 * 86400 else 1000
    elapsed = np.rint(time * (1e9 / tick)).astype(np.int64) * tick
    stamps = pd.to_datetime(nanoseconds(start) + elapsed, unit="ns", utc=True)
    return stamps.tz_convert(start.tz)


def check_slice(key: object, time: Array) -> None:
    """Refuse what is no slice of samples with a positive step that holds one.

    Raises:
        ValueError: see above.
    """
    if not isinstance(key, slice):
        raise invalid(
            "record[...]",
            expected="a slice such as record[100:400] or record[::2]",
            got=type(key).__name__,
            advice="For one sample write record[k:k + 1]; to leave samples out set their "
            "outputs to NaN (record.with_outputs), or slice into several records.",
        )
    try:
        step = key.indices(len(time))[2]
    except (TypeError, ValueError) as error:
        raise invalid(
            "record[...]", expected="sample numbers in the slice", got=str(key),
            advice="record.split takes time stamps; np.searchsorted(record.time, t) finds "
            "the sample number of a time t.",
        ) from error  # fmt: skip
    if step < 0:
        raise invalid("record[...]", expected="a positive step", got=f"step {step}")
    if not len(time[key]):
        raise invalid(
            "record[...]", expected="a slice that holds a sample", got=f"{key}, empty",
            advice=f"The record has {len(time)} samples.",
        )  # fmt: skip


def split_at(
    at: int | str | datetime.datetime, samples: int, stamps: pd.DatetimeIndex | None
) -> int:
    """Number of samples before `at`, between 1 and samples - 1.

    Args:
        at: that number, or an instant with time zone. samples: n. stamps: (n,), where there are.

    Raises:
        ValueError: a part would be empty; `at` is a number of seconds or has no zone.
    """
    if isinstance(at, (str, datetime.datetime)):
        if stamps is None:
            raise invalid("at", expected="a sample index (no time stamps here)", got=f"{at!r}")
        k = int(stamps.searchsorted(as_instant("at", at)))
    elif isinstance(at, (int, np.integer)) and not isinstance(at, bool):
        k = int(at)
    else:
        raise invalid(
            "at", expected="the number of samples of the first part, an int", got=repr(at),
            advice="For a time write record.split(int(np.searchsorted(record.time, t))).",
        )  # fmt: skip
    if not 0 < k < samples:
        raise invalid(
            "at", expected=f"a split with samples on both sides, 1 to {samples - 1}",
            got=f"{at!r}, which leaves {max(k, 0)} samples before it",
        )  # fmt: skip
    return k


def no_resampling() -> ValueError:
    """The error for a request of other times than those recorded."""
    return invalid(
        "resample",
        expected="the times as they were recorded",
        got="a request for other times",
        advice="Resampling is not guessed: a coarser grid aliases what is faster, a finer one "
        "invents inputs between their samples. Irregular times can be used as they are. "
        "Otherwise filter and resample yourself (scipy.signal.decimate, or pandas resample) "
        "and build a new Record.",
    )
