"""Options of the readers, and what they have to be."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any, Literal, TypedDict

from pyro_dynogp.data.checks import Names
from pyro_dynogp.support.errors import SWITCH, Rule


class ColumnOptions(TypedDict, total=False):
    """Options of every reader; `read_frame` says what they mean."""

    output: Names
    time: str | None
    sampling_time: float | None
    timezone: str | None
    time_unit: str | None
    extra: Literal["all"] | Sequence[str] | None
    input_units: Names
    output_units: Names
    extra_units: Mapping[str, str] | None
    name: str | None


class TextOptions(ColumnOptions, total=False):
    """Options of `read_csv`."""

    header: bool | None
    names: Sequence[str] | None
    delimiter: str | None
    decimal: str | None
    encoding: str


def _named(value: object) -> list[str] | None:
    """One name or several as a list; None for anything else."""
    if isinstance(value, str):
        return [value]
    if isinstance(value, bytes | Mapping) or not isinstance(value, Iterable):
        return None
    found = list(value)
    return found if all(isinstance(name, str) for name in found) else None


def _units(value: object) -> dict[str, str] | None:
    """Units by name; None for anything else."""
    if not isinstance(value, Mapping):
        return None
    texts = all(isinstance(text, str) for pair in value.items() for text in pair)
    return dict(value) if texts else None


_TEXT = Rule("text", lambda value: value if isinstance(value, str) else None)
_NAMES = Rule("a name, or a list of names", _named)
# What options of the readers have to be; None is none given.
_RULES = {
    **dict.fromkeys(("time", "timezone", "time_unit", "name", "delimiter", "encoding"), _TEXT),
    **dict.fromkeys(
        ("inputs", "outputs", "output", "names", "input_units", "output_units"), _NAMES
    ),
    "extra": Rule(
        '"all", a list of names, or None',
        lambda value: "all" if isinstance(value, str) and value == "all" else _named(value),
    ),
    "extra_units": Rule("units by name", _units),
    "header": SWITCH,
}


def checked_options(
    options: Any, known: type, inputs: Names, outputs: Names
) -> tuple[list[str], list[str] | None]:
    """Check what a reader is given, options in place, before any work; inputs and outputs as lists.

    Raises:
        TypeError: on an option that the reader does not have, as Python does.
        ValueError: on one that is not what it has to be.
    """
    for option in options:
        if option not in known.__annotations__:
            raise TypeError(
                f"{option!r} is no option of this reader, which knows {list(known.__annotations__)}"
            )
    for option, value in options.items():
        if option in _RULES and value is not None:
            options[option] = _RULES[option].check(option, value)
    found = [
        None if value is None else _RULES[argument].check(argument, value)
        for argument, value in (("inputs", inputs), ("outputs", outputs))
    ]
    return found[0] or [], found[1]
