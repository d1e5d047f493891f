"""Records that a prediction is made from: checked, prepared, one after the other."""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING

import numpy as np

from pyro_dynogp.data.record import Record
from pyro_dynogp.support.errors import invalid

if TYPE_CHECKING:
    from pyro_dynogp.inference.fitted import Fitted


def one_record(fit: Fitted, record: Record) -> Record:
    """A record prepared with the channels of the model.

    Raises:
        ValueError: where it is no single record, or does not fit the model.
    """
    if not isinstance(record, Record):
        raise invalid(
            "record",
            expected="one Record",
            got=type(record).__name__,
            advice="Predict several records one after the other.",
        )
    return fit.model.check(record)[0]


def following(fit: Fitted, past: Record, future: Record) -> tuple[Record, Record]:
    """Two records prepared together: a channel may reach back into the first, or ahead.

    Inputs of the future are given; a clock that is late takes those of the past from there.

    Raises:
        ValueError: as `one_record` and `gap_between`.
    """
    gap = gap_between(past, future)
    alone = one_record(fit, past), one_record(fit, future)
    if not fit.model.channels or set(future.input_names) != set(past.input_names):
        return alone
    if alone[0].input_names == past.input_names:  # prepared before they were split
        return alone
    first, second = (
        one.with_outputs(np.zeros((len(one), 0)), names=(), units=()) for one in (past, future)
    )
    both = joined(first, second, future.time[0] - past.time[-1] - gap)
    inputs = np.split(fit.model.check(both)[0].inputs, [len(past)])
    before, after = (
        dataclasses.replace(one, inputs=u) for one, u in zip(alone, inputs, strict=True)
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
