"""How a fit is run: one object, made where the run begins and handed down."""

from __future__ import annotations

from dataclasses import dataclass

from pyro_dynogp.support.checkpoints import NOTHING_KEPT, Checkpoints
from pyro_dynogp.support.errors import verify


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
        ValueError: where a number is not what it has to be.
    """

    seed: int = 0
    workers: int | None = None
    progress: bool = False
    checkpoints: Checkpoints = NOTHING_KEPT
    restarts: int | None = None
    steps: int | None = None

    def __post_init__(self) -> None:
        verify(seed=self.seed, workers=self.workers, restarts=self.restarts, steps=self.steps)
