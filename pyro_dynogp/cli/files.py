"""Where results are written: tried before the work, and nothing lost where it fails after it."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import TYPE_CHECKING

import click

from pyro_dynogp.cli.data import InvalidInput

if TYPE_CHECKING:
    from pyro_dynogp.fitting import Fit


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


def saved(fit: Fit, path: Path) -> Path:
    """Save a fit, elsewhere where this cannot be done; the file that it is in."""
    try:
        fit.save(path)
    except ValueError as error:
        other = Path(tempfile.mkdtemp(prefix="pyro-dynogp-")) / path.name
        fit.save(other)
        click.echo(f"{error}\nSaved elsewhere: move {other} to where it is to be.", err=True)
        return other
    return path
