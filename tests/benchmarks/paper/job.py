"""One method on one experiment with one seed, in a process of its own: time and memory are its own.

Run as ``python -m tests.benchmarks.paper.job EXPERIMENT METHOD SEED FILE``.
"""

from __future__ import annotations

import json
import resource
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

from tests.benchmarks.circumstances import budget, here
from tests.benchmarks.paper import ours
from tests.benchmarks.paper.experiments import EXPERIMENTS
from tests.benchmarks.paper.peers import PEERS
from tests.benchmarks.paper.prediction import OURS, Outcome, Task, crps_by_time, scores

METHODS: dict[str, Callable[[Task], Outcome]] = {
    OURS: ours.cascade,
    ours.STACK: ours.stacked,
    f"{OURS}, linear": ours.linear,
    **PEERS,
}


def work(experiment: str, method: str, seed: int, file: Path) -> None:
    """Learn, predict, score; write the scores as JSON and the predictions beside them."""
    chosen = EXPERIMENTS[experiment]
    circumstances = here()  # before the machine is busy
    task, tests, clean = chosen.task(seed)
    task = replace(task, seconds=budget(task.seconds))
    outcome = METHODS[method](task)
    memory = max(
        resource.getrusage(who).ru_maxrss
        for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)
    )
    row = {
        "experiment": experiment,
        "method": method,
        "seed": seed,
        **circumstances,
        "seconds": outcome.seconds,
        "steps": outcome.steps,
        "step_seconds": outcome.step_seconds,
        "memory_gb": memory / 1e6,
        "note": outcome.note,
        "figures": outcome.figures,
        "scores": {},
    }
    arrays = {}
    for (name, record), predicted in zip(tests.items(), outcome.predictions, strict=True):
        y = record.outputs[:, 0]
        found = scores(predicted, y, chosen.skip)
        if name in clean:
            found |= against_clean(predicted.mean, y, clean[name])
        row["scores"][name] = found
        arrays[f"{name}/mean"] = predicted.mean.astype(np.float32)
        if predicted.samples is not None:
            low, high = np.quantile(predicted.samples, (0.025, 0.975), axis=0)
            arrays[f"{name}/low"], arrays[f"{name}/high"] = low, high
            arrays[f"{name}/crps"] = crps_by_time(predicted.samples, y)
    file.parent.mkdir(parents=True, exist_ok=True)
    np.savez_compressed(file.with_suffix(".npz"), **arrays)
    file.write_text(json.dumps(row, indent=1))


def against_clean(mean: np.ndarray, y: np.ndarray, clean: np.ndarray) -> dict[str, float]:
    """Scores where the noise-free output is known: errors over the noise floor, and the start."""
    floor = float(np.sqrt(np.mean((y - clean) ** 2)))
    error = np.abs(mean - y)
    return {
        "floor": floor,
        "rmse_over_floor": float(np.sqrt(np.mean((mean - y) ** 2))) / floor,
        "rmse_clean": float(np.sqrt(np.mean((mean - clean) ** 2))),
        "mae_first_150": float(error[:150].mean()),
        "mae_after": float(error[150:].mean()),
    }


if __name__ == "__main__":
    work(sys.argv[1], sys.argv[2], int(sys.argv[3]), Path(sys.argv[4]))
