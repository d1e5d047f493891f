"""Record: one experiment as immutable arrays with their names, units and clock."""

from __future__ import annotations

import dataclasses
import datetime
import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from os import PathLike
from typing import Any, NoReturn

import numpy as np
import pandas as pd
import torch
import xarray as xr
from numpy.typing import NDArray
from torch import Tensor

from pyro_dynogp.data.checks import (
    Array,
    Names,
    as_channels,
    as_instant,
    as_names,
    as_texts,
    check_finite,
    check_unique,
    frozen,
    nanoseconds,
    read_clock,
)
from pyro_dynogp.data.writers import columns_of, summary, to_frame, to_xarray
from pyro_dynogp.support.errors import invalid
from pyro_dynogp.support.frozen import FrozenMapping


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


@dataclass(frozen=True, init=False, eq=False, repr=False)
class Record:
    """One experiment: n samples of inputs and outputs on one clock, immutable.

    Args:
        time: (n,) strictly increasing; real numbers in `time_unit`, or time stamps with a time
            zone (pandas DatetimeIndex or Series, a list of datetimes). Steps may differ.
        inputs: u (n, n_u) [input_units], or (n,) for one input; finite. None: no inputs.
        outputs: y (n, n_y) [output_units], or (n,) for one output; NaN marks a missing sample.
            None: no outputs.
        input_names: n_u names; by default "u", or "u1", "u2", ...
        output_names: n_y names; by default "y", or "y1", "y2", ...
        input_units: n_u units as text; by default "" (not stated).
        output_units: n_y units as text.
        time_unit: unit of `time`; always "s" with time stamps.
        extra: name -> (n,) recorded channels that a model does not use (NaN: missing). They
            travel with slices and splits.
        extra_units: name -> unit of the extra channels.
        name: label of the experiment (not part of equality).
        start: the instant (with time zone) at which `time` is zero. By default the first stamp
            where `time` holds time stamps, else None. Parts of a record keep it.

    Attributes:
        time: (n,) float64; seconds since `start` where there is one.
        inputs: (n, n_u) float64, read-only.
        outputs: (n, n_y) float64, read-only.
        extra: read-only mapping of read-only (n,) float64 arrays.

    Raises:
        ValueError: wrong shape, length, name or unit; a value that is no number; NaN or infinite
            inputs; infinite outputs; time that does not increase; stamps without a time zone.
    """

    time: Array
    inputs: Array
    outputs: Array
    input_names: tuple[str, ...]
    output_names: tuple[str, ...]
    input_units: tuple[str, ...]
    output_units: tuple[str, ...]
    time_unit: str
    extra: Mapping[str, Array]
    extra_units: Mapping[str, str]
    name: str
    start: pd.Timestamp | None

    def __init__(
        self,
        time: Any,
        inputs: Any = None,
        outputs: Any = None,
        *,
        input_names: Names = None,
        output_names: Names = None,
        input_units: Names = None,
        output_units: Names = None,
        time_unit: str = "s",
        extra: Mapping[str, Any] | None = None,
        extra_units: Mapping[str, str] | None = None,
        name: str = "",
        start: Any = None,
    ) -> None:
        if not isinstance(time_unit, str):
            raise invalid("time_unit", expected='text such as "s" or "h"', got=repr(time_unit))
        clock, origin = read_clock(time, start, time_unit)
        n = len(clock)
        u = as_channels("inputs", inputs, n)
        y = as_channels("outputs", outputs, n)
        u_names = as_texts("input_names", input_names, u.shape[1], default="u")
        y_names = as_texts("output_names", output_names, y.shape[1], default="y")
        check_finite("inputs", u, u_names, missing_allowed=False)
        check_finite("outputs", y, y_names, missing_allowed=True)
        kept: dict[str, Array] = {}
        for key, value in (extra or {}).items():
            kept[key] = as_channels(f"extra[{key!r}]", value, n, columns=1)[:, 0]
            check_finite(f"extra[{key!r}]", kept[key][:, None], (key,), missing_allowed=True)
        check_unique((*u_names, *y_names, *as_texts("extra", tuple(kept), len(kept))))
        unknown = sorted(set(extra_units or {}) - set(kept))
        if unknown:
            raise invalid("extra_units", expected=f"names of extra {list(kept)}", got=f"{unknown}")
        stored = {
            "time": frozen(clock),
            "inputs": frozen(u),
            "outputs": frozen(y),
            "input_names": u_names,
            "output_names": y_names,
            "input_units": as_texts("input_units", input_units, len(u_names), unique=False),
            "output_units": as_texts("output_units", output_units, len(y_names), unique=False),
            "time_unit": time_unit,
            "extra": FrozenMapping({k: frozen(v) for k, v in kept.items()}),
            "extra_units": FrozenMapping({k: (extra_units or {}).get(k, "") for k in kept}),
            "name": str(name),
            "start": origin,
        }
        for field, content in stored.items():
            object.__setattr__(self, field, content)

    @classmethod
    def from_frame(
        cls, frame: pd.DataFrame, inputs: Names = (), outputs: Names = None, **options: Any
    ) -> Record:
        """Record from a pandas DataFrame; options as in `readers.from_frame`."""
        from .readers import from_frame

        return from_frame(frame, inputs, outputs, **options)

    @classmethod
    def from_csv(
        cls, path: str | PathLike[str], inputs: Names = (), outputs: Names = None, **options: Any
    ) -> Record:
        """Record from a text file of columns; options as in `readers.from_csv`."""
        from .readers import from_csv

        return from_csv(path, inputs, outputs, **options)

    @classmethod
    def from_xarray(
        cls, dataset: xr.Dataset, inputs: Names = (), outputs: Names = None, **options: Any
    ) -> Record:
        """Record from an xarray Dataset; options as in `readers.from_xarray`."""
        from .readers import from_xarray

        return from_xarray(dataset, inputs, outputs, **options)

    def __len__(self) -> int:
        return len(self.time)

    @property
    def n_inputs(self) -> int:
        """Number of inputs n_u."""
        return self.inputs.shape[1]

    @property
    def n_outputs(self) -> int:
        """Number of outputs n_y."""
        return self.outputs.shape[1]

    @property
    def missing(self) -> NDArray[np.bool_]:
        """True where an output sample is missing, shape (n, n_y)."""
        return np.isnan(self.outputs)

    @property
    def duration(self) -> float:
        """Time from the first to the last sample [time unit]."""
        return float(self.time[-1] - self.time[0])

    @property
    def is_regular(self) -> bool:
        """True where all steps are equal up to rounding (1e-9 of the step, or of the stamps)."""
        steps = np.diff(self.time)
        if len(steps) < 2:
            return True
        # Each stamp is rounded to half a unit in the last place, and so is their difference.
        rounding = 4 * np.spacing(np.abs(self.time).max())
        median = np.median(steps)
        return bool(np.abs(steps - median).max() <= max(1e-9 * median, rounding))

    @property
    def sampling_time(self) -> float:
        """Median step between samples [time unit].

        Raises:
            ValueError: the record has one sample only.
        """
        if len(self) < 2:
            raise invalid("record", expected="two samples or more (a step)", got="one sample")
        if self.is_regular:  # the mean of equal steps carries less rounding than one of them
            return self.duration / (len(self) - 1)
        return float(np.median(np.diff(self.time)))

    @property
    def timestamps(self) -> pd.DatetimeIndex | None:
        """Time stamps (n,) in the zone they came in, or None where time is a plain number.

        Rounded to the nanosecond; to the microsecond beyond 100 days from `start`, where float64
        seconds resolve no more.
        """
        if self.start is None:
            return None
        tick = 1 if np.abs(self.time).max() < 100 * 86400 else 1000
        elapsed = np.rint(self.time * (1e9 / tick)).astype(np.int64) * tick
        stamps = pd.to_datetime(nanoseconds(self.start) + elapsed, unit="ns", utc=True)
        return stamps.tz_convert(self.start.tz)

    @cached_property
    def fingerprint(self) -> str:
        """Hex SHA-256 of time, inputs, outputs and their names: equal for the same data."""
        digest = hashlib.sha256()
        digest.update(repr((self.time_unit, self.input_names, self.output_names)).encode())
        for array in (self.time, self.inputs, self.outputs):
            # One bit pattern for each value: -0.0 + 0.0 is 0.0, and NaN has many patterns.
            plain = np.where(np.isnan(array), np.nan, array + 0.0).astype("<f8")
            digest.update(repr(plain.shape).encode() + plain.tobytes())
        return digest.hexdigest()

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, Record):
            return NotImplemented
        same = ("input_names", "output_names", "input_units", "output_units", "time_unit")
        return (
            all(getattr(self, field) == getattr(other, field) for field in (*same, "start"))
            and dict(self.extra_units) == dict(other.extra_units)
            and all(
                np.array_equal(a, b, equal_nan=True)
                for a, b in (
                    (self.time, other.time),
                    (self.inputs, other.inputs),
                    (self.outputs, other.outputs),
                    *((self.extra[k], other.extra[k]) for k in self.extra),
                )
            )
        )

    def __hash__(self) -> int:
        return hash(self.fingerprint)

    def __reduce__(self) -> tuple[Any, ...]:
        # A mapping proxy cannot be pickled, and parallel fits send records to other processes.
        fields = {f.name: getattr(self, f.name) for f in dataclasses.fields(self)}
        return _rebuild, (
            fields | {"extra": dict(self.extra), "extra_units": {**self.extra_units}},
        )

    def __getitem__(self, key: slice) -> Record:
        """Part of the record with the same clock; slices with a positive step only."""
        if not isinstance(key, slice):
            raise invalid(
                "record[...]",
                expected="a slice such as record[100:400] or record[::2]",
                got=type(key).__name__,
                advice="For one sample write record[k:k + 1]; to leave samples out set their "
                "outputs to NaN (record.with_outputs), or slice into several records.",
            )
        try:
            step = key.indices(len(self))[2]
        except (TypeError, ValueError) as error:
            raise invalid(
                "record[...]", expected="sample numbers in the slice", got=str(key),
                advice="record.split takes time stamps; np.searchsorted(record.time, t) finds "
                "the sample number of a time t.",
            ) from error  # fmt: skip
        if step < 0:
            raise invalid("record[...]", expected="a positive step", got=f"step {step}")
        if not len(self.time[key]):
            raise invalid(
                "record[...]", expected="a slice that holds a sample", got=f"{key}, empty",
                advice=f"The record has {len(self)} samples.",
            )  # fmt: skip
        return dataclasses.replace(
            self,
            time=self.time[key],
            inputs=self.inputs[key],
            outputs=self.outputs[key],
            extra={name: values[key] for name, values in self.extra.items()},
        )

    def split(self, at: int | str | pd.Timestamp | datetime.datetime) -> tuple[Record, Record]:
        """Split in two; the second part goes on on the same clock.

        Args:
            at: number of samples of the first part, or, where the record has time stamps, the
                instant (with time zone) at which the second part begins.

        Returns:
            The part before `at` and the part from `at` on.

        Raises:
            ValueError: a part would be empty, or `at` is a number of seconds or has no zone.
        """
        if isinstance(at, (str, datetime.datetime)):
            if self.timestamps is None:
                raise invalid("at", expected="a sample index (no time stamps here)", got=f"{at!r}")
            k = int(self.timestamps.searchsorted(as_instant("at", at)))
        elif isinstance(at, (int, np.integer)) and not isinstance(at, bool):
            k = int(at)
        else:
            raise invalid(
                "at", expected="the number of samples of the first part, an int", got=repr(at),
                advice="For a time write record.split(int(np.searchsorted(record.time, t))).",
            )  # fmt: skip
        if not 0 < k < len(self):
            raise invalid(
                "at", expected=f"a split with samples on both sides, 1 to {len(self) - 1}",
                got=f"{at!r}, which leaves {max(k, 0)} samples before it",
            )  # fmt: skip
        return self[:k], self[k:]

    def resample(self, *args: Any, **kwargs: Any) -> NoReturn:
        """Refuse: how to resample depends on the signals (see the message).

        Raises:
            ValueError: always.
        """
        raise invalid(
            "resample",
            expected="the times as they were recorded",
            got="a request for other times",
            advice="Resampling is not guessed: a coarser grid aliases what is faster, a finer one "
            "invents inputs between their samples. Irregular times can be used as they are. "
            "Otherwise filter and resample yourself (scipy.signal.decimate, or pandas resample) "
            "and build a new Record.",
        )

    def select(self, inputs: Names = None, outputs: Names = None) -> Record:
        """Choose and order the channels by name; those not chosen become extra channels.

        Args:
            inputs: names of the inputs (inputs, outputs or extra channels of this record); None
                keeps the inputs as they are.
            outputs: names of the outputs; None keeps them.

        Raises:
            ValueError: an unknown name, or one chosen twice.
        """
        chosen_u = self.input_names if inputs is None else as_names(inputs)
        chosen_y = self.output_names if outputs is None else as_names(outputs)
        values, units = columns_of(self)
        for name in (*chosen_u, *chosen_y):
            if name not in values:
                raise invalid("select", expected=f"names among {list(values)}", got=repr(name))
        check_unique((*chosen_u, *chosen_y))
        rest = [name for name in values if name not in (*chosen_u, *chosen_y)]
        empty = np.empty((len(self), 0))
        return dataclasses.replace(
            self,
            inputs=np.column_stack([empty, *(values[name] for name in chosen_u)]),
            outputs=np.column_stack([empty, *(values[name] for name in chosen_y)]),
            input_names=chosen_u,
            output_names=chosen_y,
            input_units=tuple(units[name] for name in chosen_u),
            output_units=tuple(units[name] for name in chosen_y),
            extra={name: values[name] for name in rest},
            extra_units={name: units[name] for name in rest},
        )

    def with_extra_as_input(self, name: str) -> Record:
        """Return the same record with the extra channel `name` as its last input.

        Raises:
            ValueError: there is no such extra channel, or it has gaps.
        """
        if name not in self.extra:
            raise invalid("name", expected=f"an extra channel {list(self.extra)}", got=repr(name))
        return self.select(inputs=(*self.input_names, name))

    def with_outputs(self, outputs: Any, names: Names = None, units: Names = None) -> Record:
        """Return the same record with other outputs (n, n_y); NaN marks missing samples.

        Args:
            outputs: the new outputs (n, n_y) or (n,).
            names: their names; None keeps the names and units, if the number is the same.
            units: their units; None keeps the units, if the number is the same.
        """
        new = as_channels("outputs", outputs, len(self))
        same_number = new.shape[1] == self.n_outputs
        if names is None and not same_number:
            raise invalid(
                "outputs", expected=f"{self.n_outputs} columns, as before", got=f"{new.shape[1]}",
                advice="Give names=[...] where the outputs are others.",
            )  # fmt: skip
        return dataclasses.replace(
            self,
            outputs=new,
            output_names=self.output_names if names is None else as_names(names),
            output_units=(self.output_units if same_number else ("",) * new.shape[1])
            if units is None
            else as_names(units),
        )

    def tensors(self) -> RecordTensors:
        """Copy time, inputs and outputs to torch.float64 tensors."""
        return RecordTensors(*map(torch.tensor, (self.time, self.inputs, self.outputs)))

    def to_frame(self) -> pd.DataFrame:
        """DataFrame of all channels, indexed by time stamps or by time.

        Units, clock and name go to `frame.attrs`, where `from_frame` finds them again.
        """
        return to_frame(self)

    def to_xarray(self) -> xr.Dataset:
        """Dataset of all channels over the dimension "time" [time unit]; units are attributes.

        A record with time stamps has them (UTC) in the coordinate "timestamp", and the instant
        and zone of time zero as attributes "start" and "time_zone" of "time".
        """
        return to_xarray(self)

    def __repr__(self) -> str:
        step = f"{self.sampling_time:.6g}" if len(self) > 1 else "none"
        return (
            f"Record({self.name!r}, n={len(self)}, step={step} {self.time_unit}"
            f"{'' if self.is_regular else ' (median, irregular)'}, "
            f"inputs={list(self.input_names)}, outputs={list(self.output_names)}, "
            f"missing={int(self.missing.sum())}, extra={list(self.extra)})"
        )

    def summary(self) -> str:
        """Table of the channels: role, unit, smallest, mean and largest value, gaps."""
        return summary(self)


def as_records(records: Record | Sequence[Record]) -> tuple[Record, ...]:
    """One record or several experiments on the same system, as a tuple of records.

    Args:
        records: a Record, or a sequence of Records.

    Returns:
        The records, at least one.

    Raises:
        ValueError: nothing given, something that is no Record, or records that differ in their
            channel names, units or time unit.
    """
    several = (records,) if isinstance(records, Record) else records
    if isinstance(several, (str, bytes, Mapping)) or not isinstance(several, Sequence):
        raise invalid(
            "records", expected="a Record or a sequence of Records", got=type(records).__name__,
            advice="Build one with Record(time=..., inputs=..., outputs=...).",
        )  # fmt: skip
    if not several:
        raise invalid("records", expected="one Record or more", got="an empty sequence")
    for i, record in enumerate(several):
        if not isinstance(record, Record):
            raise invalid(f"records[{i}]", expected="a Record", got=type(record).__name__)
        for field in ("input_names", "output_names", "input_units", "output_units", "time_unit"):
            first, this = getattr(several[0], field), getattr(record, field)
            if first != this:
                raise invalid(
                    f"records[{i}].{field}", expected=f"{first}, as in records[0]", got=f"{this}",
                    advice="Experiments fitted together need the same channels in the same units "
                    "(Record.select orders them).",
                )  # fmt: skip
    return tuple(several)


def _rebuild(fields: dict[str, Any]) -> Record:
    return Record(**fields)
