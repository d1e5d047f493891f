"""Large text files that are numbers alone, read at once; others are left to the patient reader."""

from __future__ import annotations

import io
import warnings
from pathlib import Path

import numpy as np
import pandas as pd

from pyro_dynogp.data.checks import Array

# Bytes of a file from which on it pays; above the most, a file is read line by line.
LEAST, MOST = 2**20, 2**31
# Bytes that may mean something else than a number, and the longest line.
SPECIAL, LONGEST = (b'"', b"#", b"%", b"_"), 100_000


def whole_file(path: Path) -> bytes | None:
    """The bytes of a file that may be plain numbers; None where it is another, or not worth it."""
    if not path.is_file() or not LEAST <= path.stat().st_size <= MOST:
        return None
    data = path.read_bytes()
    if not data.isascii() or any(mark in data for mark in SPECIAL):
        return None
    ends = np.flatnonzero(np.frombuffer(data, np.uint8) == ord("\n"))
    longest = np.diff(ends, prepend=-1, append=len(data)).max()
    return data if longest <= LONGEST else None


def plain_numbers(data: bytes, mark: str, width: int, header: bool) -> Array | None:
    """The numbers (n, width) of a file; None unless every line has one number in every cell.

    Numbers are rounded as Python rounds them.

    Args:
        data: of the file. mark: between cells. width: cells of a line.
        header: whether the first line that is not blank has names.
    """
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", DeprecationWarning)  # of the exact rounding of numbers
            warnings.simplefilter("error", pd.errors.ParserWarning)  # of lines that are too long
            frame = pd.read_csv(
                io.BytesIO(data), sep=mark, header=0 if header else None, names=range(width),
                index_col=False, dtype=np.float64, engine="c", na_filter=False,
                float_precision="round_trip", low_memory=False,
            )  # fmt: skip
    except (ValueError, pd.errors.ParserWarning):
        return None
    values = frame.to_numpy()
    cells = data.count(mark.encode()) - (width - 1) * (len(values) + header)
    return values if len(values) and not cells and bool(np.isfinite(values).all()) else None
