"""Complaints and notes of the package in the words of the command line: flags, not arguments."""

from __future__ import annotations

import re
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TextIO

import click

# Flags of arguments whose name is another one; of all others it is the name.
FLAGS = {
    "inputs": "--input", "outputs": "--output", "units": "--unit", "at": "--train",
    "input_units": "--unit", "output_units": "--unit", "extra_units": "--unit",
    "extra": "--candidates", "select": "--input, --output",
}  # fmt: skip
KNOWN = (
    "time", "sampling_time", "timezone", "time_unit", "time_format", "skip_rows", "units_row",
    "missing", "encoding", "decimal", "delimiter", "thousands", "restarts", "steps", "pairs",
    "method", "seed", "workers", "twin", "horizon", "candidates", "max_rounds", "time_limit",
)  # fmt: skip
# Advice that no flag follows.
REPLACED = {
    "Give names=[...] for all columns, or the delimiter.":
        "Give --delimiter, or write a header with a name for each column.",
    "Give names=[...] for all columns, and header=True to skip those of the file.":
        "Rename the columns in the file.",
    "; or parse the column with pandas.to_datetime and use Record.from_frame": "",
    "; or localise them yourself with pandas, tz_localize(..., ambiguous=\"infer\"), and use "
    "Record.from_frame": "",
    "; of a table in memory replace it by NaN": "",
    " extra=[...] names those to keep.": "",
    ' ("index" for the index of a frame)': "",
    "Leave it out; to override an index of times use frame.reset_index(drop=True).":
        "Leave one of the two out.",
    " (pyro_dynogp.load reads it)": "",
    "select: expected names among": "--input, --output: expected names among",
}  # fmt: skip
_OPTION = re.compile(
    rf"\b({'|'.join([*KNOWN, 'inputs', 'outputs'])})=(\[[^\]]*\]|\"[^\"]*\"|'[^']*'|[^\s,;)]+)"
)


def flag(argument: str) -> str | None:
    """The flag of an argument of Python; None where there is none."""
    known = "--" + argument.replace("_", "-") if argument in KNOWN else None
    return FLAGS.get(argument, known)


def in_flags(message: str) -> str:
    """A message of the package, in one line, with flags in place of arguments of Python."""
    text = " ".join(message.split())
    for before, after in REPLACED.items():
        text = text.replace(before, after)
    argument, colon, rest = text.partition(": ")
    if colon and flag(argument):
        text = f"{flag(argument)}: {rest}"
    return _OPTION.sub(_as_flag, text)


def _as_flag(match: re.Match[str]) -> str:
    """`skip_rows=4` as `--skip-rows 4`; lists as the flag once for each item."""
    name, value = match[1], match[2].rstrip(".")
    after = "." if match[2] != value and value != ".." else ""
    given = flag(name)
    if value == "True":
        return f"{given}{after}"
    if value.startswith("["):
        items = [item.strip().strip("\"'") for item in value[1:-1].split(",")]
        return " ".join(f"{given} {_quoted(item)}" for item in items) + after
    return f"{given} {_quoted(value.strip(chr(34)).strip(chr(39)) or value)}{after}"


def _quoted(value: str) -> str:
    """A value as the shell needs it."""
    return value if re.fullmatch(r"[\w.:/+%,-]+", value) else f'"{value}"'


@contextmanager
def notes() -> Iterator[None]:
    """Print warnings of the package as notes on the error stream, each once."""
    told: set[str] = set()
    with warnings.catch_warnings():
        before = warnings.showwarning

        def show(
            message: Warning | str, category: type[Warning], filename: str, lineno: int,
            file: TextIO | None = None, line: str | None = None,
        ) -> None:  # fmt: skip
            if category is not UserWarning:
                before(message, category, filename, lineno, file, line)
                return
            text = in_flags(str(message).removeprefix("fit: "))
            if text not in told:
                told.add(text)
                click.echo(f"Note: {text}", err=True)

        # `told` leaves out repetitions, which Python would by the line of code.
        warnings.simplefilter("always", UserWarning)
        warnings.showwarning = show
        yield
