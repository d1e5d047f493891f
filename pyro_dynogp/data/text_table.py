"""The cells of a text file: delimiter, header and line numbers, as plant loggers write them.

Cells are not split by pandas: their lines are known for the errors, and short rows are allowed.
Numbers and stamps are converted a column at a time, stamps by pandas. Files of plain numbers are
read by pandas alone (`plain_numbers`).
"""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from pyro_dynogp.data.checks import Array
from pyro_dynogp.data.columns import named_column
from pyro_dynogp.data.numerals import Numerals, decimal_mark, no_number
from pyro_dynogp.data.plain_numbers import plain_numbers, whole_file
from pyro_dynogp.data.text_cells import blocks, split_cells
from pyro_dynogp.data.text_layout import Layout
from pyro_dynogp.data.text_lines import OPENERS, read_lines
from pyro_dynogp.data.time_stamps import is_stamp, localise, read_stamps
from pyro_dynogp.support.errors import invalid

HEAD = 50  # lines from which delimiter, header and decimal mark are told
_ANY_MARK = re.compile("[;,\t]")
_MARKS = ";\t,"  # the comma is last, as it may be a decimal comma


@dataclasses.dataclass(frozen=True)
class TextTable:
    """Cells of a text file by column, or its numbers, with the line each row came from.

    Attributes:
        columns: name -> cells (n,), as text or as numbers. lines: of the file, one for each row.
        numerals: how numbers are written. units: name -> unit, of the row of units.
        time_format: of stamps. head: number and cells of the first lines.
    """

    columns: Mapping[str, Sequence[str] | Array]
    lines: Sequence[int]
    numerals: Numerals = dataclasses.field(default_factory=Numerals)
    units: Mapping[str, str] = dataclasses.field(default_factory=dict)
    time_format: str | None = None
    head: Sequence[tuple[int, Sequence[str]]] = ()

    def numbers(self, column: str) -> Array:
        """The numbers (n,) of a column.

        Raises:
            ValueError: a cell that is no number.
        """
        cells = self.columns[column]
        if isinstance(cells, np.ndarray):
            return cells
        values = self.numerals.values(cells)
        if values is not None:
            return values
        values = np.empty(len(cells))
        for row, cell in enumerate(cells):
            number = self.numerals.value(cell)
            if number is None:
                raise no_number(f"line {self.lines[row]}", column, cell, text=True)
            values[row] = number
        return values

    def times(self, column: str, timezone: str | None) -> Array | pd.DatetimeIndex:
        """The times of a column: numbers, or time stamps."""
        cells = self.named("time", column)
        if isinstance(cells, np.ndarray):
            return cells
        if self.time_format is None and self.numerals.value(cells[0]) is not None:
            values = self.numerals.values(cells)
            if values is not None or all(self.numerals.value(c) is not None for c in cells):
                return self.numbers(column) if values is None else values
        return localise(read_stamps(cells, self.lines, column, self.time_format), timezone)

    def named(self, argument: str, key: str) -> Any:
        """The column of that name.

        Raises:
            ValueError: there is none; where it stands in a later line, the error says which.
        """
        # Also of a line that the delimiter of the first lines does not split.
        line = next((number for number, cells in self.head
                     if key in cells or key in _ANY_MARK.split(" ".join(cells))), 1)  # fmt: skip
        if key not in self.columns and line > 1:
            raise invalid(
                argument, expected=f"one of the columns {list(self.columns)}", got=repr(key),
                advice=f"It is in line {line}: give skip_rows={line - 1} where that is the header.",
            )  # fmt: skip
        return named_column(self.columns, argument, key)


def read_table(path: Path, layout: Layout | None = None) -> TextTable:
    """A table of a text file: columns by name."""
    layout = Layout() if layout is None else layout
    form = layout.check()
    plain = _plain_table(path, layout)
    if plain is not None:
        return plain
    found = read_lines(path, layout.encoding, layout.skip_rows)
    if not found.texts and layout.skip_rows:
        expected = f"a number of lines after which {path} has a line of data"
        raise invalid("skip_rows", expected=expected, got=str(layout.skip_rows))
    if not found.texts:
        raise invalid("path", expected="a file with a line of data", got=f"{path}, which has none")
    texts, lines = found.texts, found.numbers
    mark = layout.delimiter or found.delimiter or sniff(texts[:HEAD])
    if mark.isspace() and mark != "\t":
        texts = [" ".join(text.split()) for text in texts]
    top = _rows(texts[: HEAD + 2], mark, path)
    head = list(zip(lines, top, strict=False))
    if layout.decimal is None and layout.thousands is None:
        rest = (cell.strip(' "') for text in texts[HEAD:] for cell in text.split(mark))
        decimal = decimal_mark([cell for row in top for cell in row], rest, mark, path)
        form = dataclasses.replace(form, decimal=decimal)
    header, given = _titles(layout, top[0], form)
    second = _units_row(top[int(header) :], header, layout.units_row, form)
    begin, end = int(header) + bool(second), len(texts)
    while end > begin and not texts[end - 1].strip(mark + ' "'):
        end -= 1
    if end <= begin:
        raise invalid("path", expected="a file with a line of data", got=f"{path}, a header alone")
    lines, most = lines[begin:end], len(top[0] if given is None else given)
    columns = _columns(texts[begin:end], lines, mark, path, most, head)
    width = most if layout.names is not None else max(len(columns), _width(given or []))
    labels = _labels(given, width)
    columns += [[""] * len(lines)] * (width - len(columns))
    named = dict(zip(labels, columns, strict=False))
    if len(named) != len(labels):
        raise invalid(
            "path", expected="unique column names", got=f"{labels}",
            advice="Give names=[...] for all columns, and header=True to skip those of the file.",
        )  # fmt: skip
    units = {label: unit.strip("[]()") for label, unit in zip(labels, second, strict=False) if unit}
    return TextTable(named, lines, form, units, layout.time_format, head)


def _rows(texts: list[str], mark: str, path: Path) -> list[list[str]]:
    """Cells of every line, without the white space around them."""
    return [[cell.strip() for cell in row] for block in blocks(texts, mark, path) for row in block]


def _units_row(
    rows: list[list[str]], header: bool, wanted: bool | None, form: Numerals
) -> list[str]:
    """The row of units, the first of those under a header; empty where there is none.

    It is one where no cell of it is data while every column that it has a text in has data below.
    """
    if wanted is False or not rows or (not header and wanted is None):
        return []
    first, below = rows[0], rows[1:]
    filled = [i for i, cell in enumerate(first) if cell]
    if wanted is None:
        under = [[row[i] for row in below if i < len(row) and row[i]] for i in filled]
        text = bool(filled) and not any(_is_data(first[i], form) for i in filled)
        if not text or not all(
            cells and all(_is_data(cell, form) for cell in cells) for cells in under
        ):
            return []
    return first


def _columns(
    texts: list[str], lines: list[int], mark: str, path: Path, most: int,
    head: Sequence[tuple[int, Sequence[str]]],
) -> list[list[str]]:  # fmt: skip
    """Cells by column; those at the right that are empty in all lines are left out.

    Raises:
        ValueError: a line of more cells than `most`, of quotes that are not closed.
    """
    whole = "\n".join(texts)
    flat, width = split_cells(whole, texts, mark, path)
    if any(space in whole for space in (mark + " ", " " + mark, '" ', ' "', "\t", "\u00a0")):
        flat = [cell.strip() for cell in flat]
    columns = [flat[i::width] for i in range(width)]
    while columns and not any(columns[-1]):
        columns.pop()
    if len(columns) > most:
        line, width = next(
            (lines[i], max(j + 1 for j, column in enumerate(columns) if column[i]))
            for i in range(len(texts)) if any(column[i] for column in columns[most:])
        )  # fmt: skip
        begin = _header_line(head)
        advice = "Give names=[...] for all columns, or the delimiter."
        if begin > head[0][0]:
            advice = f"If the table begins in line {begin}, give skip_rows={begin - 1}."
        raise invalid(
            "path", expected=f"{most} cells on each line, as in the first",
            got=f"{width} on line {line}", advice=advice,
        )  # fmt: skip
    return columns


def _header_line(head: Sequence[tuple[int, Sequence[str]]]) -> int:
    """The line from which on the first lines have equally many cells, two or more."""
    begin = head[-1][0]
    for line, row in reversed(head):
        if len(row) != len(head[-1][1]) or len(row) < 2:
            break
        begin = line
    return begin


def _plain_table(path: Path, layout: Layout) -> TextTable | None:
    """The table of a large file of plain numbers; None where anything is out of the ordinary."""
    data = None if not layout.is_plain or path.suffix in OPENERS else whole_file(path)
    if data is None:
        return None
    texts = [text for text in data[:100_000].decode("ascii").splitlines() if text.strip()][:HEAD]
    mark = layout.delimiter or (sniff(texts) if texts else " ")
    rows = [[cell.strip() for cell in text.split(mark)] for text in texts]
    if mark == " " or (not mark.isprintable() and mark != "\t") or len(rows) < HEAD:
        return None
    try:
        if (
            layout.decimal is None
            and decimal_mark([cell for row in rows for cell in row], (), mark, path) == ","
        ):
            return None
    except ValueError:  # not told by the first lines: the others are asked, too
        return None
    header, given = _titles(layout, rows[0], Numerals())
    width = len(rows[1])
    labels = _labels(given, width)
    if len(given or labels) != width or len(set(labels)) != width:
        return None
    if any(Numerals().value(cell) is None for row in rows[header:] for cell in row):
        return None  # as of time stamps: not read twice
    values = plain_numbers(data, mark, width, header)
    if values is None:
        return None
    return TextTable(dict(zip(labels, values.T, strict=True)), range(len(values)))


def sniff(texts: Sequence[str]) -> str:
    """Delimiter that every line has, else white space."""
    return next((mark for mark in _MARKS if all(mark in text for text in texts)), " ")


def _width(row: Sequence[str]) -> int:
    """Count the cells up to the last one that is not empty."""
    return next((i for i in range(len(row), 0, -1) if row[i - 1]), 0)


def _titles(layout: Layout, first: list[str], form: Numerals) -> tuple[bool, list[str] | None]:
    """Whether the first line is a header, and the names that are stated; None where none are."""
    header, names = layout.header, layout.names
    if header is None:
        header = names is None and not all(_is_data(cell, form) for cell in first)
    return header, list(names) if names is not None else first if header else None


def _labels(given: list[str] | None, width: int) -> list[str]:
    """Names of so many columns: as stated, or their numbers."""
    return [str(i) for i in range(width)] if given is None else _block_names(given[:width])


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


def _is_data(cell: str, form: Numerals) -> bool:
    return form.value(cell) is not None or is_stamp(cell)
