"""From a model and records to a fitted model: everything is checked, then the method runs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from pyro_dynogp.data.record import Record
from pyro_dynogp.inference.fitted import Fitted
from pyro_dynogp.inference.methods.base import Method, Problem
from pyro_dynogp.inference.methods.choose import method_of
from pyro_dynogp.inference.run import Run
from pyro_dynogp.models.model import Model
from pyro_dynogp.support.checkpoints import Checkpoints


def train_model(
    model: Model,
    record: Record | Sequence[Record],
    *,
    method: str | Method | None = None,
    options: Mapping[str, Any] | None = None,
    start: Fitted | None = None,
    seed: int = 0,
    restarts: int | None = None,
    steps: int | None = None,
    checkpoint: str | Path | None = None,
    workers: int | None = None,
    progress: bool = True,
) -> Fitted:
    """Fit a model; arguments and errors as of `pyro_dynogp.fit`."""
    chosen = method_of(method, model, options)
    run = Run(seed, workers, progress, restarts=restarts, steps=steps)
    chosen.check(model, warm=start is not None)
    records = model.check(record)
    scaled = model.scaled_to(records)
    learnt = None if start is None else dict(start.mode)
    kept = Checkpoints.at(
        checkpoint,
        scaled,
        [each.fingerprint for each in records],
        type(chosen).__name__,
        chosen.identity,
        (seed, restarts, steps),
        *([] if learnt is None else [{name: v.tolist() for name, v in learnt.items()}]),
    )
    run = Run(seed, workers, progress, kept, restarts, steps)
    return chosen(Problem(scaled, records, learnt), run)
