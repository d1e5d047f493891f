"""Records that a prediction is made from: checked, prepared, one after the other."""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING

import numpy as np
import torch

from pyro_dynogp.data.record import Record
from pyro_dynogp.data.records import one_record
from pyro_dynogp.models.prepared import PreparedRecord, Surroundings
from pyro_dynogp.support.errors import invalid

if TYPE_CHECKING:
    from pyro_dynogp.inference.fitted import Fitted


def prepared(fit: Fitted, record: Record) -> PreparedRecord:
    """A record as the model sees it.

    Raises:
        ValueError: where it is no single record, or does not fit the model.
    """
    single = one_record(record, "Predict several records one after the other.")
    return fit.model.prepare(single)[0]


def following(
    fit: Fitted, past: Record, future: Record
) -> tuple[PreparedRecord, PreparedRecord, float]:
    """Two records prepared together: a channel may reach back into the first, or ahead.

    Inputs of the future are given; a clock that is late takes those of the past from there.

    Returns:
        Both, and the time between them.

    Raises:
        ValueError: as `prepared` and `gap_between`.
    """
    for argument, record in (("past", past), ("future", future)):
        one_record(record, "Forecast several records one after the other.", argument)
    gap = gap_between(past, future)
    before, after = _together(fit, past, future, gap)
    if not fit.model.late:
        return before, after, gap
    shift = future.time[0] - past.time[-1] - gap
    time = torch.cat([before.grid.time, after.grid.time - shift])
    inputs = torch.cat([before.inputs, after.inputs])
    before = dataclasses.replace(before, around=Surroundings(time, inputs, 0))
    after = dataclasses.replace(after, around=Surroundings(time, inputs, len(before)))
    return before, after, gap


def _together(
    fit: Fitted, past: Record, future: Record, gap: float
) -> tuple[PreparedRecord, PreparedRecord]:
    """Both as the model sees them, channels made from one record of the two where they can be."""
    before, after = prepared(fit, past), prepared(fit, future)
    if not fit.model.channels or set(future.input_names) != set(past.input_names):
        return before, after
    if before.record.input_names == past.input_names:  # prepared before they were split
        return before, after
    first, second = (
        part.with_outputs(np.zeros((len(part), 0)), names=(), units=()) for part in (past, future)
    )
    both = joined(first, second, future.time[0] - past.time[-1] - gap)
    inputs = np.split(fit.model.check(both)[0].inputs, [len(past)])
    before, after = (
        PreparedRecord.of(
            dataclasses.replace(part.record, inputs=u), part.scaling, delayed=part.delayed
        )
        for part, u in zip((before, after), inputs, strict=True)
    )
    return before, after


def joined(first: Record, second: Record, shift: float = 0.0) -> Record:
    """Two records with the same channels, one after the other, on the clock of the first.

    Args:
        first, second: the records. shift: subtracted from the times of the second.
    """
    names = [name for name in second.extra if name in first.extra]
    return dataclasses.replace(
        first,
        time=np.concatenate([first.time, second.time - shift]),
        inputs=np.concatenate([first.inputs, second.inputs]),
        outputs=np.concatenate([first.outputs, second.outputs]),
        extra={name: np.concatenate([first.extra[name], second.extra[name]]) for name in names},
        extra_units={name: second.extra_units[name] for name in names},
    )


def gap_between(past: Record, future: Record) -> float:
    """Time from the last sample of `past` to the first of `future`, in their unit.

    Raises:
        ValueError: where the clocks do not compare, or future does not come after past.
    """
    gap = float(future.time[0] - past.time[-1])
    if past.start != future.start:
        if past.start is None or future.start is None:
            raise invalid(
                "future", expected="the same kind of clock as past", got="stamps and plain times"
            )
        gap += (future.start - past.start).total_seconds()
    if gap <= 0:
        raise invalid(
            "future",
            expected="times after the end of past",
            got=f"a first time {-gap:.6g} s before it",
            advice="Split one record with record.split(k), or give both the same clock.",
        )
    return gap
