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
