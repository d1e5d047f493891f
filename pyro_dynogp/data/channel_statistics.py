"""Mean, standard deviation and order of the channels of training records."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from pyro_dynogp.data.checks import Array
from pyro_dynogp.support.errors import invalid, whole

# Largest numbers of a signal, and one over the smallest: squares of what is made of them have room.
LARGEST = 1e100


def by_smoothness(signals: Sequence[Array]) -> tuple[int, ...]:
    """Places of scaled channels by how little they change from one sample to the next.

    Channels that change alike, as switched signals may, go by when they are large. Both numbers are
    rounded: in another order of channels sums round otherwise.

    Args:
        signals: (n, d) of each record, NaN where missing. What cannot be said comes last.
    """
    changes = np.concatenate([np.diff(x, axis=0) for x in signals])
    pooled = np.concatenate(signals)
    when = np.linspace(0.0, 1.0, len(pooled))[:, None]
    return tuple(int(i) for i in np.lexsort((_rounded(when * pooled), _rounded(changes**2))))


def _rounded(values: Array) -> Array:
    """Mean of each column to nine digits after the point, gaps skipped; infinite without any."""
    there = ~np.isnan(values)
    mean = np.where(there, values, 0.0).sum(0) / np.maximum(there.sum(0), 1)
    return np.where(there.any(0), np.round(mean, 9), np.inf)


def permutation(argument: str, given: Sequence[int], count: int) -> tuple[int, ...]:
    """Places of so many channels, each once; as they are given where none is said."""
    places = tuple(given) or tuple(range(count))
    for place in places:
        whole(0, max(count - 1, 0)).check(argument, place)
    if len(set(places)) != count:
        raise invalid(argument, expected=f"each place from 0 to {count - 1} once", got=f"{places}")
    return places


def mean_and_sd(role: str, arrays: list[Array], names: tuple[str, ...]) -> tuple[Array, Array]:
    """Mean and standard deviation of each column, gaps skipped; constants are refused."""
    pooled = np.concatenate(arrays)
    offset, scale = np.zeros(len(names)), np.ones(len(names))
    for i, name in enumerate(names):
        seen = pooled[~np.isnan(pooled[:, i]), i]
        if not len(seen):
            raise invalid(
                f"{role} {name!r}", expected="samples to learn from", got="missing samples alone"
            )
        low, high = float(seen.min()), float(seen.max())
        largest = max(abs(low), abs(high))
        varies = f"numbers from {low:.9g} to {high:.9g}"
        if low < high and not 1.0 / LARGEST < largest < LARGEST:
            raise invalid(
                f"{role} {name!r}",
                expected=f"numbers of a size between {1.0 / LARGEST:g} and {LARGEST:g}, whose "
                "squares are numbers, too",
                got=varies,
                advice="State the signal in another unit.",
            )
        offset[i], scale[i] = seen.mean(), seen.std()
        if scale[i] <= 1e-12 * largest:
            rounding = f"{varies}, which differ by rounding alone"
            raise invalid(
                f"{role} {name!r}",
                expected="a signal that varies",
                got=rounding if low < high else f"the constant {low:g}",
                advice="Record it less the level that it varies around."
                if low < high
                else "There is nothing to identify: train on data in which it moves."
                if role == "output"
                else "Leave the input out (Record.select): a constant acts through the output "
                "offset alone.",
            )
    return offset, scale
