"""One record or several experiments on the same system."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from pyro_dynogp.data.record import Record
from pyro_dynogp.support.errors import invalid


def one_record(record: object, advice: str, argument: str = "record") -> Record:
    """A single record.

    Raises:
        ValueError: where it is anything else; `advice` says what to do with several.
    """
    if not isinstance(record, Record):
        got = type(record).__name__
        raise invalid(argument, expected="one Record", got=got, advice=advice)
    return record


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
