"""Training as a chain of pieces that are kept on disk: a killed run resumes to the same bits.

Each piece (some iterations from one start, some steps of SVI) is a pure function of what came
before it and of its seed. With a folder, its result is written when it is done, and read instead of
computed when the same run is started again. Files are safetensors; nothing is pickled.
"""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor

from pyro_dynogp.support.errors import invalid

Piece = dict[str, Tensor]


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
    def at(cls, folder: str | Path | None, *identity: object) -> Checkpoints:
        """For a run that the given values (their `repr`) identify.

        Raises:
            ValueError: where the folder holds the pieces of another run.
        """
        text = "\n".join(repr(part) for part in identity)
        fingerprint = hashlib.sha256(text.encode()).hexdigest()
        if folder is None:
            return cls(None, fingerprint)
        path = Path(folder)
        path.mkdir(parents=True, exist_ok=True)
        note = path / "run.json"
        if note.exists():
            found = json.loads(note.read_text()).get("fingerprint")
            if found != fingerprint:
                raise invalid(
                    "checkpoint",
                    expected="a new folder, or that of a run with the same model, record, seed "
                    "and settings",
                    got=f"{path}, which holds another run",
                    advice="Give another folder, or remove this one.",
                )
        else:
            _write(note, lambda p: p.write_text(json.dumps({"fingerprint": fingerprint})))
        return cls(path, fingerprint)

    def piece(self, key: str, compute: Callable[[], Mapping[str, Tensor]]) -> Piece:
        """The result of a piece: read where it is kept, else computed and kept."""
        if self.folder is None:
            return dict(compute())
        path = self.folder / f"{key}.safetensors"
        if path.exists():
            try:
                with safe_open(str(path), framework="pt") as file:
                    # Copies: vectorised sums round by where a tensor lies in memory, and in the
                    # file it may lie anywhere.
                    return {n: file.get_tensor(n).clone() for n in file.keys()}  # noqa: SIM118
            except (SafetensorError, OSError) as error:
                raise ValueError(
                    f"checkpoint: {path} is damaged ({error}). Remove it: what it holds is "
                    "computed again."
                ) from error
        result = {name: value.detach().clone().contiguous() for name, value in compute().items()}
        _write(path, lambda p: save_file(result, str(p)))
        return result


# For runs that keep nothing.
NOTHING_KEPT = Checkpoints(None, "")


def _write(path: Path, writer: Callable[[Path], object]) -> None:
    """Write a file that is there whole or not at all."""
    part = path.with_name(f"{path.name}.{os.getpid()}.part")
    writer(part)
    with open(part, "rb") as file:
        os.fsync(file.fileno())
    part.replace(path)


def text_tensor(text: str) -> Tensor:
    """Text as a tensor of bytes."""
    return torch.tensor(list(text.encode()), dtype=torch.uint8)


def tensor_text(value: Tensor) -> str:
    """Inverse of `text_tensor`."""
    return bytes(value.tolist()).decode()
