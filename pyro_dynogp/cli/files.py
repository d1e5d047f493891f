"""Where results are written: tried before the work, and nothing lost where it fails after it."""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from pyro_dynogp.cli.data import InvalidInput

if TYPE_CHECKING:
    from pyro_dynogp.data.record import Record


def check_folder(option: str, path: Path) -> None:
    """Tell what cannot be written before the work, not after it."""
    folder = path.absolute().parent
    if not folder.is_dir():
        raise InvalidInput(f"{option}: there is no folder {folder}.")
    try:
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        raise InvalidInput(
            f"{option}: {folder} cannot be written to ({error.strerror})."
        ) from error


def stamped(frame: Any, record: Record) -> Any:
    """A table over the times of a record, with time stamps where it has them."""
    if record.timestamps is not None:
        frame.index = record.timestamps.map(lambda stamp: stamp.isoformat()).rename("time")
    return frame


def saved_table(frame: Any, path: Path) -> None:
    """Write a table as CSV, see `saved`, and say where it is."""
    from pyro_dynogp.support.writing import write_result

    there = saved(lambda part: write_result(part, frame.to_csv, "The table"), path)
    click.echo(f"{len(frame)} rows in {there}")


def saved(write: Callable[[Path], object], path: Path) -> Path:
    """Write what was computed, elsewhere where this cannot be done; the file that it is in.

    Args:
        write: writes a file, or raises the ValueError of `support.writing`. path: of the file.
    """
    try:
        write(path)
    except ValueError as error:
        other = Path(tempfile.mkdtemp(prefix="pyro-dynogp-")) / path.name
        try:
            write(other)
        except ValueError:
            other.parent.rmdir()
            raise error from None  # of the file that was asked for
        click.echo(f"{error}\nSaved elsewhere: move {other} to where it is to be.", err=True)
        return other
    return path
