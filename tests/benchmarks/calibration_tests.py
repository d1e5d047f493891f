"""Rejection rates of the calibration test, on right predictions and on wrong ones."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy import stats

import pyro_dynogp as dgp
from pyro_dynogp.support.parallel import parallel_map
from tests.criticism.known import measured, predicted

SAMPLES, JOINT, REPLICATES = 500, 199, 200
LEVEL = 0.95
# First-order autocorrelation of the errors: of one-step predictions, and of free runs.
ERRORS = {"independent": 0.0, "autocorrelation 0.9": 0.9}
PREDICTIONS: dict[str, dict[str, float]] = {
    "right": {},
    "half the spread": {"scale": 0.5},
    "twice the spread": {"scale": 2.0},
    "one standard deviation too high": {"bias": 1.0},
}


@dataclass(frozen=True)
class _Task:
    correlation: float
    wrong: str
    seed: int


def examine(task: _Task) -> tuple[bool, bool]:
    """Whether one record rejects one prediction, and whether a test for independent values does."""
    options: dict[str, Any] = {"correlation": task.correlation, "seed": task.seed}
    made = predicted(SAMPLES, samples=JOINT, **options, **PREDICTIONS[task.wrong])
    found = dgp.calibration(made, measured(SAMPLES, **options), level=LEVEL)
    uniform = float(stats.kstest(found.pit[:, 0], "uniform").pvalue)
    return not bool(found.calibrated[0]), uniform < 1.0 - LEVEL


def run(folder: Path, replicates: int = REPLICATES, workers: int | None = 1) -> str:
    """A table of rejection rates with their exact binomial 95 % intervals."""
    del folder
    tasks = [
        _Task(correlation, wrong, 1000 + seed)
        for correlation in ERRORS.values()
        for wrong in PREDICTIONS
        for seed in range(replicates)
    ]
    results = parallel_map(
        examine, tasks, workers=workers, progress=True, description="calibration tests"
    )
    rejected = np.array(results).reshape(len(ERRORS), len(PREDICTIONS), replicates, 2).sum(2)
    lines = [
        f"`dgp.calibration` at 5 %: {SAMPLES} samples, {JOINT} joint samples, {replicates} "
        "replicates of each. Predictions are of a stationary autoregression around a known mean, "
        "which is what the errors of a free run are; without autocorrelation they are those of one "
        "step. In brackets the exact binomial 95 % interval. Beside it the Kolmogorov-Smirnov test "
        "of the same probability integral transforms, which takes them as independent.",
        "",
        "| errors | prediction | rejected | rate | Kolmogorov-Smirnov |",
        "|---" * 5 + "|",
    ]
    for i, errors in enumerate(ERRORS):
        for j, wrong in enumerate(PREDICTIONS):
            hits, naive = (int(count) for count in rejected[i, j])
            low, high = stats.binomtest(hits, replicates).proportion_ci()
            lines.append(
                f"| {errors} | {wrong} | {hits} of {replicates} | {100 * hits / replicates:.1f} % "
                f"({100 * low:.1f} to {100 * high:.1f}) | {100 * naive / replicates:.1f} % |"
            )
    hits = int(rejected[:, 0, :][:, 0].sum())
    total = replicates * len(ERRORS)
    low, high = stats.binomtest(hits, total).proportion_ci()
    lines.append(
        f"\nRight predictions, all together: {hits} of {total} rejected, "
        f"{100 * hits / total:.1f} % ({100 * low:.1f} to {100 * high:.1f})."
    )
    return "\n".join(lines)
