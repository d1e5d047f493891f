"""The cells of a text file: delimiter, header and line numbers, as plant loggers write them."""

from __future__ import annotations

import bz2
import csv
import dataclasses
import gzip
import itertools
import lzma
import re
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from pyro_dynogp.data.checks import Array
from pyro_dynogp.data.plain_numbers import plain_numbers, whole_file
from pyro_dynogp.support.errors import invalid

LONGEST_LINE = 2**20  # characters: what is longer is no table
MISSING = ("", "na", "n/a", "nan", "null")
_OPENERS: dict[str, Callable[..., Any]] = {".gz": gzip.open, ".xz": lzma.open, ".bz2": bz2.open}
_STAMP = re.compile(
    r"\d{4}-\d\d-\d\d([T ]\d\d:\d\d(:\d\d([.,]\d+)?)?)?\s?(?P<zone>Z|[+-]\d\d:?\d\d)?"
)
_DECIMAL_COMMA = re.compile(r"[+-]?\d*,\d+([eE][+-]?\d+)?")


@dataclasses.dataclass(frozen=True)
class TextTable:
    """Cells of a text file by column, or its numbers, with the line each row came from."""

    columns: dict[str, tuple[str, ...]] | dict[str, Array]
    lines: Sequence[int]
    decimal: str

    def numbers(self, column: str) -> Array:
        """The numbers (n,) of a column."""
        cells = self.columns[column]
        if isinstance(cells, np.ndarray):
            return cells
        values = np.empty(len(self.lines))
        for row, cell in enumerate(cells):
            number = _number(cell, self.decimal)
            if number is None:
                raise no_number(f"line {self.lines[row]}", column, cell)
            values[row] = number
        return values

    def times(self, column: str, timezone: str | None) -> Array | pd.DatetimeIndex:
        """The times of a column: numbers, or time stamps."""
        cells = named_column(self.columns, "time", column)
        if isinstance(cells, np.ndarray) or all(
            _number(cell, self.decimal) is not None for cell in cells
        ):
            return self.numbers(column)
        matches = [_STAMP.fullmatch(cell) for cell in cells]
        naive = matches[0] is not None and matches[0]["zone"] is None
        for row, match in enumerate(matches):
            if match is None or (match["zone"] is None) != naive:
                raise invalid(
                    "time",
                    expected="numbers, or ISO 8601 stamps that all have a zone or all have none",
                    got=f"{cells[row]!r} in column {column!r}, line {self.lines[row]}",
                    advice="Parse other forms with pandas.to_datetime and use Record.from_frame.",
                )
        try:
            plain = [cell.replace(",", ".") for cell in cells]
            stamps = pd.DatetimeIndex(pd.to_datetime(plain, format="ISO8601", utc=not naive))
            if not naive and len({match["zone"] for match in matches if match}) == 1:
                stamps = stamps.tz_convert(pd.Timestamp(plain[0]).tz)
        except ValueError as error:
            raise invalid("time", expected="ISO 8601 time stamps", got=str(error)) from error
        return localise(stamps, timezone)


def read_table(
    path: Path, header: bool | None, names: Sequence[str] | None,
    delimiter: str | None, decimal: str | None, encoding: str,
) -> TextTable:  # fmt: skip
    """A table of a text file: columns by name."""
    if delimiter is not None and len(delimiter) != 1:
        raise invalid("delimiter", expected="one character", got=repr(delimiter))
    if decimal not in (None, ".", ","):
        raise invalid("decimal", expected='"." or ","', got=repr(decimal))
    plain = _plain_table(path, header, names, delimiter, decimal)
    if plain is not None:
        return plain
    numbered = list(_lines(path, encoding))
    if not numbered:
        raise invalid("path", expected="a file with a line of data", got=f"{path}, which has none")
    mark = delimiter or _sniff([text for _, text in numbered[:50]])
    if mark.isspace() and mark != "\t":
        numbered = [(i, " ".join(text.split())) for i, text in numbered]
    try:
        found = csv.reader((text for _, text in numbered), delimiter=mark)
        rows = [[cell.strip() for cell in row] for row in found]
    except csv.Error as error:
        raise invalid(
            "path", expected="a file of columns", got=f"{path}, in which a {error}",
            advice="A quotation mark that is not closed makes one cell of many.",
        ) from error  # fmt: skip
    if len(rows) != len(numbered):
        raise invalid("path", expected="one row on each line", got="a quoted cell of several lines")
    lines = [i for i, _ in numbered]
    if decimal is None:
        cells = [cell for row in rows[:50] for cell in row]
        comma = mark != "," and any(_DECIMAL_COMMA.fullmatch(cell) for cell in cells)
        decimal = "," if comma else "."
    if header is None:
        header = names is None and not all(_is_data(cell, decimal) for cell in rows[0])
    first, rows, lines = (rows[0], rows[1:], lines[1:]) if header else ([], rows, lines)
    while rows and not any(rows[-1]):
        rows, lines = rows[:-1], lines[:-1]
    if not rows:
        raise invalid("path", expected="a file with a line of data", got=f"{path}, a header alone")
    given = list(names) if names is not None else first if header else [""] * len(rows[0])
    for row, line in zip(rows, lines, strict=True):
        if _width(row) > len(given):
            raise invalid(
                "path", expected=f"{len(given)} cells on each line, as in the first",
                got=f"{_width(row)} on line {line}",
                advice="Give names=[...] for all columns, or the delimiter.",
            )  # fmt: skip
    width = len(given) if names is not None else max(_width(row) for row in (first, *rows))
    unnamed = not header and names is None
    labels = [str(i) for i in range(width)] if unnamed else _block_names(given[:width])
    padded = ([*row, *[""] * width][:width] for row in rows)
    columns = dict(zip(labels, zip(*padded, strict=True), strict=False))
    if len(columns) != len(labels):
        raise invalid(
            "path", expected="unique column names", got=f"{labels}",
            advice="Give names=[...] for all columns, and header=True to skip those of the file.",
        )  # fmt: skip
    return TextTable(columns, tuple(lines), decimal)


def _plain_table(
    path: Path, header: bool | None, names: Sequence[str] | None,
    delimiter: str | None, decimal: str | None,
) -> TextTable | None:  # fmt: skip
    """The table of a large file of plain numbers; None where anything is out of the ordinary."""
    data = None if decimal == "," or path.suffix in _OPENERS else whole_file(path)
    if data is None:
        return None
    texts = [text for text in data[:100_000].decode("ascii").splitlines() if text.strip()][:50]
    mark = delimiter or (_sniff(texts) if texts else " ")
    rows = [[cell.strip() for cell in text.split(mark)] for text in texts]
    if mark == " " or (not mark.isprintable() and mark != "\t") or len(rows) < 50:
        return None
    if mark != "," and any(_DECIMAL_COMMA.fullmatch(cell) for row in rows for cell in row):
        return None
    if header is None:
        header = names is None and not all(_is_data(cell, ".") for cell in rows[0])
    width = len(rows[1])
    given = list(names) if names is not None else rows[0] if header else [""] * width
    labels = _block_names(given) if header or names is not None else [str(i) for i in range(width)]
    if len(given) != width or len(set(labels)) != width:
        return None
    values = plain_numbers(data, mark, width, header)
    if values is None:
        return None
    return TextTable(dict(zip(labels, values.T, strict=True)), range(len(values)), ".")


def _lines(path: Path, encoding: str) -> Iterator[tuple[int, str]]:
    """Lines that hold data, with their numbers; blank ones are not kept while reading on."""
    try:
        with _OPENERS.get(path.suffix, open)(path, "rt", encoding=encoding) as file:
            for number in itertools.count(1):
                text = file.readline(LONGEST_LINE)
                if not text:
                    return
                if len(text) == LONGEST_LINE:
                    expected = f"lines of fewer than {LONGEST_LINE} characters"
                    raise invalid(
                        "path", expected=expected, got=f"a longer line {number} in {path}"
                    )
                if text.strip() and text.lstrip()[0] not in "#%":
                    yield number, text.strip("\r\n ")
    except (UnicodeDecodeError, LookupError) as error:
        raise invalid(
            "encoding", expected=f"a text file in {encoding}", got=str(error),
            advice='Give the encoding, for instance encoding="latin-1".',
        ) from error  # fmt: skip
    except (EOFError, zlib.error, lzma.LZMAError, OSError) as error:
        if getattr(error, "filename", None) is not None:  # no damage, but no file
            raise
        raise invalid(
            "path", expected="a whole compressed file", got=f"{path} ({error})",
            advice="It is damaged, or not what its name says: copy it again.",
        ) from error  # fmt: skip


def _sniff(texts: list[str]) -> str:
    """Delimiter that every line has; the comma is last, as it may be a decimal comma."""
    return next((mark for mark in ";\t," if all(mark in text for text in texts)), " ")


def _width(row: Sequence[str]) -> int:
    """Count the cells up to the last one that is not empty."""
    return next((i for i in range(len(row), 0, -1) if row[i - 1]), 0)


def _block_names(names: Sequence[str]) -> list[str]:
    """Names of all columns; a name and the empty ones after it become name_0, name_1, ..."""
    labels: list[str] = []
    block, count = "unnamed", 0
    for i, name in enumerate(names):
        if name:
            block, count = name, 0
        alone = name and (i + 1 == len(names) or names[i + 1])
        labels.append(name if alone else f"{block}_{count}")
        count += 1
    return labels


def _number(cell: str, decimal: str) -> float | None:
    """Value of a cell: NaN where it is missing, None where it is no number."""
    if decimal == ",":
        cell = "no number" if "." in cell else cell.replace(",", ".", 1)
    try:
        return None if "_" in cell else float(cell)  # Python reads 1_000, a data file does not
    except ValueError:
        word = cell.lower()
        return np.nan if word in MISSING else {"true": 1.0, "false": 0.0}.get(word)


def _is_data(cell: str, decimal: str) -> bool:
    return _number(cell, decimal) is not None or _STAMP.fullmatch(cell) is not None


def no_number(row: str, column: str, cell: object) -> ValueError:
    """The error for a cell that is no number."""
    return invalid(
        f"column {column!r}",
        expected="numbers, true/false or missing cells",
        got=f"{cell!r} in {row}",
        advice="Empty a cell to mark it as missing; a column of text can be left out by naming "
        "the extra channels to keep, extra=[...], or extra=None.",
    )


def named_column(columns: Mapping[str, Any], argument: str, key: str) -> Any:
    """The column of that name."""
    if key not in columns:
        raise invalid(argument, expected=f"one of the columns {list(columns)}", got=repr(key))
    return columns[key]


def localise(stamps: pd.DatetimeIndex, timezone: str | None) -> pd.DatetimeIndex:
    """Stamps with a zone; those without are read as local times of `timezone`."""
    if timezone is None:
        if stamps.tz is None:
            raise invalid(
                "timezone", expected="the zone of the plant, as the stamps have none", got="None",
                advice='Give timezone="UTC" or, for local times, one like "Europe/Vienna".',
            )  # fmt: skip
        return stamps
    try:
        zone = pd.Timestamp(0, tz=timezone).tz
    except (KeyError, ValueError, TypeError, OSError) as error:
        raise invalid(
            "timezone", expected='a zone such as "UTC" or "Europe/Vienna"', got=repr(timezone)
        ) from error
    if stamps.tz is not None:
        return stamps.tz_convert(zone)
    local = stamps.tz_localize(zone, ambiguous="NaT", nonexistent="NaT")
    bad = np.flatnonzero(np.asarray(local.isna()) & ~np.asarray(stamps.isna()))
    if len(bad):
        raise invalid(
            "time",
            expected=f"local times that exist once in {timezone}",
            got=f"{stamps[bad[0]]} in row {bad[0]} ({len(bad)} rows), which the change of "
            "daylight saving skips or repeats",
            advice="Store the stamps in UTC or with their offset; or localise them yourself with "
            'pandas, tz_localize(..., ambiguous="infer"), and use Record.from_frame.',
        )
    return local
