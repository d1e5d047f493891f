"""What every reader of columns does: options, the choice of channels, the clock, odd values."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from numbers import Real
from typing import Any, Literal, TypedDict

import numpy as np
import pandas as pd

from pyro_dynogp.data.checks import Array, Names
from pyro_dynogp.data.fields import RecordFields
from pyro_dynogp.support.errors import SWITCH, Rule, invalid, warn

Chosen = tuple[list[str], list[str], list[str]]
# Numbers that loggers write where there is none, without their sign.
SENTINELS = (99.9, 99.99, 999.0, 999.9, 999.25, 999.99, 9999.0, 9999.9, 99999.0, 999999.0,
             9999999.0, 32767.0, 32768.0, 65535.0, 7999.0, 1e20, 1e30, 1e35)  # fmt: skip


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
    **dict.fromkeys(("time", "timezone", "time_unit", "name", "encoding", "time_format"), _TEXT),
    **dict.fromkeys(("output", "names", "input_units", "output_units"), _NAMES),
    "extra": Rule(
        '"all", a list of names, or None',
        lambda value: "all" if isinstance(value, str) and value == "all" else _named(value),
    ),
    "extra_units": Rule("units by name", _units),
    **dict.fromkeys(("header", "units_row"), SWITCH),
}


def check_options(options: Any, known: type) -> None:
    """Refuse an option that a reader does not have; bring the others in place to their kind.

    Raises:
        TypeError: an unknown one, as of Python's own functions. ValueError: of another kind.
    """
    for option in options:
        if option not in known.__annotations__:
            raise TypeError(
                f"{option!r} is no option of this reader, which has {list(known.__annotations__)}"
            )
    for option, value in options.items():
        if option in _RULES and value is not None:
            options[option] = _RULES[option].check(option, value)


def keys_of(argument: str, value: Any) -> list[str]:
    """Names of columns: one, several, or none.

    Raises:
        ValueError: something else.
    """
    return [] if value is None else list(_NAMES.check(argument, value))


def named_column(columns: Mapping[str, Any], argument: str, key: str) -> Any:
    """The column of that name."""
    if key not in columns:
        raise invalid(argument, expected=f"one of the columns {list(columns)}", got=repr(key))
    return columns[key]


def choose(
    columns: Mapping[str, Any], inputs: Names, outputs: Names, options: ColumnOptions,
    time: str | None, numbers: Callable[[str], Array],
    named: Callable[[str, str], Any] | None = None,
) -> tuple[Chosen, dict[str, Array]]:  # fmt: skip
    """Names of the inputs, outputs and extra channels, all of them known, and their values.

    With ``extra="all"`` columns that hold text are left out, and a warning names them.

    Args:
        columns: of the data. inputs, outputs, options: what the user chose. time: its column.
        numbers: the numbers (n,) of a column, or an error that says where it has text.
        named: refuses an unknown column, for an argument; by default `named_column`.
    """
    output, extra = options.get("output"), options.get("extra", "all")
    if outputs is not None and output is not None:
        raise invalid("output", expected="either output or outputs", got="both")
    known = named or partial(named_column, columns)
    sides: list[list[str]] = []
    for argument, value in (
        ("inputs", inputs),
        ("outputs", output if outputs is None else outputs),
    ):
        keys = keys_of(argument, value)
        for key in keys:
            known(argument, key)
        sides.append(keys)
    values = {key: numbers(key) for keys in sides for key in keys}
    if not isinstance(extra, str) or extra != "all":
        rest = keys_of("extra", extra)
        for key in rest:
            known("extra", key)
            values[key] = numbers(key)
        return (sides[0], sides[1], rest), values
    rest, left_out = [], {}
    for key in columns:
        if key not in values and key != time:
            try:
                values[key] = numbers(key)
                rest.append(key)
            except ValueError as error:
                left_out[key] = str(error).partition(", got ")[2].partition(". ")[0]
    if left_out:
        told = "; ".join(f"{key!r} (it has {text})" for key, text in left_out.items())
        warn(f"extra: left out columns that hold text: {told}. extra=[...] names those to keep.")
    return (sides[0], sides[1], rest), values


def note_sentinel(name: str, values: Array) -> None:
    """Warn where a value looks as if it marked missing samples: a known one, far from all others.

    Far is: further from the nearest other value than all others are from each other, twice.
    """
    for end in (np.nanmin, np.nanmax):
        if not len(values) or np.isnan(values).all():
            return
        odd = float(end(values))
        others = values[np.isfinite(values) & (values != odd)]
        if abs(odd) not in SENTINELS or len(others) < 2:
            continue
        if np.abs(others - odd).min() > 2.0 * (others.max() - others.min()):
            count = int((values == odd).sum())
            warn(
                f"column {name!r} has {odd:g} {count} time{'s' * (count != 1)}, far from all other "
                f"values. If it marks missing samples, read the file with missing=[{odd:g}]; of a "
                "table in memory replace it by NaN."
            )


def sample_times(source: Any, sampling_time: float | None, n: int) -> Any:
    """Take the times from their column, or from the step; exactly one of the two."""
    if source is None and sampling_time is None:
        raise invalid(
            "time", expected="the name of a column of times, or a sampling_time", got="neither",
            advice="Give time=... (\"index\" for the index of a frame) or, for equal steps, "
            "sampling_time=... in the unit of time.",
        )  # fmt: skip
    if source is not None and sampling_time is not None:
        raise invalid(
            "sampling_time", expected="None where the data have times", got=repr(sampling_time),
            advice="Leave it out; to override an index of times use frame.reset_index(drop=True).",
        )  # fmt: skip
    if source is not None:
        return source
    step = sampling_time
    if isinstance(step, bool) or not isinstance(step, Real) or not 0 < step < np.inf:
        raise invalid("sampling_time", expected="a positive number", got=repr(sampling_time))
    return np.arange(n) * float(step)


def record_fields(
    clock: Any, values: Mapping[str, Array], chosen: tuple[list[str], list[str], list[str]],
    units: Mapping[str, str], options: ColumnOptions, *, time_unit: str, name: str,
    start: pd.Timestamp | None,
) -> RecordFields:  # fmt: skip
    """The arguments of `Record` from columns of numbers."""
    u, y, rest = chosen
    for key in (*u, *y, *rest):
        note_sentinel(key, values[key])
    empty = np.empty((len(clock), 0))
    u_units, y_units = options.get("input_units"), options.get("output_units")
    extra_units = options.get("extra_units") or {}
    return {
        "time": clock,
        "inputs": np.column_stack([empty, *(values[key] for key in u)]),
        "outputs": np.column_stack([empty, *(values[key] for key in y)]),
        "input_names": u,
        "output_names": y,
        "input_units": [units.get(key, "") for key in u] if u_units is None else u_units,
        "output_units": [units.get(key, "") for key in y] if y_units is None else y_units,
        "extra": {key: values[key] for key in rest},
        "extra_units": {key: units.get(key, "") for key in rest} | dict(extra_units),
        "time_unit": time_unit,
        "name": name,
        "start": start,
    }
