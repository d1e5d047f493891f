"""Signals inside a cascade, as the moment-matching filter sees them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from torch import Tensor

from pyro_dynogp.models.selection import part
from pyro_dynogp.models.wiring import INPUTS, Dynamic, Wire

# What a channel is that is no static output.
KNOWN, TRAJECTORY = -1, -2


@dataclass(frozen=True, eq=False)
class Signal:
    """A signal inside the cascade.

    Attributes:
        known: (*b, n, w) what known inputs cause.
        rows: (*b, w, A) over [x; f], None where the signal is known altogether.
        outputs: for each channel the static output that it is, KNOWN, or TRAJECTORY.
    """

    known: Tensor
    rows: Tensor | None
    outputs: tuple[int, ...]

    def seen(self, source: str) -> Signal:
        """What a layer sees of it: all, or a single channel."""
        own = part(source, len(self.outputs))
        rows = None if self.rows is None else self.rows[..., own, :]
        return Signal(self.known[..., own], rows, self.outputs[own])


def places_of_outputs(wires: Sequence[Wire]) -> tuple[dict[str, int], int]:
    """First place of each static layer among the random static outputs, and E, how many there are.

    Identities count.
    """
    random: dict[str, str] = {INPUTS: "known"}
    first: dict[str, int] = {}
    total = 0
    for place in wires:
        sources = [random[name] for name in place.reads]
        if isinstance(place.layer, Dynamic):
            total += place.channels if "trajectory" in sources else 0
            random |= dict.fromkeys(place.signals, "trajectory")
        elif any(kind != "known" for kind in sources):
            first[place.name] = total
            total += place.layer.outputs
            random[place.name] = "function"
        else:
            random[place.name] = "known"
    return first, total
