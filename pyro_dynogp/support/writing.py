"""Files that are there whole or not at all."""

from __future__ import annotations

import contextlib
import os
import re
import secrets
import socket
from collections.abc import Callable
from pathlib import Path

from pyro_dynogp.support.errors import invalid

# This machine, in the names of files that are being written.
HOST = re.sub(r"\W", "_", socket.gethostname())
# Letters of a file's name in that of the file that is written first, whose name is longer.
LETTERS = 100


def write_whole(path: Path, writer: Callable[[Path], object], *, replace: bool = True) -> None:
    """Write a file that is there whole or not at all, readable to whom the user's mask says.

    Args:
        path: of the file; what a link points to is written. A device or a pipe is written to as
            it is.
        writer: is called with the path of a file to write.
        replace: whether to replace a file that is there, or to leave it as it is.

    Raises:
        OSError: where it cannot be written; what was there before is there.
    """
    path = Path(os.path.realpath(path))
    if path.exists() and not path.is_file() and not path.is_dir():
        writer(path)
        return
    ending = f"{HOST}-{os.getpid()}-{secrets.token_hex(4)}.part"
    part = path.with_name(f"{path.name[:LETTERS]}.{ending}")
    try:
        with open(part, "xb"):  # made here, so that its mode is what the user's mask says
            mode = part.stat().st_mode
        writer(part)
        part.chmod(mode)  # a writer may have made the file anew
        with open(part, "rb") as file:
            os.fsync(file.fileno())
        if replace:
            part.replace(path)
        else:
            with contextlib.suppress(FileExistsError):
                os.link(part, path)
    finally:
        part.unlink(missing_ok=True)


def write_result(path: str | Path, writer: Callable[[Path], object], what: str) -> None:
    """Write what was computed to a file of the user's, and say in a sentence where it cannot be.

    Args:
        path: of the file. writer: as of `write_whole`. what: was computed, to begin a sentence.

    Raises:
        ValueError: where the file cannot be written; what was there before is there.
    """
    try:
        write_whole(Path(path), writer)
    except OSError as error:
        raise unwritten(path, error, what) from error


def unwritten(path: str | Path, error: OSError, what: str) -> ValueError:
    """The error for a file that cannot be written."""
    return invalid(
        "path",
        expected="a file in an existing folder that can be written to",
        got=f"{path} ({error.strerror or error})",
        advice=f"{what} is as it was, and so is a file that was there.",
    )


def write_text(path: str | Path, text: str, what: str) -> None:
    """Write a text in UTF-8, see `write_result`."""
    write_result(path, lambda part: part.write_text(text, encoding="utf-8"), what)
