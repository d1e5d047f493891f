"""How a fit is run: one object, made where the run begins and handed down."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pyro_dynogp.support.checkpoints import NOTHING_KEPT, Checkpoints
from pyro_dynogp.support.errors import invalid


def at_least_one(**counts: int | None) -> None:
    """Refuse numbers below one by their names; None is none given.

    Raises:
        ValueError: where one of them is not a positive whole number.
    """
    for name, count in counts.items():
        if count is not None and (not isinstance(count, int | np.integer) or count < 1):
            raise invalid(name, expected="a whole number >= 1", got=repr(count))


@dataclass(frozen=True)
class Run:
    """How a fit is run.

    Attributes:
        seed: of everything that is drawn. workers: processes, None for all processors.
        progress: whether to show progress bars. checkpoints: where finished pieces are kept.
        restarts: number of starting points, None for what the method and the model suggest, 0 for
            the fit to start from alone.
        steps: most iterations, None for the same.

    Raises:
        ValueError: where restarts is negative, or steps not a positive number.
    """

    seed: int = 0
    workers: int | None = None
    progress: bool = False
    checkpoints: Checkpoints = NOTHING_KEPT
    restarts: int | None = None
    steps: int | None = None

    def __post_init__(self) -> None:
        at_least_one(restarts=self.restarts or None, steps=self.steps, workers=self.workers)
