"""Record: one experiment as immutable arrays with their names, units and clock."""

from __future__ import annotations

import dataclasses
import datetime
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property, partial
from typing import Any, NoReturn

import numpy as np
import pandas as pd
import torch
import xarray as xr
from numpy.typing import NDArray

from pyro_dynogp.data import clock, foreign, writers
from pyro_dynogp.data.checks import (
    Array,
    Names,
    as_channels,
    as_names,
    check_unique,
    fingerprint_of,
)
from pyro_dynogp.data.fields import checked
from pyro_dynogp.data.sources import Sources
from pyro_dynogp.data.writers import RecordTensors
from pyro_dynogp.support.errors import invalid
from pyro_dynogp.support.shown import preformatted


@dataclass(frozen=True, init=False, eq=False, repr=False)
class Record(Sources):
    """One experiment: n samples of inputs and outputs on one clock, immutable.

    Args:
        time: (n,) strictly increasing; real numbers in `time_unit`, or time stamps with a time
            zone (pandas DatetimeIndex or Series, a list of datetimes). Steps may differ.
        inputs: u (n, n_u) [input_units], or (n,) for one; finite. None: no inputs.
        outputs: y (n, n_y) [output_units], or (n,) for one output; NaN marks a missing sample.
            None: no outputs.
        input_names, output_names: by default "u" and "y", or "u1", "u2", ... and "y1", "y2", ...
        input_units, output_units: units as text; by default "" (not stated).
        time_unit: unit of `time`; always "s" with time stamps.
        extra, extra_units: name -> (n,) channel that no model uses (NaN: missing), and its unit.
        name: label of the experiment (not part of equality).
        start: the instant (with time zone) at which `time` is zero. By default the first stamp
            where `time` holds time stamps, else None. Parts of a record keep it.

    Attributes:
        time: (n,) float64; seconds since `start` where there is one.
        inputs, outputs: (n, n_u) and (n, n_y) float64, read-only.
        extra: read-only mapping of read-only (n,) float64 arrays; slices and splits keep it.

    Raises:
        ValueError: wrong shape, length, name or unit; a value that is no number; NaN or infinite
            inputs; infinite outputs; time that does not increase; stamps without a time zone.

    Examples:
        >>> record = dgp.Record([0.0, 0.1, 0.2], inputs=[1, 0, 1], outputs=[0.0, 0.4, np.nan])
        >>> int(record.missing.sum()), len(record[:2])
        (1, 2)
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
        stored = checked({
            "time": time, "inputs": inputs, "outputs": outputs,
            "input_names": input_names, "output_names": output_names,
            "input_units": input_units, "output_units": output_units, "time_unit": time_unit,
            "extra": extra or {}, "extra_units": extra_units or {}, "name": name, "start": start,
        })  # fmt: skip
        for field, content in stored.items():
            object.__setattr__(self, field, content)

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
    def _channels(self) -> writers.Channels:
        names = (*self.input_names, *self.output_names)
        values = dict(zip(names, (*self.inputs.T, *self.outputs.T), strict=True))
        units = dict(zip(names, (*self.input_units, *self.output_units), strict=True))
        values, units = values | dict(self.extra), units | dict(self.extra_units)
        return writers.Channels(values, units, self.time, self.time_unit, self.start, self.name)

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
        return clock.is_regular(self.time)

    @property
    def sampling_time(self) -> float:
        """Median step between samples [time unit].

        Raises:
            ValueError: the record has one sample only.
        """
        return clock.sampling_time(self.time)

    @property
    def timestamps(self) -> pd.DatetimeIndex | None:
        """Time stamps (n,) in the zone they came in, or None where time is a plain number.

        Rounded to the nanosecond; to the microsecond beyond 100 days from `start`, where float64
        seconds resolve no more.
        """
        return None if self.start is None else clock.stamps_of(self.time, self.start)

    @cached_property
    def fingerprint(self) -> str:
        """Hex SHA-256 of time, inputs, outputs and their names: equal for the same data."""
        text = repr((self.time_unit, self.input_names, self.output_names))
        return fingerprint_of(text, (self.time, self.inputs, self.outputs))

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, Record):
            return NotImplemented
        same = ("input_names", "output_names", "input_units", "output_units", "time_unit", "start")
        return (
            all(getattr(self, field) == getattr(other, field) for field in same)
            and dict(self.extra_units) == dict(other.extra_units)
            and np.array_equal(self.time, other.time)
            and np.array_equal(self.inputs, other.inputs)
            and np.array_equal(self.outputs, other.outputs, equal_nan=True)
            and all(
                np.array_equal(v, other.extra[k], equal_nan=True) for k, v in self.extra.items()
            )
        )

    def __hash__(self) -> int:
        return hash(self.fingerprint)

    def __reduce__(self) -> tuple[Any, ...]:
        # A mapping proxy cannot be pickled, and parallel fits send records to other processes.
        fields = {f.name: getattr(self, f.name) for f in dataclasses.fields(self)}
        fields |= {"extra": dict(self.extra), "extra_units": dict(self.extra_units)}
        return partial(Record, **fields), ()

    def __getitem__(self, key: slice) -> Record:
        """Part of the record with the same clock; slices with a positive step only."""
        clock.check_slice(key, self.time)
        u, y = self.inputs[key], self.outputs[key]
        extra = {name: values[key] for name, values in self.extra.items()}
        return dataclasses.replace(self, time=self.time[key], inputs=u, outputs=y, extra=extra)

    def split(self, at: int | str | pd.Timestamp | datetime.datetime) -> tuple[Record, Record]:
        """Split in two on one clock: the part before `at` and the part from `at` on.

        Args:
            at: number of samples of the first part, or, where the record has time stamps, the
                instant (with time zone) at which the second part begins.

        Raises:
            ValueError: a part would be empty, or `at` is a number of seconds or has no zone.
        """
        k = clock.split_at(at, len(self), self.timestamps)
        return self[:k], self[k:]

    def resample(self, *args: Any, **kwargs: Any) -> NoReturn:
        """Refuse, with a ValueError that says why: how to resample depends on the signals."""
        raise clock.no_resampling()

    def select(self, inputs: Names = None, outputs: Names = None) -> Record:
        """Choose and order the channels by name; those not chosen become extra channels.

        Args:
            inputs: names of the inputs (inputs, outputs or extra channels of this record); None
                keeps the inputs as they are.
            outputs: names of the outputs; None keeps them.

        Raises:
            ValueError: an unknown name, or one chosen twice.
        """
        chosen_u = self.input_names if inputs is None else as_names(inputs, "inputs")
        chosen_y = self.output_names if outputs is None else as_names(outputs, "outputs")
        values, units = self._channels.values, self._channels.units
        for argument, chosen in (("inputs", chosen_u), ("outputs", chosen_y)):
            for name in chosen:
                if not isinstance(name, str) or name not in values:
                    raise invalid(argument, expected=f"names among {list(values)}", got=repr(name))
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
        """The extra channel as last input, as in ``record.with_extra_as_input("rain")``.

        Raises:
            ValueError: there is no such extra channel, or it has gaps.
        """
        if not isinstance(name, str) or name not in self.extra:
            raise invalid("name", expected=f"an extra channel {list(self.extra)}", got=repr(name))
        return self.select(inputs=(*self.input_names, name))

    def with_holidays(
        self, country: str, subdivision: str | None = None, *, name: str = "holiday"
    ) -> Record:
        """The record with an extra channel: 1 on public holidays in its zone, 0 on other days.

        Args: as those of `foreign.holidays_of`; it takes the package holidays.
            name: of the channel.
        """
        column = foreign.holidays_of(self.timestamps, country, subdivision)
        return dataclasses.replace(self, extra={**self.extra, name: column})

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
        if units is None:
            units = self.output_units if same_number else ("",) * new.shape[1]
        names = self.output_names if names is None else as_names(names)
        return dataclasses.replace(
            self, outputs=new, output_names=names, output_units=as_names(units, "units")
        )

    def tensors(self) -> RecordTensors:
        """Copy time, inputs and outputs to torch.float64 tensors."""
        return RecordTensors(*map(torch.tensor, (self.time, self.inputs, self.outputs)))

    def to_frame(self) -> pd.DataFrame:
        """DataFrame of all channels, indexed by time stamps or by time.

        Units, clock and name go to `frame.attrs`, where `from_frame` finds them again.
        """
        return writers.to_frame(self._channels)

    def to_xarray(self) -> xr.Dataset:
        """Dataset of all channels over the dimension "time" [time unit]; units are attributes.

        A record with time stamps has them (UTC) in the coordinate "timestamp", and the instant
        and zone of time zero as attributes "start" and "time_zone" of "time".
        """
        return writers.to_xarray(self._channels)

    def __repr__(self) -> str:
        step = f"{self.sampling_time:.6g}" if len(self) > 1 else "none"
        return (
            f"Record({self.name!r}, n={len(self)}, step={step} {self.time_unit}"
            f"{'' if self.is_regular else ' (median, irregular)'}, "
            f"inputs={list(self.input_names)}, outputs={list(self.output_names)}, "
            f"missing={int(self.missing.sum())}, extra={list(self.extra)})"
        )

    def _repr_html_(self) -> str:
        return preformatted(self.summary())

    def summary(self) -> str:
        """Table of the channels: role, unit, smallest, mean and largest value, gaps."""
        return writers.summary(repr(self), self._channels, self.input_names, self.output_names)
