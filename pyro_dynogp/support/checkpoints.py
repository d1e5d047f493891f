"""Training as a chain of pieces that are kept on disk: a killed run resumes to the same bits.

Each piece (some iterations from one start, some steps of SVI) is a pure function of what came
before it and of its seed. With a folder, its result is written when it is done, and read instead of
computed when the same run is started again. Files are safetensors; nothing is pickled.
"""

from __future__ import annotations

import contextlib
import errno
import json
import os
import re
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor

from pyro_dynogp.support.errors import invalid
from pyro_dynogp.support.identity import digest, versions
from pyro_dynogp.support.writing import HOST, write_whole

Piece = dict[str, Tensor]
# Of a file's texts, the one that is the digest of all else in it.
DIGEST = "pyro_dynogp.sha256"


@dataclass(frozen=True)
class Checkpoints:
    """Where the pieces of one run are kept.

    Attributes:
        folder: made if it does not exist; None keeps nothing.
        fingerprint: of everything that the result depends on; a folder serves one run alone.
    """

    folder: Path | None
    fingerprint: str

    @classmethod
    def at(cls, folder: str | Path | None, **identity: object) -> Checkpoints:
        """For a run that the given values, by their content, and versions of packages identify.

        Raises:
            ValueError: where the folder holds the pieces of another run; what differs is named.
            OSError: where nothing can be written there.
        """
        if folder is None:
            return cls(None, "")
        known = {**identity, "versions": versions()}
        parts = {name: digest(value) for name, value in known.items()}
        fingerprint = digest(parts)
        path = Path(folder)
        note, text = path / "run.json", json.dumps({"fingerprint": fingerprint, "parts": parts})
        with _told(path):
            path.mkdir(parents=True, exist_ok=True)
            for stale in path.glob(f"*.{HOST}-*.part"):  # of processes that were killed
                if not _lives(int(stale.name.split("-")[-2])):
                    stale.unlink(missing_ok=True)
            if not note.exists():  # of two that begin here at once one makes it, both read it
                write_whole(note, lambda p: p.write_text(text), replace=False)
        found = _read_note(note)
        if found["fingerprint"] != fingerprint:
            theirs = found.get("parts", {})
            differs = [name for name, part in parts.items() if theirs.get(name) != part]
            raise invalid(
                "checkpoint",
                expected="a new folder, or that of a run with the same model, record, seed, "
                "settings and versions of packages",
                got=f"{path}, which holds another run (another {', '.join(differs)})",
                advice="Give another folder, or remove this one.",
            )
        return cls(path, fingerprint)

    def piece(self, key: str, compute: Callable[[], Mapping[str, Tensor]]) -> Piece:
        """The result of a piece: read where it is kept, else computed and kept."""
        if self.folder is None:
            return dict(compute())
        path = self.folder / f"{key}.safetensors"
        advice = "Remove it: what it holds is computed again."
        marks = {"run": self.fingerprint, "piece": key}
        if path.exists():
            tensors, texts = read_tensors(path, "checkpoint", advice)
            if any(texts.get(name) != mark for name, mark in marks.items()):
                raise ValueError(
                    f"checkpoint: {path} is another piece, or one of another run. {advice}"
                )
            return tensors
        result = dict(compute())
        with _told(self.folder):
            return write_tensors(path, result, marks)


# For runs that keep nothing.
NOTHING_KEPT = Checkpoints(None, "")


@contextlib.contextmanager
def _told(folder: Path) -> Iterator[None]:
    """Say in a sentence that a folder cannot be written to."""
    try:
        yield
    except OSError as error:
        why = error.strerror or error
        raise OSError(
            error.errno or errno.EIO,
            f"checkpoint: {folder} cannot be written to ({why}). What was finished before is kept "
            "there: the same call continues from it once there is room and leave to write",
        ) from error


def _read_note(note: Path) -> dict[str, Any]:
    try:
        found = json.loads(note.read_text())
        if not isinstance(found, dict) or "fingerprint" not in found:
            raise ValueError("no fingerprint in it")
    except (ValueError, OSError) as error:
        raise invalid(
            "checkpoint", expected=f"a note {note} of whose run the folder is",
            got=f"one that cannot be read ({error})", advice="Remove the folder, or give another.",
        ) from error  # fmt: skip
    return found


def _lives(process: int) -> bool:
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except OSError:  # somebody else's
        return True
    return True


def write_tensors(path: Path, tensors: Piece, texts: Mapping[str, str]) -> Piece:
    """Write a safetensors file with a digest of all that is in it, whole or not at all.

    Returns:
        The tensors as they are in it, which share no memory with what was given.

    Raises:
        OSError: where it cannot be written; what was there before is there.
    """
    apart = {name: value.detach().clone().contiguous() for name, value in tensors.items()}
    marked = {**texts, DIGEST: content_digest(apart, texts)}
    try:
        write_whole(path, lambda part: save_file(apart, str(part), metadata=marked))
    except SafetensorError as error:  # which has the system's number in its text alone
        number = re.search(r"os error (\d+)", str(error))
        if number is None:
            raise OSError(errno.EIO, str(error)) from error
        raise OSError(int(number[1]), os.strerror(int(number[1]))) from error
    return apart


def read_tensors(
    path: Path, what: str, advice: str, *, marked: bool = True
) -> tuple[Piece, dict[str, str]]:
    """The tensors of a safetensors file, and its texts.

    Args:
        path: of the file. what: to begin an error with. advice: to end it with.
        marked: whether it must have a digest; one that it has must be right in any case.

    Raises:
        ValueError: where it is no such file, or not as it was written.
    """
    try:
        with safe_open(str(path), framework="pt") as file:
            texts = dict(file.metadata() or {})
            # Copies: vectorised sums round by where a tensor lies in memory, and in the file it
            # may lie anywhere.
            tensors = {name: file.get_tensor(name).clone() for name in file.keys()}  # noqa: SIM118
        mark = texts.pop(DIGEST, None)
        if (mark is None and marked) or mark not in (None, content_digest(tensors, texts)):
            raise ValueError("its content is not what was written")
    except (SafetensorError, OSError, ValueError, TypeError, KeyError, RuntimeError) as error:
        raise ValueError(
            f"{what}: {path} is not a safetensors file, or it is damaged ({error}). {advice}"
        ) from error
    return tensors, texts if mark is None else {**texts, DIGEST: mark}


def content_digest(tensors: Mapping[str, Tensor], metadata: Mapping[str, str]) -> str:
    """Hex SHA-256 of tensors, bit by bit, and texts by their names."""
    return digest([sorted(metadata.items()), sorted(tensors.items())])


def text_tensor(text: str) -> Tensor:
    """Text as a tensor of bytes."""
    return torch.tensor(list(text.encode()), dtype=torch.uint8)


def tensor_text(value: Tensor) -> str:
    """Inverse of `text_tensor`."""
    return bytes(value.tolist()).decode()
