"""Scaling: the step, offsets and scales in which models state their priors."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from pyro_dynogp.data.channel_statistics import by_smoothness, mean_and_sd, permutation
from pyro_dynogp.data.checks import Array, real_numbers
from pyro_dynogp.data.record import Record
from pyro_dynogp.data.records import as_records
from pyro_dynogp.support.errors import instance, invalid, verify_fields, whole
from pyro_dynogp.support.shown import shown
from pyro_dynogp.support.tensors import as_tensor

_ARRAYS = ("input_offset", "input_scale", "output_offset", "output_scale")
_NAMES = ("input_names", "output_names", "input_units", "output_units")
_ORDERS = ("input_order", "output_order")


@shown
@dataclass(frozen=True, eq=False, kw_only=True)
class Scaling:
    """Clock and signal scales of the training data, learnt from them alone.

    Scaled signals are (u - input_offset) / input_scale and (y - output_offset) / output_scale.

    Attributes:
        time_step: median step over all records [time_unit].
        duration: time from first to last sample of the longest record [time_unit].
        input_offset: mean of each input over all samples, (n_u,) float64 [input_units].
        input_scale: standard deviation of each input, (n_u,) float64 [input_units].
        output_offset: mean of each output where it is not missing, (n_y,) float64 [output_units].
        output_scale: standard deviation of each output, (n_y,) float64 [output_units].
        input_names: names of the inputs.
        output_names: names of the outputs.
        input_units: units of the inputs.
        output_units: units of the outputs.
        time_unit: unit of time.
        reference_output: place of the smoothest output, by which the phases of modes are told: the
            same one in whatever order and units the outputs are given.
        input_order: places of the inputs from the smoothest to the roughest, the same channels in
            whatever order and units they are given; what a function of several channels does
            channel by channel goes by it. By default as they are given.
        output_order: places of the outputs, likewise.

    Examples:
        >>> record = dgp.datasets.load("gas_furnace").train[:60]
        >>> scaling = dgp.Scaling.from_records(record)
        >>> scaled = scaling.apply(record)
        >>> round(float(scaled.outputs.std()), 9)
        1.0
        >>> bool(np.allclose(scaling.invert(scaled.outputs), record.outputs))
        True
    """

    time_step: float
    duration: float
    input_offset: Array
    input_scale: Array
    output_offset: Array
    output_scale: Array
    input_names: tuple[str, ...]
    output_names: tuple[str, ...]
    input_units: tuple[str, ...]
    output_units: tuple[str, ...]
    time_unit: str
    reference_output: int = 0
    input_order: tuple[int, ...] = ()
    output_order: tuple[int, ...] = ()

    def __post_init__(self) -> None:
        for field in _ARRAYS:
            array = np.array(getattr(self, field), dtype=np.float64)
            array.setflags(write=False)
            object.__setattr__(self, field, array)
        outputs = len(self.output_scale)
        whole(0, max(outputs - 1, 0)).check("reference_output", self.reference_output)
        for field, count in zip(_ORDERS, (len(self.input_scale), outputs), strict=True):
            object.__setattr__(self, field, permutation(field, getattr(self, field), count))

    @classmethod
    def from_records(cls, records: Record | Sequence[Record]) -> Scaling:
        """Learn the scaling from the training record, or from several, pooled.

        Args:
            records: the training data; never give test data here.

        Returns:
            The scaling. Standard deviations are those of the samples (divided by their number).

        Raises:
            ValueError: no outputs, an output without a sample, a constant input or output, or no
                record with two samples.
        """
        several = as_records(records)
        first = several[0]
        steps = np.concatenate([np.diff(record.time) for record in several])
        if not len(steps):
            raise invalid("records", expected="a record of two samples or more", got="one sample")
        if not first.n_outputs:
            raise invalid(
                "records", expected="an output to learn from", got="records without outputs"
            )
        u_offset, u_scale = mean_and_sd("input", [r.inputs for r in several], first.input_names)
        y_offset, y_scale = mean_and_sd("output", [r.outputs for r in several], first.output_names)
        # The mean step of a regular record carries less rounding than the median of differences.
        regular = len(several) == 1 and first.is_regular
        inputs = by_smoothness([(r.inputs - u_offset) / u_scale for r in several])
        outputs = by_smoothness([(r.outputs - y_offset) / y_scale for r in several])
        return cls(
            time_step=first.sampling_time if regular else float(np.median(steps)),
            duration=max(record.duration for record in several),
            input_offset=u_offset,
            input_scale=u_scale,
            output_offset=y_offset,
            output_scale=y_scale,
            time_unit=first.time_unit,
            reference_output=outputs[0],
            input_order=inputs,
            output_order=outputs,
            **{field: getattr(first, field) for field in _NAMES},
        )

    def with_scales_of(self, other: Scaling) -> Scaling:
        """Clock and scales of another scaling, and these for channels that it does not have."""
        changes: dict[str, Any] = {"time_step": other.time_step, "duration": other.duration}
        for role in ("input", "output"):
            names, known = (getattr(one, f"{role}_names") for one in (self, other))
            for field in (f"{role}_offset", f"{role}_scale"):
                theirs = dict(zip(known, getattr(other, field), strict=True))
                own = zip(names, getattr(self, field), strict=True)
                changes[field] = np.array([theirs.get(name, x) for name, x in own])
            if names == known:
                changes[f"{role}_order"] = getattr(other, f"{role}_order")
        if self.output_names == other.output_names:
            changes["reference_output"] = other.reference_output
        return dataclasses.replace(self, **changes)

    def check(self, record: Record, *, outputs: bool = True) -> None:
        """Refuse a record whose channels or units are not those of the training data.

        Args:
            record: the record that a fitted model is to be used with.
            outputs: False where the inputs alone are used (a simulation).

        Raises:
            ValueError: other names, another number of channels, other units.
        """
        roles = ("input", "output") if outputs else ("input",)
        for role in roles:
            expected, got = getattr(self, f"{role}_names"), getattr(record, f"{role}_names")
            if expected != got:
                raise invalid(
                    f"record.{role}_names",
                    expected=f"{list(expected)}, as in the training record",
                    got=f"{list(got)}",
                    advice="Record.select chooses and orders the channels.",
                )
            expected, got = getattr(self, f"{role}_units"), getattr(record, f"{role}_units")
            for name, trained, given in zip(
                getattr(self, f"{role}_names"), expected, got, strict=True
            ):
                self._check_unit(f"unit of {role} {name!r}", trained, given)
        self._check_unit("record.time_unit", self.time_unit, record.time_unit)

    @staticmethod
    def _check_unit(argument: str, trained: str, given: str) -> None:
        if trained != given:
            raise invalid(
                argument,
                expected=f"{trained!r}, as in the training record",
                got=f"{given!r}",
                advice="Convert the values of the record and state their unit: units mismatch.",
            )

    def apply(self, record: Record) -> Record:
        """The record with scaled inputs and outputs, without units; time and extra as they are.

        Args:
            record: with the channels and units of the training record; its outputs may be none.

        Raises:
            ValueError: other channels or units, see `check`.
        """
        instance("record", record, Record)
        measured = record.n_outputs > 0
        self.check(record, outputs=measured)
        changes: dict[str, Any] = {
            "inputs": (record.inputs - self.input_offset) / self.input_scale,
            "input_units": [""] * record.n_inputs,
        }
        if measured:
            changes["outputs"] = (record.outputs - self.output_offset) / self.output_scale
            changes["output_units"] = [""] * record.n_outputs
        return dataclasses.replace(record, **changes)

    def invert(self, outputs: Any) -> Any:
        """Scaled outputs in their units.

        Args:
            outputs: numpy array or tensor (*b, n, n_y), or (*b, n) where there is one output.

        Raises:
            ValueError: another number of outputs.
        """
        if outputs is None:
            raise invalid("outputs", expected="scaled outputs", got="None")
        if not isinstance(outputs, torch.Tensor):
            outputs = real_numbers("outputs", outputs)
        if self.output_scale.shape == (1,):
            return outputs * float(self.output_scale[0]) + float(self.output_offset[0])
        count = len(self.output_scale)
        if outputs.ndim < 2 or outputs.shape[-1] != count:
            got = f"shape {tuple(outputs.shape)}"
            raise invalid("outputs", expected=f"shape (..., n, {count})", got=got)
        scale, offset = self.output_scale, self.output_offset
        if isinstance(outputs, torch.Tensor):
            return outputs * as_tensor(scale) + as_tensor(offset)
        return outputs * scale + offset

    def to_dict(self) -> dict[str, Any]:
        """Plain dict for JSON; floats as hexadecimal text, so that they come back to the bit."""
        plain: dict[str, Any] = {}
        for field in dataclasses.fields(self):
            value = getattr(self, field.name)
            if field.name in _ARRAYS:
                plain[field.name] = [float(x).hex() for x in value]
            elif isinstance(value, float):
                plain[field.name] = value.hex()
            else:
                plain[field.name] = list(value) if isinstance(value, tuple) else value
        return plain

    @classmethod
    def from_dict(cls, plain: Mapping[str, Any]) -> Scaling:
        """Scaling from what `to_dict` gave.

        Files of before have channels in the order in which they were given, the first output as the
        reference.

        Raises:
            ValueError: missing or unknown entries, or text that is no hexadecimal number.
        """
        fields = {field.name for field in dataclasses.fields(cls)}
        if not fields - {"reference_output", *_ORDERS} <= set(plain) <= fields:
            raise invalid("plain", expected=f"entries {sorted(fields)}", got=f"{sorted(plain)}")
        values = dict(plain)
        try:
            for field in _ARRAYS:
                values[field] = np.array([float.fromhex(x) for x in plain[field]])
            for field in ("time_step", "duration"):
                values[field] = float.fromhex(plain[field])
        except (TypeError, ValueError) as error:
            raise invalid("plain", expected="float.hex texts", got=str(error)) from error
        values |= {field: tuple(plain[field]) for field in _NAMES}
        values |= {field: tuple(plain.get(field, ())) for field in _ORDERS}
        return cls(**values)

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, Scaling):
            return NotImplemented
        return self.to_dict() == other.to_dict()

    def __hash__(self) -> int:
        return hash((self.time_step, self.duration, self.input_names, self.output_names))


# Samples below which a record is short: it may show a part of what the system does.
SHORT = 100.0


@dataclass(frozen=True)
class TimeScale:
    """What the record says about time constants.

    Attributes:
        step: median sampling step [s].
        duration: length of the record [s].

    Examples:
        >>> low, high = dgp.TimeScale(step=0.1, duration=100.0).rate_bounds
        >>> low < high
        True
    """

    step: float
    duration: float

    def __post_init__(self) -> None:
        verify_fields(self)

    @classmethod
    def of(cls, scaling: Scaling) -> TimeScale:
        """Step and duration of the training record(s)."""
        return cls(float(scaling.time_step), float(scaling.duration))

    @property
    def rate_bounds(self) -> tuple[float, float]:
        """Logarithms of the slowest and fastest rates [1/s] that the record can show."""
        return math.log(1.0 / self.duration), math.log(math.pi / self.step)

    @property
    def brevity(self) -> float:
        """How much wider a short record has priors of slow poles, gains and offset; 1 for others.

        With few samples a system may well be slower than the record is long, and its outputs go far
        beyond those measured. `SHORT` over the number of steps, and at least one.
        """
        return max(1.0, SHORT * self.step / self.duration)

    @property
    def typical_rate(self) -> float:
        """Geometric mean [1/s] of the slowest and fastest rates."""
        return math.exp(0.5 * sum(self.rate_bounds))
