"""What the peers share: scaling by the training record, lagged regressors, and the known past."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from tests.benchmarks.paper.prediction import Task


@dataclass(frozen=True, eq=False)
class Scaled:
    """A task in standard units: mean and standard deviation of the training record are 0 and 1.

    Attributes:
        u: (n, n_u) training inputs.
        y: (n,) training output; NaN where it was not measured.
        tests: (n_k, n_u) inputs of each test record.
        follows: as in the task.
        mean: of the training output, in its unit.
        sd: of the training output, in its unit.
    """

    u: np.ndarray
    y: np.ndarray
    tests: Sequence[np.ndarray]
    follows: bool
    mean: float
    sd: float

    @classmethod
    def of(cls, task: Task) -> Scaled:
        """Scale a task; it must have one output."""
        if task.train.n_outputs != 1:
            raise ValueError(f"the peers predict one output, not {task.train.n_outputs}")
        u, y = task.train.inputs, task.train.outputs[:, 0]
        centre, spread = u.mean(0), u.std(0)
        spread = np.where(spread > 0, spread, 1.0)
        mean, sd = float(np.nanmean(y)), float(np.nanstd(y))
        tests = [(np.asarray(test) - centre) / spread for test in task.inputs]
        return cls((u - centre) / spread, (y - mean) / sd, tests, task.follows, mean, sd)

    def unscaled(self, y: np.ndarray) -> np.ndarray:
        """Outputs in the record's unit."""
        return self.mean + self.sd * y

    def past(self, n: int) -> tuple[np.ndarray, np.ndarray]:
        """The n inputs and outputs just before a test record: measured, or zero for rest."""
        if self.follows:
            return self.u[-n:], filled(self.y)[-n:]
        return np.zeros((n, self.u.shape[1])), np.zeros(n)


def filled(y: np.ndarray) -> np.ndarray:
    """A series with its missing values interpolated linearly."""
    known = np.isfinite(y)
    at = np.arange(len(y))
    return np.asarray(np.interp(at, at[known], y[known]))


def missing_note(y: np.ndarray) -> str:
    """The sentence that goes with `filled` where it did something."""
    missing = int(np.sum(~np.isfinite(y)))
    return f"{missing} missing outputs interpolated" if missing else ""


def lagged(x: np.ndarray, lags: range, past: np.ndarray) -> np.ndarray:
    """Values of a series at some lags.

    Args:
        x: (n, d) series.
        lags: 0 is the present.
        past: (at least the largest lag, d) what came before the series.

    Returns:
        (n, len(lags) * d); the columns run over lags first, then over the d series.
    """
    whole, begin = np.concatenate([past, x]), len(past)
    return np.concatenate([whole[begin - k : begin - k + len(x)] for k in lags], axis=1)
