"""Stretches of a record that are held out in turn, where something happens at one instant."""

from __future__ import annotations

from collections.abc import Collection

import numpy as np

from pyro_dynogp.data.record import Record
from pyro_dynogp.statistics.evidence import Evidence


def stretches(mask: np.ndarray) -> list[slice]:
    """Stretches of samples for which a mask (n,) holds."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], mask.astype(int), [0]])))
    return [slice(int(a), int(b)) for a, b in zip(edges[::2], edges[1::2], strict=True)]


def latest(localised: Collection[Evidence], record: Record) -> int:
    """Sample of a record at or after which the last of several things happens, 0 for none of them.

    Args: localised: evidence for what happens at one instant.
    """
    begins = [float(one.where["time"]) for one in localised if "time" in one.where]
    return int(np.searchsorted(record.time, max(begins))) if begins else 0


def numbered(count: int, blocks: int, begin: int = 0) -> np.ndarray:
    """Number of the block that each sample is in (n,), of so many that are about as long.

    At least two of them lie after `begin`, the sample where something happens: one can be held out
    and the other one fitted to. Where blocks are too long for that, those from there on are shorter
    than the others.
    """
    number: np.ndarray = np.arange(count) * blocks // max(count, 1)
    if not 0 < begin < count - 1 or number[-1] - number[begin] >= 2:
        return number
    before, after = number[:begin], np.arange(count - begin)
    return np.concatenate([before, before[-1] + 1 + after * 2 // len(after)])


def interleaved(count: int, blocks: int, begin: int = 0) -> tuple[np.ndarray, ...]:
    """Two folds (n,): every other block of a record, and those between but for the first.

    What happens at one instant, `begin` or before, has data on either side of it in both.
    """
    number = numbered(count, blocks, begin)
    return (number % 2 == 1), ((number % 2 == 0) & (number > 0))


def shared(held_out: np.ndarray, blocks: int, begin: int = 0) -> np.ndarray:
    """Every other stretch of the block that is searched (n,), the last one among them.

    The rest of it is for the fit, where something happens, at `begin`, that only that block shows.
    """
    rows = np.flatnonzero(held_out)
    number = numbered(len(rows), blocks, begin - int(rows[0]))
    out = np.zeros_like(held_out)
    out[rows[(number[-1] - number) % 2 == 0]] = True
    return out
