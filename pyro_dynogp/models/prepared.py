"""A record as a model sees it: made once where a run begins, then handed down."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import torch
from torch import Tensor

from pyro_dynogp.data.record import Record
from pyro_dynogp.data.scaling import Scaling
from pyro_dynogp.lti.grid import TimeGrid, time_grid
from pyro_dynogp.support.errors import invalid
from pyro_dynogp.support.shown import shown
from pyro_dynogp.support.tensors import as_tensor


class Surroundings(NamedTuple):
    """A longer stretch that a record is part of: times (m,), inputs (m, n_u), its first sample."""

    time: Tensor
    inputs: Tensor
    first: int


@shown
@dataclass(repr=False, frozen=True, eq=False)
class PreparedRecord:
    """A checked record with the channels of a model, its time grid, and its scaled signals.

    `Model.prepare` makes one. What takes it does not check the record again.

    Attributes:
        record: with the model's channels as inputs.
        scaling: of the training record.
        grid: its times.
        inputs: u (n, n_u) float64 [input].
        scaled_inputs: the same in standard deviations of the training record.
        observations: y (n,) of one output, (n, n_y) of several [output]; NaN where missing.
        around: inputs before and after it, where they are known: late ones come from there.
        delayed: whether an input acts after a dead time: nothing is known of the state before.
    """

    record: Record
    scaling: Scaling
    grid: TimeGrid
    inputs: Tensor
    scaled_inputs: Tensor
    observations: Tensor
    around: Surroundings | None = None
    delayed: bool = False

    @classmethod
    def of(cls, record: Record, scaling: Scaling, *, delayed: bool = False) -> PreparedRecord:
        """From a record that is known to fit the model, its channels made."""
        signals, grid = record.tensors(), time_grid(record.time)
        scaled = scaled_inputs(signals.inputs, scaling)
        measured = signals.observations
        return cls(record, scaling, grid, signals.inputs, scaled, measured, delayed=delayed)

    def __len__(self) -> int:
        return len(self.record)

    @property
    def surroundings(self) -> Surroundings:
        """What is known around the record; the record itself where that is all."""
        return self.around or Surroundings(self.grid.time, self.inputs, 0)

    @property
    def begun(self) -> PreparedRecord:
        """From its first measured output on, with all inputs around it.

        As the density of a model with dead times has it: what acted before the record is not in it,
        and nothing is known of the state until all that has arrived.
        """
        first = self._first_measured
        if not first:
            return self
        time, inputs, before = self.surroundings
        return replace(
            self._part(slice(first, None)), around=Surroundings(time, inputs, before + first)
        )

    @property
    def arrived(self) -> int:
        """Samples before the first measured output where an input is delayed; else none."""
        return self._first_measured if self.delayed and self.has_outputs else 0

    @property
    def _first_measured(self) -> int:
        measured = ~torch.isnan(self.observations).reshape(len(self), -1).all(-1)
        return int(measured.to(torch.int8).argmax())

    def head(self, count: int) -> PreparedRecord:
        """Its first samples."""
        return self._part(slice(0, count))

    def _part(self, part: slice) -> PreparedRecord:
        """Some samples in a row, in the same units, with what is known around the whole."""
        return PreparedRecord(
            self.record[part],
            self.scaling,
            time_grid(self.grid.time[part]),
            self.inputs[part],
            self.scaled_inputs[part],
            self.observations[part],
            self.around,
        )

    @property
    def has_outputs(self) -> bool:
        """Whether there are outputs at all."""
        return self.record.n_outputs > 0

    @property
    def scaled_outputs(self) -> Tensor:
        """Outputs (n, n_y) in standard deviations of the training record."""
        y = self.observations if self.record.n_outputs > 1 else self.observations[:, None]
        return (y - as_tensor(self.scaling.output_offset)) / as_tensor(self.scaling.output_scale)


# What a model is called with.
Records = Record | Sequence[Record] | Sequence[PreparedRecord]


def scaled_inputs(inputs: Tensor, scaling: Scaling) -> Tensor:
    """Inputs (*b, n, n_u) in standard deviations of the training record."""
    if not inputs.shape[-1]:
        return inputs
    return (inputs - as_tensor(scaling.input_offset)) / as_tensor(scaling.input_scale)


def with_outputs(
    records: Sequence[PreparedRecord], argument: str = "record"
) -> Sequence[PreparedRecord]:
    """Records that all have outputs.

    Raises:
        ValueError: where one has none: nothing was measured there that could be compared.
    """
    if not all(record.has_outputs for record in records):
        raise invalid(argument, expected="measured outputs", got="a record without outputs")
    return records


def as_measured(records: Records) -> tuple[Record, ...]:
    """The records behind what a model is called with."""
    several = (records,) if isinstance(records, Record) else records
    return tuple(
        record.record if isinstance(record, PreparedRecord) else record for record in several
    )
