"""The lines of a text file that hold data, whatever it is encoded in."""

from __future__ import annotations

import bz2
import codecs
import gzip
import lzma
import re
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

from pyro_dynogp.support.errors import invalid

LONGEST_LINE = 2**20  # characters: what is longer is no table
BLOCK = 2**22  # characters that are read at once
OPENERS: dict[str, Callable[..., Any]] = {".gz": gzip.open, ".xz": lzma.open, ".bz2": bz2.open}
# The 32-bit marks first: the 16-bit ones are their beginnings.
_MARKS = {
    codecs.BOM_UTF32_LE: "utf-32", codecs.BOM_UTF32_BE: "utf-32",
    codecs.BOM_UTF8: "utf-8-sig", codecs.BOM_UTF16_LE: "utf-16", codecs.BOM_UTF16_BE: "utf-16",
}  # fmt: skip
# Excel's first line that names the delimiter.
_DELIMITER_LINE = re.compile(r'"?sep=(.)"?\s*', re.IGNORECASE)


@dataclass(frozen=True)
class Lines:
    """Lines of a file that are neither blank nor comments.

    Attributes:
        texts: the lines. numbers: which line of the file each is, counted from 1.
        delimiter: that a first line ``sep=;`` names; None where there is none.
    """

    texts: list[str]
    numbers: list[int]
    delimiter: str | None


def read_lines(path: Path, encoding: str | None = None, skip_rows: int = 0) -> Lines:
    """Lines that hold data; those that begin with # or % and blank ones are left out.

    Args:
        path: a local file, also .gz, .bz2 and .xz.
        encoding: of the file; None for the one that its byte order mark names, UTF-16 without a
            mark where every second byte is zero, else UTF-8.
        skip_rows: lines at the beginning that are no data and no header, blank ones counted.

    Raises:
        ValueError: another encoding, a line that is too long, a damaged compressed file.
    """
    try:
        used = encoding or encoding_of(path)
        with OPENERS.get(path.suffix, open)(path, "rt", encoding=used) as file:
            all_lines = _whole(file, path)
    except (UnicodeError, LookupError) as error:
        raise invalid(
            "encoding", expected=f"a text file in {encoding or 'utf-8'}", got=str(error),
            advice='Give the encoding, for instance encoding="cp1252" (Windows, Western Europe), '
            '"latin-1" or "utf-16".',
        ) from error  # fmt: skip
    except (EOFError, zlib.error, lzma.LZMAError, OSError) as error:
        if getattr(error, "filename", None) is not None:  # no damage, but no file
            raise
        raise invalid(
            "path", expected="a whole compressed file", got=f"{path} ({error})",
            advice="It is damaged, or not what its name says: copy it again.",
        ) from error  # fmt: skip
    if any("\0" in text for text in all_lines[:50]):
        raise invalid(
            "encoding", expected="the encoding of the file",
            got=f"{used}, in which {path} has characters of value zero",
            advice='It is most likely UTF-16: give encoding="utf-16", "utf-16-le" or "utf-16-be".',
        )  # fmt: skip
    if all_lines and (match := _DELIMITER_LINE.fullmatch(all_lines[0])):
        delimiter, begin = match[1], max(1, skip_rows)
    else:
        delimiter, begin = None, skip_rows
    numbers = [
        number
        for number, text in enumerate(all_lines[begin:], begin + 1)
        if text[:1] not in "#% \t\r\n" or (text.strip() and text.lstrip()[0] not in "#%")
    ]
    return Lines([all_lines[k - 1].strip("\r\n ") for k in numbers], numbers, delimiter)


def encoding_of(path: Path) -> str:
    """What the first bytes of a file say that it is encoded in; "utf-8" where they say nothing."""
    with OPENERS.get(path.suffix, open)(path, "rb") as file:
        head = file.read(1024)
    for mark, name in _MARKS.items():
        if head.startswith(mark):
            return name
    # Text in a Latin script: of its 16-bit characters most have a zero for the higher byte.
    for name, high in (("utf-16-le", head[1::2]), ("utf-16-be", head[::2])):
        if len(high) > 4 and high.count(0) > 0.6 * len(high):
            return name
    return "utf-8"


def _whole(file: IO[str], path: Path) -> list[str]:
    """All lines of a file. A block without an end of line is refused before the next is read."""
    blocks = []
    while block := file.read(BLOCK):
        blocks.append(block)
        if len(block) == BLOCK and "\n" not in block:
            break
    lines = "".join(blocks).split("\n")
    longest = max(lines, key=len)
    if len(longest) >= LONGEST_LINE:
        raise invalid(
            "path", expected=f"lines of fewer than {LONGEST_LINE} characters",
            got=f"a longer line {lines.index(longest) + 1} in {path}",
        )  # fmt: skip
    return lines
