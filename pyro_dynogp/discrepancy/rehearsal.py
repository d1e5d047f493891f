"""Rehearsals: whether what an effect adds goes on as it has begun, in data that are known."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from pyro_dynogp.data.record import Record
from pyro_dynogp.discrepancy.held_out import forecast_errors, without
from pyro_dynogp.discrepancy.stretches import stretches
from pyro_dynogp.fitting import Fit
from pyro_dynogp.inference.refit import refit
from pyro_dynogp.inference.run import Run
from pyro_dynogp.statistics.settings import LoopSettings


def lasting(
    fits: Sequence[Fit],
    base: Fit,
    record: Record,
    fold: np.ndarray,
    run: Run,
    settings: LoopSettings,
) -> list[Fit]:
    """Those of several extended fits that forecast no worse than the base held at its last level.

    They are put to the test twice: in the fold, and, fitted to the first half of the training
    data, in the second half. What drifts at random goes anywhere from where it is, and the last
    level is its best forecast; a line through its past is a good one by luck, and seldom twice.

    Args:
        fits: of extended models to what is not in the fold. base: fit of the model without, to the
            same data. record: blocks A and B. fold: (n,) True where it is scored.
        run: of refits. settings: how much worse is worse, and how long the last level is.
    """
    held = held_errors(base, record, fold, settings)
    kept = [
        fit for fit in fits if not is_worse(forecast_errors(fit, record, fold)[0], held, settings)
    ]
    training = without(record, fold)
    later = last_half(training)
    half = training[: int(np.argmax(later))]
    try:
        held = held_errors(refit(base, half, model=base.model, run=run), training, later, settings)
    except ValueError:  # a half in which an input never moves says nothing
        return kept
    return [fit for fit in kept if _lasts(fit, half, training, later, held, run, settings)]


def _lasts(
    fit: Fit,
    half: Record,
    training: Record,
    later: np.ndarray,
    held: np.ndarray,
    run: Run,
    settings: LoopSettings,
) -> bool:
    """Whether an extended model that is fitted to a half forecasts the other one no worse."""
    try:
        again = refit(fit, half, model=fit.model, run=run)
    except ValueError:  # nor does one in which a ramp has not begun
        return True
    return not is_worse(forecast_errors(again, training, later)[0], held, settings)


def last_half(record: Record) -> np.ndarray:
    """(n,) True in the second half of the samples that were measured, and between them."""
    measured = np.flatnonzero(~record.missing.all(1))
    return np.arange(len(record)) >= measured[len(measured) // 2]


def held_errors(fit: Fit, record: Record, fold: np.ndarray, settings: LoopSettings) -> np.ndarray:
    """Errors (n, n_y) in a fold of what a fit simulates, held at its last level [output].

    To the simulation the mean of its last errors before each stretch of the fold is added, over
    `settings.level_samples` samples. NaN outside the fold, and where the output is missing.
    """
    prepared = fit.model.check(record)[0]
    options = {} if fit.model.is_linear else {"process_noise": False}
    left = prepared.outputs - fit.simulate(prepared, seed=fit.seed, **options).mean
    error = np.full(left.shape, np.nan)
    for part in stretches(fold):
        past = left[: part.start]
        for a in range(left.shape[1]):
            known = past[np.isfinite(past[:, a]), a][-settings.level_samples :]
            error[part, a] = left[part, a] - (known.mean() if len(known) else 0.0)
    return error


def is_worse(errors: np.ndarray, held: np.ndarray, settings: LoopSettings) -> bool:
    """Whether errors (n, n_y) are larger than others, outputs in units of the others' RMSE.

    By more than `settings.worse` in the root mean square over all that is finite in both.
    """
    ratio = np.square(errors) / np.nanmean(np.square(held), axis=0)
    return bool(np.sqrt(np.nanmean(ratio)) > settings.worse)
