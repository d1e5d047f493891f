"""What a user states about a text file of columns."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

from pyro_dynogp.data.numerals import Numerals, numerals
from pyro_dynogp.support.errors import invalid


@dataclasses.dataclass(frozen=True)
class Layout:
    """What a user states about a text file; `read_csv` says what each option means.

    Texts, names and switches are what they have to be (`columns.check_options`, or the shell).
    """

    header: bool | None = None
    names: Sequence[str] | None = None
    delimiter: str | None = None
    decimal: str | None = None
    encoding: str | None = None
    skip_rows: int = 0
    units_row: bool | None = None
    missing: Any = None
    thousands: str | None = None
    time_format: str | None = None

    def check(self) -> Numerals:
        """How numbers are written; the decimal mark is a point where it is not stated.

        Raises:
            ValueError: an option that makes no sense.
        """
        if self.delimiter is not None and (
            not isinstance(self.delimiter, str) or len(self.delimiter) != 1
        ):
            raise invalid("delimiter", expected="one character", got=repr(self.delimiter))
        rows = self.skip_rows
        if isinstance(rows, bool) or not isinstance(rows, int) or rows < 0:
            expected = "the number of lines before the header, a whole number >= 0"
            raise invalid("skip_rows", expected=expected, got=repr(rows))
        return numerals(self.decimal, self.thousands, self.missing)

    @property
    def is_plain(self) -> bool:
        """Whether a file may be numbers alone under a header."""
        usual = (self.decimal != ",", not self.skip_rows, not self.units_row)
        return all(usual) and self.thousands is None and self.missing is None
