"""The time between two records."""

from __future__ import annotations

from pyro_dynogp._errors import invalid
from pyro_dynogp.record import Record


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
