"""Options that several commands share, and what they come to."""

from __future__ import annotations

from pathlib import Path
from typing import Any, TypedDict

import click


class Clock(TypedDict):
    """Options about time and about how a file is written, as in `Record.from_csv`."""

    time: str | None
    sampling_time: float | None
    timezone: str | None
    time_unit: str | None
    time_format: str | None
    missing: tuple[str, ...]
    skip_rows: int
    units_row: bool | None
    encoding: str | None
    delimiter: str | None
    decimal: str | None
    thousands: str | None


# Options of how a file is written, as the reader has them.
LAYOUT = (
    "time_format", "missing", "skip_rows", "units_row", "encoding", "delimiter", "decimal",
    "thousands",
)  # fmt: skip


class Columns(Clock):
    """What the columns of DATA are: names, NAME=UNIT of some of them, and the clock."""

    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    units: tuple[str, ...]


class Modelled(Columns):
    """The columns of DATA, and the model to fit to them: its name and number of pole pairs."""

    kind: str
    pairs: int | None


def options(*decorators: Any) -> Any:
    """One decorator for several options."""

    def apply(command: Any) -> Any:
        for decorator in reversed(decorators):
            command = decorator(command)
        return command

    return apply


# A file that a fit was saved to.
SAVED_FIT = click.Path(exists=True, dir_okay=False, path_type=Path)
# How a file is written.
READING = options(
    click.option(
        "--time-format", metavar="FORM", help='Form of the stamps, such as "%d.%m.%Y %H:%M:%S".'
    ),
    click.option(
        "--missing", multiple=True, metavar="VALUE",
        help="Value that marks a missing sample, such as -9999; repeatable.",
    ),
    click.option(
        "--skip-rows", type=click.IntRange(min=0), default=0, metavar="N",
        help="Lines before the header, blank ones counted.",
    ),
    click.option(
        "--units-row/--no-units-row", default=None,
        help="Whether the line under the header holds units; looked for if not given.",
    ),
    click.option("--encoding", metavar="NAME", help="Of the file, such as cp1252 [UTF-8]."),
    click.option("--delimiter", metavar="CHAR", help="Between columns [found from the file]."),
    click.option("--decimal", metavar="CHAR", help="Decimal mark, . or , [found from the file]."),
    click.option("--thousands", metavar="CHAR", help="Separator of groups of three digits."),
)  # fmt: skip
CLOCK = options(
    click.option("--time", metavar="COLUMN", help="Column of times: numbers or time stamps."),
    click.option(
        "--sampling-time",
        type=click.FloatRange(min=0, min_open=True),
        metavar="S",
        help="Step between samples, where there is no column of times.",
    ),
    click.option("--timezone", metavar="TZ", help="Zone of the stamps, such as Europe/Vienna."),
    click.option(
        "--time-unit",
        metavar="UNIT",
        help="Unit of numeric times [s, or the model's].",
    ),
    READING,
)
# What the columns of DATA are.
CHANNELS = options(
    click.option(
        "--input", "inputs", multiple=True, metavar="NAME", help="Input column; repeatable."
    ),
    click.option(
        "--output", "outputs", multiple=True, metavar="NAME", help="Output column; repeatable."
    ),
    CLOCK,
    click.option(
        "--unit",
        "units",
        multiple=True,
        metavar="NAME=UNIT",
        help="Unit of a column, for labels and checks; repeatable.",
    ),
)
PAIRS = click.option(
    "--pairs",
    type=click.IntRange(min=1),
    metavar="N",
    help="Number of pole pairs (half the order) [5; of feedback 1].",
)
# How work is done.
WORK = options(
    click.option(
        "--workers",
        type=click.IntRange(min=1),
        metavar="N",
        help="Processes; all processors if not given.",
    ),
    click.option("--quiet", is_flag=True, help="No progress bars."),
)


def seed(what: str) -> Any:
    """A seed, of a fit or of a report."""
    return click.option(
        "--seed",
        type=click.IntRange(min=0),
        default=0,
        show_default=True,
        help=f"The same seed gives the same {what}.",
    )
