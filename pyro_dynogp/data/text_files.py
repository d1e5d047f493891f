"""Record from a text file of columns, as loggers and spreadsheets write them."""

from __future__ import annotations

from collections.abc import Sequence
from os import PathLike
from pathlib import Path
from typing import Any, Unpack

import numpy as np

from pyro_dynogp.data.checks import Names
from pyro_dynogp.data.columns import (
    ColumnOptions,
    check_options,
    choose,
    record_fields,
    sample_times,
)
from pyro_dynogp.data.fields import RecordFields
from pyro_dynogp.data.text_layout import Layout
from pyro_dynogp.data.text_table import read_table
from pyro_dynogp.support.errors import RULES


class TextOptions(ColumnOptions, total=False):
    """Options of `read_csv`."""

    header: bool | None
    names: Sequence[str] | None
    delimiter: str | None
    decimal: str | None
    encoding: str | None
    skip_rows: int
    units_row: bool | None
    missing: Sequence[float | str] | float | str | None
    thousands: str | None
    time_format: str | None


def read_csv(
    path: str | PathLike[str],
    inputs: Names = (),
    outputs: Names = None,
    **options: Unpack[TextOptions],
) -> RecordFields:
    """Record from a text file of columns; local files, also .gz, .bz2 and .xz.

    Names of columns: those of the first line. A line that holds only numbers, time stamps and
    missing values is data: without a header the names are "0", "1", ... A name followed by
    columns without one heads a block: `r,,,u` names r_0, r_1, r_2, u. Empty columns without a
    name at the right (a comma at the end of each line) are dropped. A line of text under the header
    holds units, where its columns hold numbers or stamps below. A first line `sep=;` names the
    delimiter.

    Cells: numbers; TRUE and FALSE are 1 and 0; empty cells, NA, N/A, NaN and null are missing.
    Lines that begin with # or % and blank lines are skipped; short lines end in missing cells.

    Args:
        path: the file.
        inputs: names of the input columns.
        outputs: names of the output columns; missing cells are missing samples.
        output: the same as `outputs`; give one of the two.
        time: name of the column of times: numbers; ISO 8601 stamps such as 2012-01-01T00:30:00Z,
            2012-01-01 11:30+11:00, or local ones together with `timezone`; or stamps such as
            25.11.2024 13:45 and 11/25/2024 01:45:00 PM, where one order of day and month reads
            all of them.
        sampling_time: step [time_unit], where there is no such column.
        timezone: zone such as "Australia/Melbourne": stamps without a zone are read in it,
            stamps with a zone are converted to it.
        time_unit: unit of numeric times; by default that in the row of units, or "s".
        extra: "all" keeps every other column of numbers as an extra channel and warns of those it
            leaves out, a list keeps those, None none.
        input_units: units of the inputs; by default those in the row of units, or "".
        output_units: units of the outputs.
        extra_units: name -> unit of the extra channels.
        name: label; by default the file's name without its suffixes.
        header: whether the first line holds names; by default found as told above.
        names: names of all columns, in place of a header.
        delimiter: character between columns, or " " for white space. By default the first of
            semicolon, tab, comma that every line has, else white space.
        decimal: "." or ","; by default "," where the delimiter is not a comma and numbers are
            written with a comma, else ".".
        encoding: of the file; by default UTF-8, or what its first bytes say (UTF-16).
        skip_rows: number of lines before the header (blank ones counted) that are no data.
        units_row: whether the line under the header holds units; by default found as told above.
        missing: further values that mark a missing sample, such as [-9999, "bad"].
        thousands: separator of groups of three digits, such as "." in 1.000,5.
        time_format: form of the stamps, as of `datetime.strptime`: "%d.%m.%Y %H:%M:%S",
            "%m/%d/%Y %I:%M:%S %p".

    Returns:
        The arguments of `Record`.

    Raises:
        ValueError: unknown columns; cells that are no numbers (their line and column); lines of
            too many cells; no times or two sources of them; stamps without a zone, or that
            daylight saving makes ambiguous; stamps whose day and month, or numbers whose decimal
            mark and thousands separator, cannot be told apart.
    """
    check_options(options, TextOptions)
    RULES["path"].check("path", path)
    stated: dict[str, Any] = {k: v for k, v in options.items() if k in Layout.__annotations__}
    table = read_table(Path(path), Layout(**stated))
    time, name = options.get("time"), options.get("name")
    source = None if time is None else table.times(time, options.get("timezone"))
    chosen, values = choose(
        table.columns, inputs, outputs, options, time, table.numbers, table.named
    )
    unit = table.units.get(time or "", "") if isinstance(source, np.ndarray) else ""
    return record_fields(
        sample_times(source, options.get("sampling_time"), len(table.lines)),
        values, chosen, table.units, options, time_unit=options.get("time_unit") or unit or "s",
        name=Path(path).name.split(".")[0] if name is None else name, start=None,
    )  # fmt: skip
