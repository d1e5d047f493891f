"""Numbers as text files write them: decimal marks, thousands separators, missing values."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field

import numpy as np

from pyro_dynogp.data.checks import Array
from pyro_dynogp.support.errors import invalid

MISSING = ("", "na", "n/a", "nan", "null")
SEPARATORS = (".", ",", "'", "’", " ", "\u00a0", "\u202f")
_GROUPED = re.compile(
    r"[+-]?[1-9]\d{0,2}((?P<mark>[.,'’ \u00a0\u202f])\d{3})((?P=mark)\d{3})*([.,]\d+)?"
)
_COMMA = re.compile(r"[+-]?\d*,\d+([eE][+-]?\d+)?")
_POINT = re.compile(r"[+-]?\d*\.\d+([eE][+-]?\d+)?")
_THREE = {mark: re.compile(rf"[+-]?[1-9]\d{{0,2}}({re.escape(mark)}\d{{3}})+") for mark in ".,"}


@dataclass(frozen=True)
class Numerals:
    """How the numbers of a file are written.

    Attributes:
        decimal: "." or ",". thousands: separator of groups of three digits; None for none.
        missing: numbers that mark a missing value. words: texts that do, in lower case.
    """

    decimal: str = "."
    thousands: str | None = None
    missing: tuple[float, ...] = ()
    words: frozenset[str] = field(default_factory=lambda: frozenset(MISSING))

    def value(self, cell: str) -> float | None:
        """Value of a cell: NaN where it is missing, None where it is no number."""
        text = cell
        if self.thousands is not None and self.thousands in cell:
            whole, mark, rest = cell.partition(self.decimal)
            first, *groups = whole.split(self.thousands)
            grouped = first.lstrip("+-").isdigit() and all(
                len(group) == 3 and group.isdigit() for group in groups
            )
            text = first + "".join(groups) + mark + rest if grouped else "no number"
        if self.decimal == ",":
            text = "no number" if "." in text else text.replace(",", ".", 1)
        try:
            number = None if "_" in text else float(text)  # Python reads 1_000, a file does not
        except ValueError:
            word = cell.lower()
            return np.nan if word in self.words else {"true": 1.0, "false": 0.0}.get(word)
        return np.nan if number in self.missing or cell.lower() in self.words else number

    def values(self, cells: Sequence[str]) -> Array | None:
        """Values (n,) of cells that are numbers or empty, all at once; None where one is neither.

        Numbers are rounded as Python rounds them.
        """
        text = "\n".join(cells)
        if "_" in text or self.thousands is not None or (self.decimal == "," and "." in text):
            return None
        if self.decimal == ",":
            cells = text.replace(",", ".").split("\n")
        try:
            found = np.fromiter((float(cell or "nan") for cell in cells), np.float64, len(cells))
        except ValueError:
            return None
        found[np.isin(found, self.missing)] = np.nan
        return found


def numerals(
    decimal: str | None, thousands: str | None, missing: Iterable[float | str] | float | str | None
) -> Numerals:
    """The way of writing numbers that options state; a decimal mark of None is a point here.

    Raises:
        ValueError: a mark that is none, the same one twice, missing values that are neither numbers
            nor texts.
    """
    if decimal not in (None, ".", ","):
        raise invalid("decimal", expected='"." or ","', got=repr(decimal))
    if thousands is not None and thousands not in SEPARATORS:
        expected = 'a separator of groups of three digits: ".", ",", "\'" or " "'
        raise invalid("thousands", expected=expected, got=repr(thousands))
    if decimal is None:
        decimal = "," if thousands == "." else "."
    if thousands == decimal:
        raise invalid(
            "thousands", expected=f"another mark than the decimal one, {decimal!r}",
            got=repr(thousands),
        )  # fmt: skip
    if missing is None:
        missing = ()
    given = [missing] if isinstance(missing, str | int | float) else missing
    numbers: list[float] = []
    words = set(MISSING)
    for mark in given if isinstance(given, Iterable) else [given]:
        if isinstance(mark, bool) or not isinstance(mark, str | int | float | np.number):
            expected = "numbers or texts that mark a missing value, such as [-9999]"
            raise invalid("missing", expected=expected, got=repr(missing))
        try:
            numbers.append(float(mark))
        except ValueError:
            words.add(str(mark).strip().lower())
    return Numerals(decimal, thousands, tuple(numbers), frozenset(words))


def decimal_mark(cells: Sequence[str], rest: Iterable[str], delimiter: str, path: object) -> str:
    """The decimal mark of a file.

    A comma, where the delimiter is another mark and a number of the first lines has a comma. Groups
    of three digits, as in 1,500, may also be thousands: some number has to be of another form.

    Args:
        cells: of the first lines. rest: of all other lines, read where those do not say it.
        delimiter: of the columns. path: of the file, for the error.

    Raises:
        ValueError: all numbers with a mark could be whole numbers of thousands.
    """
    comma = delimiter != "," and any(_COMMA.fullmatch(cell) for cell in cells)
    mark = "," if comma else "."
    # Where the delimiter is a semicolon, the decimal mark may be either; else a point is one.
    if not comma and delimiter != ";":
        return mark
    number = _COMMA if comma else _POINT
    grouped = ""
    for some in (cells, rest):
        for cell in some:
            if mark not in cell:
                continue
            if _THREE[mark].fullmatch(cell):
                grouped = grouped or cell
            elif number.fullmatch(cell):
                return mark
    if not grouped:
        return mark
    raise invalid(
        "decimal",
        expected=f"numbers of which one tells what {mark!r} means",
        got=f"{grouped!r} and others like it in {path}, which are decimals or thousands",
        advice=f'Give decimal="{mark}", or thousands="{mark}" where they are thousands.',
    )


def no_number(where: str, column: str, cell: object, *, text: bool = False) -> ValueError:
    """The error for a cell that is no number; `text`: of a text file, which has more options."""
    advice = "Empty a cell to mark it as missing"
    advice += ", or give missing=[...] with what marks one." if text else "."
    match = _GROUPED.fullmatch(cell) if isinstance(cell, str) else None
    if match and text:
        advice = f"With thousands separators: give thousands={match['mark']!r}"
        alone = match[4] is None and match["mark"] in ".,"
        advice += f"; or decimal={match['mark']!r}, where it is the decimal mark." if alone else "."
    return invalid(
        f"column {column!r}",
        expected="numbers, true/false or missing cells",
        got=f"{cell!r} in {where}",
        advice=advice,
    )
