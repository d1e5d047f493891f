"""Single channels of signals inside a model: "g[1]" is the second one of the signal "g"."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import TypeVar

from torch import Tensor

T = TypeVar("T")


def channel(signal: str, place: int) -> str:
    """What a layer calls the channel of a signal at a place, the first one being 0."""
    return f"{signal}[{place}]"


def signal_of(source: str) -> str:
    """The signal that a layer sees, or sees one channel of."""
    return source.partition("[")[0]


def place_of(source: str) -> int | None:
    """Place of the channel that a layer sees of a signal; None for all of them."""
    _, one, place = source.partition("[")
    return int(place.rstrip("]")) if one else None


def each_channel(label: str, signal: str, width: int) -> dict[str, str]:
    """What layers call the channels of a signal that has so many, by labels of their own.

    A single one is the signal itself, and has the label; several are numbered from 1.
    """
    if width == 1:
        return {label: signal}
    return {f"{label}_{place + 1}": channel(signal, place) for place in range(width)}


def with_channels(widths: Mapping[str, int]) -> dict[str, int]:
    """Numbers of channels of signals, and of their single channels."""
    single = {channel(name, k): 1 for name, width in widths.items() for k in range(width)}
    return {**widths, **single}


def part(source: str, width: int) -> slice:
    """The channels that a layer sees of a signal that has so many."""
    place = place_of(source)
    return slice(0, width) if place is None else slice(place, place + 1)


def seen(signals: Mapping[str, Tensor], source: str) -> Tensor:
    """What a layer sees (*b, n, w) of the signals (*b, n, channels)."""
    whole = signals[signal_of(source)]
    return whole[..., part(source, whole.shape[-1])]


def twice(sources: Iterable[str]) -> str | None:
    """A source of which something is seen a second time; None where there is none."""
    before: set[str] = set()
    for source in sources:
        own = signal_of(source)
        inside = any(signal_of(other) == own for other in before)
        if source in before or own in before or (inside and place_of(source) is None):
            return source
        before.add(source)
    return None
