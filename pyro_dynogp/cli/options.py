"""Options that several commands share."""

from __future__ import annotations

from typing import Any

import click


def options(*decorators: Any) -> Any:
    """One decorator for several options."""

    def apply(command: Any) -> Any:
        for decorator in reversed(decorators):
            command = decorator(command)
        return command

    return apply


CLOCK = options(
    click.option("--time", metavar="COLUMN", help="Column of times: numbers or ISO 8601 stamps."),
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
    default=5,
    show_default=True,
    help="Number of pole pairs (half the order).",
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
