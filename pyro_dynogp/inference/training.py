"""From a problem to a fitted model, its finished pieces kept in a folder."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from pyro_dynogp.inference.canonical import Canonical
from pyro_dynogp.inference.fitted import Fitted
from pyro_dynogp.inference.methods.base import Method, Problem
from pyro_dynogp.inference.run import Run
from pyro_dynogp.support.checkpoints import Checkpoints


def train_model(
    problem: Problem, method: Method, run: Run, checkpoint: str | Path | None = None
) -> Fitted:
    """Fit a model; see `pyro_dynogp.fit`.

    Args:
        problem: what is fitted to what. method, run: how. checkpoint: a folder for finished pieces.
    """
    kept = Checkpoints.at(
        checkpoint,
        model=replace(problem.model, scaling=None),  # the scaling is the records'
        record=[each.record.fingerprint for each in problem.records],
        start=problem.learnt,
        method=method,
        seed=run.seed,
        restarts=run.restarts,
        steps=run.steps,
    )
    canonical = Canonical.of(problem)
    return canonical.restored(method(canonical.problem, replace(run, checkpoints=kept)))
