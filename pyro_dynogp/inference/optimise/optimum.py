"""What a climb comes to, and how checkpoints keep it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from pyro_dynogp.support.checkpoints import Piece, tensor_text, text_tensor


@dataclass(frozen=True)
class Optimum:
    """What one start came to.

    Attributes:
        energy: -log p(y, values), the lower the better.
        values: value of every latent site.
        history: energy after each iteration.
        message: why the optimiser stopped.
    """

    energy: float
    values: dict[str, Tensor]
    history: np.ndarray
    message: str


def to_piece(optima: Sequence[Optimum]) -> Piece:
    """Optima as a piece of a checkpoint."""
    piece: Piece = {}
    for i, one in enumerate(optima):
        piece[f"{i}/energy"] = torch.tensor(one.energy, dtype=torch.float64)
        piece[f"{i}/history"] = torch.tensor(one.history, dtype=torch.float64)
        piece[f"{i}/message"] = text_tensor(one.message)
        piece |= {f"{i}/value/{name}": value for name, value in one.values.items()}
    return piece


def from_piece(piece: Piece) -> list[Optimum]:
    """Inverse of `to_piece`."""
    optima: list[Optimum] = []
    while f"{len(optima)}/energy" in piece:
        own = f"{len(optima)}/"
        mark = f"{own}value/"
        values = {k.removeprefix(mark): v for k, v in piece.items() if k.startswith(mark)}
        energy, history = float(piece[f"{own}energy"]), piece[f"{own}history"].numpy()
        optima.append(Optimum(energy, values, history, tensor_text(piece[f"{own}message"])))
    return optima
