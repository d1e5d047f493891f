"""Shares of a prediction's variance by cause, from draws with causes switched on in turn."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from pyro_dynogp.models.draws import Drawn, Switches
from pyro_dynogp.models.system import System


def decompose(
    system: System, at: Callable[[Switches], Drawn], on: Switches, scale: np.ndarray
) -> dict[str, np.ndarray]:
    """Share of the variance by cause: what each adds when the causes are switched on in turn.

    The same random numbers serve all of them; the shares add up by construction.
    """
    parts: dict[str, np.ndarray] = {}
    total: np.ndarray | float = 0.0

    def add(cause: str, switches: Switches, whole: bool = False) -> None:
        nonlocal total
        drawn = at(switches)
        now = drawn.mean.reshape(-1, *drawn.mean.shape[-2:]).var(0, correction=0)
        if whole:
            now = now + drawn.variance.reshape(-1, *drawn.mean.shape[-2:]).mean(0)
        value = scale**2 * now.numpy()
        parts[cause] = value - total
        total = value

    current = Switches(False, frozenset(), False)
    add("parameters", current)
    current = replace(current, initial_state=True)
    add("initial state", current)
    for wire, _ in system.dynamic:
        if wire.name in on.process_noise:
            current = replace(current, process_noise=current.process_noise | {wire.name})
            add(f"process noise of {wire.name}", current, whole=wire.last)
    add("static functions", on, whole=True)
    return parts
