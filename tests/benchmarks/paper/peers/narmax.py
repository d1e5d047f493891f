"""NARMAX: polynomial regressors selected by forward orthogonal least squares (FROLS)."""

from __future__ import annotations

import math
import time
import warnings
from typing import Any

import numpy as np

from tests.benchmarks.paper.peers.lags import Scaled, filled, missing_note
from tests.benchmarks.paper.prediction import Outcome, Predicted, Task

# Lags of the output; the inputs are seen at their present value and as many lags.
LAGS = 5
MOST_TERMS = 50
# With more inputs the candidates of degree 2 would be thousands.
MOST_INPUTS = 5
# Predictions further from the training mean than this, in standard deviations, are cut off.
BOUND = 10.0


def learn(u: np.ndarray, y: np.ndarray, degree: int) -> Any:
    """Model with the number of terms at which Akaike's criterion is smallest.

    The package itself stops at the first rise of the criterion, often far too early; all its
    values are looked at here. Its input lags begin at 1, so the inputs are given one sample early.
    """
    from sysidentpy.basis_function import Polynomial
    from sysidentpy.model_structure_selection import FROLS
    from sysidentpy.parameter_estimation import LeastSquares

    lags = list(range(1, LAGS + 2))
    settings = {
        "ylag": LAGS,
        "xlag": lags if u.shape[1] == 1 else [lags] * u.shape[1],
        "basis_function": Polynomial(degree=degree),
        "estimator": LeastSquares(),
    }
    regressors = LAGS + len(lags) * u.shape[1]
    terms = min(MOST_TERMS, math.comb(regressors + degree, degree))
    path = FROLS(order_selection=True, info_criteria="aic", n_info_values=terms, **settings)
    path.fit(X=early(u), y=y[:, None])
    best = int(np.nanargmin(path.info_values)) + 1
    return FROLS(order_selection=False, n_terms=best, **settings).fit(X=early(u), y=y[:, None])


def early(u: np.ndarray) -> np.ndarray:
    """Inputs one sample early; the last value is not used."""
    return np.concatenate([u[1:], u[-1:]])


def predict(task: Task) -> Outcome:
    """Select terms, then run freely. The selection has no clock: it takes what it takes."""
    begin = time.perf_counter()
    data = Scaled.of(task)
    degree = 2 if data.u.shape[1] <= MOST_INPUTS else 1
    with warnings.catch_warnings():
        # Lagged samples of a smooth signal are nearly dependent.
        warnings.filterwarnings("ignore", "Psi matrix might have linearly dependent rows")
        model = learn(data.u, filled(data.y), degree)
    seconds = time.perf_counter() - begin
    predictions, cut, notes = [], 0, [missing_note(data.y)]
    for test in data.tests:
        u_past, y_past = data.past(LAGS + 1)
        u = np.concatenate([u_past, test])
        with warnings.catch_warnings(), np.errstate(over="ignore", invalid="ignore"):
            # A polynomial that diverges overflows; where it does is cut, and the note says so.
            warnings.simplefilter("ignore", RuntimeWarning)
            run = model.predict(X=early(u), y=y_past[:, None])[LAGS + 1 :, 0]
        # Infinity less infinity is no number; it is counted with what is cut, at the mean.
        cut += int(np.sum(~(np.abs(run) <= BOUND)))
        run = np.clip(np.where(np.isnan(run), 0.0, run), -BOUND, BOUND)
        predictions.append(Predicted(data.unscaled(run)))
    notes.append(f"degree {degree}, {len(model.final_model)} terms")
    if cut:
        notes.append(f"free run diverged, {cut} samples cut at {BOUND:.0f} standard deviations")
    if seconds > task.seconds:
        notes.append("took longer than the limit, as the selection cannot be interrupted")
    return Outcome(predictions, seconds, 0, math.nan, "; ".join(filter(None, notes)))
