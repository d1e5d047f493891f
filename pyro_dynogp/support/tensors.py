"""Conversion of what users pass (lists, arrays, tensors) to float64 tensors."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np
import torch
from numpy.typing import ArrayLike
from torch import Tensor

from pyro_dynogp.support.errors import invalid

# What users may give as numbers: a tensor, an array, a list, one number.
Numbers = Tensor | ArrayLike


def broadcast(*shapes: Iterable[int]) -> torch.Size:
    """Broadcast shapes, as torch.broadcast_shapes does, which is slow for every likelihood.

    Raises:
        ValueError: where two sizes differ and neither is one.
    """
    sizes: list[int] = []
    for shape in shapes:
        given = list(shape)
        sizes = [1] * (len(given) - len(sizes)) + sizes
        start = len(sizes) - len(given)
        for i, size in enumerate(given, start):
            if sizes[i] == 1:
                sizes[i] = size
            elif size not in (1, sizes[i]):
                raise ValueError(f"shapes {[tuple(s) for s in shapes]} do not broadcast")
    return torch.Size(sizes)


def joined(parts: Sequence[Tensor], events: int, dim: int) -> Tensor:
    """One after the other along `dim`, one of the last `events` dimensions; others broadcast."""
    batch = broadcast(*(part.shape[: part.dim() - events] for part in parts))
    return torch.cat([x.expand(batch + x.shape[x.dim() - events :]) for x in parts], dim)


def as_tensor(
    value: Numbers,
    dtype: torch.dtype = torch.float64,
    device: torch.device | None = None,
    *,
    argument: str = "value",
) -> Tensor:
    """Tensor of the given dtype; read-only arrays (those of a Record) are copied.

    Raises:
        ValueError: where it holds no numbers; `argument` is what to call it.
    """
    if isinstance(value, Tensor):
        return value.to(dtype=dtype, device=device or value.device)
    if isinstance(value, np.ndarray) and (
        not value.flags.writeable or min(value.strides, default=0) < 0
    ):
        value = value.copy()
    try:
        return torch.as_tensor(value, dtype=dtype, device=device)
    except (TypeError, ValueError, RuntimeError) as error:
        got = f"{type(value).__name__} ({error})"
        raise invalid(argument, expected="an array of numbers", got=got) from error


def at_places(columns: Tensor, places: Sequence[int], count: int) -> Tensor:
    """Columns (..., k) at their places among so many, the others zero."""
    whole = columns.new_zeros(*columns.shape[:-1], count)
    return whole.index_copy(-1, torch.tensor(places), columns)
