"""What a method says of a test record, and the scores it gets for that."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
import scoringrules

import pyro_dynogp as dgp

# What this library's default is called among the methods.
OURS = "pyro_dynogp"


def folder_name(method: str) -> str:
    """Name of the folder of a method's results."""
    return method.replace(", ", "-").replace(" ", "-")


@dataclass(frozen=True, eq=False)
class Predicted:
    """Prediction of the outputs of one test record, in the record's unit.

    Attributes:
        mean: (n,) point prediction.
        samples: (S, n) draws of the measured output, noise included; None for a point prediction.
    """

    mean: np.ndarray
    samples: np.ndarray | None = None


@dataclass(frozen=True, eq=False)
class Task:
    """What every method is given; nobody sees the test outputs.

    Attributes:
        train: record to learn from.
        inputs: inputs (n_k, n_u) of each test record.
        follows: whether the (only) test record begins right after the training record; else every
            test record starts from rest.
        test_process_noise: whether the test period has any, as the protocol says.
        noisy: for each dynamic layer, whether the architecture gives it process noise.
        architecture: layers in order: a number of conjugate pairs for linear dynamics, "static"
            for a nonlinear function; all but the last have `width` signals.
        width: number of signals between layers.
        seconds: most wall time for learning.
        seed: of everything random.
        more: further training records; only methods that learn from several are given tasks with
            any.
    """

    train: dgp.Record
    inputs: Sequence[np.ndarray]
    follows: bool
    test_process_noise: bool
    noisy: tuple[bool, ...]
    architecture: tuple[int | str, ...]
    width: int
    seconds: float
    seed: int = 0
    more: tuple[dgp.Record, ...] = ()

    @property
    def records(self) -> dgp.Record | tuple[dgp.Record, ...]:
        """All there is to learn from."""
        return (self.train, *self.more) if self.more else self.train


@dataclass(frozen=True, eq=False)
class Outcome:
    """What a method did with a task.

    Attributes:
        predictions: one for each test record.
        seconds: wall time of learning.
        steps: number of its iterations (0 where that means nothing) and seconds of one on the whole
            training record.
        note: what a reader should know, in a sentence; empty for nothing.
        figures: other numbers worth reporting, by name.
    """

    predictions: Sequence[Predicted]
    seconds: float
    steps: int = 0
    step_seconds: float = math.nan
    note: str = ""
    figures: dict[str, float] = field(default_factory=dict)


def scores(predicted: Predicted, y: np.ndarray, skip: int = 0) -> dict[str, float]:
    """Scores of one prediction of y (n,), without its first `skip` samples.

    RMSE and MAE are of the mean. CRPS, coverage of the 95 % band and log density are those of the
    samples (the log density of the normal with their mean and standard deviation); of a point
    prediction the CRPS is the MAE, as the paper has it.
    """
    keep = np.isfinite(y)
    keep[:skip] = False
    error = predicted.mean[keep] - y[keep]
    found = {
        "rmse": float(np.sqrt(np.mean(error**2))),
        "mae": float(np.mean(np.abs(error))),
    }
    if predicted.samples is None:
        return {**found, "crps": found["mae"], "coverage_95": math.nan, "log_density": math.nan}
    draws = predicted.samples[:, keep]
    low, high = np.quantile(draws, (0.025, 0.975), axis=0)
    mean, sd = draws.mean(0), draws.std(0) + 1e-300
    z = (y[keep] - mean) / sd
    return {
        **found,
        "crps": float(np.mean(crps_by_time(draws, y[keep]))),
        "coverage_95": float(np.mean((low <= y[keep]) & (y[keep] <= high))),
        "log_density": float(np.mean(-0.5 * z**2 - np.log(sd) - 0.5 * math.log(2 * math.pi))),
    }


def crps_by_time(samples: np.ndarray, y: np.ndarray) -> np.ndarray:
    """CRPS (n,) of every sample of y (n,), from draws (S, n)."""
    return np.asarray(scoringrules.crps_ensemble(y, samples.T))
