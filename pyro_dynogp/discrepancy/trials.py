"""Refits of extended models, and how well they predict what they have not seen."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.special import logsumexp

from pyro_dynogp.criticism.densities import pointwise_log_density
from pyro_dynogp.data.record import Record
from pyro_dynogp.effects.base import Compared, Score
from pyro_dynogp.fitting import Fit
from pyro_dynogp.inference.refit import energy, race, refit
from pyro_dynogp.inference.run import Run
from pyro_dynogp.models.delays import comparable
from pyro_dynogp.models.outputs import output_process
from pyro_dynogp.models.variants import Model
from pyro_dynogp.prediction.first_state import beginning
from pyro_dynogp.statistics.settings import LoopSettings


@dataclass(frozen=True)
class Trial:
    """One effect to be tried: variants of the extended model, and what to learn and score on.

    Attributes:
        models: variants, of which the one most probable on the training data is kept.
        record: without the block that nobody has seen.
        folds: (n,) True where a fold is scored; it is trained on the rest.
        refine: makes finer variants of the best one, given the training data and how many times it
            did so; none for none.
        base: fit of the model that is extended, to start from.
        seed: of fresh starts. settings: thresholds.
        score: what densities are of, see `held_out_density`.
        compared: on which data variants are, see `Effect`.
        fit: of a single model to the first fold's training data, where there is one already.
    """

    models: tuple[Model, ...]
    record: Record
    folds: tuple[np.ndarray, ...]
    base: Fit
    seed: int
    settings: LoopSettings
    score: Score = "one step"
    refine: Callable[[Model, Record, int], Sequence[Model]] | None = None
    compared: Compared = "training"
    fit: Fit | None = None

    @property
    def run(self) -> Run:
        """How refits are run: trials share the processors."""
        return Run(self.seed, workers=1)


@dataclass(frozen=True, eq=False)
class Tried:
    """Result of a trial.

    Attributes:
        model: the variant kept. densities: (N,) log-density of each output scored, fold after fold
            [nats].
        seconds: it took. failure: why there is no result, "" if there is one.
        fit: of the model to the first fold's training data.
        errors: (M, n_y) where densities are one step ahead, errors of forecasts of the same
            stretches beside them [output], NaN where missing.
    """

    model: Model
    densities: np.ndarray
    seconds: float
    failure: str = ""
    fit: Fit | None = None
    errors: np.ndarray = field(default_factory=lambda: np.zeros((0, 1)))


def run(trial: Trial) -> Tried:
    """Refit the variants on the first fold's training data, the best on all; score the folds."""
    begin = time.perf_counter()
    first: Fit | None = None
    parts, beside = [np.zeros(0)], [np.zeros((0, trial.record.n_outputs))]
    failure = ""
    try:
        first = _kept(trial, without(trial.record, trial.folds[0]))
        for index, fold in enumerate(trial.folds):
            found = first
            if index > 0:
                rest = without(trial.record, fold)
                found = refit(trial.base, rest, model=first.model, run=trial.run)
            parts.append(held_out_density(found, trial.record, fold, trial.score))
            if trial.score == "one step":
                beside.append(forecast_errors(found, trial.record, fold)[0][fold])
    except ValueError as error:
        failure, parts = str(error), [np.zeros(0)]
    return Tried(
        trial.models[0] if first is None else _unscaled(first),
        np.concatenate(parts),
        time.perf_counter() - begin,
        failure,
        first,
        np.concatenate(beside),
    )


def _kept(trial: Trial, training: Record) -> Fit:
    """The variant that is kept, fitted to the training data."""
    if trial.fit is not None:
        return trial.fit
    if len(trial.models) > 1 and trial.compared == "held out":
        return _best_ahead(trial, training)
    (model, *others), start = trial.models, trial.base
    finer = _finer(trial, model, training, 0)
    if others or finer:
        same = comparable(training, [*trial.models, *finer], trial.settings.reach)
        found, problems = race(trial.base, trial.models, same, trial.run)
        if not found:
            raise ValueError(problems[0])
        start = found[0]
        for times in range(trial.settings.refinements):
            finer = _finer(trial, _unscaled(start), training, times)
            start = min([start, *race(start, finer, same, trial.run)[0]], key=energy)
        model = start.model
    return refit(start, training, model=model, run=trial.run)


def _finer(trial: Trial, model: Model, training: Record, times: int) -> Sequence[Model]:
    """Variants close to a model."""
    return [] if trial.refine is None else trial.refine(model, training, times)


def _best_ahead(trial: Trial, training: Record) -> Fit:
    """The first variant that does as well as the best on the data held out."""
    fits = [refit(trial.base, training, model=model, run=trial.run) for model in trial.models]
    sums = [held_out_density(f, trial.record, trial.folds[0], trial.score).sum() for f in fits]
    least = max(sums) - trial.settings.gain
    return next(f for f, total in zip(fits, sums, strict=True) if total >= least)


def _unscaled(fit: Fit) -> Model:
    model: Model = replace(fit.model, scaling=None)
    return model


def without(record: Record, fold: np.ndarray) -> Record:
    """The record with the outputs of a fold missing; cut where nothing is left to the end."""
    y = record.outputs.copy()
    y[fold] = np.nan
    there = np.flatnonzero(np.isfinite(y).any(1))
    return record.with_outputs(y)[: there[-1] + 1]


def held_out_density(fit: Fit, record: Record, fold: np.ndarray, score: Score) -> np.ndarray:
    """Log-densities (N,) of the measured outputs of a fold [nats].

    "one step": each given all outputs before it, of the mixture of the fit's draws; outputs of one
    time follow one another. What is wrong with the noise shows there. "forecast": each by itself,
    given the inputs and the outputs before its stretch of the fold, as a normal whose standard
    deviation is that of the forecast times the factor that suits the fold best. What is wrong
    between inputs and output shows there, while outputs of one step before make up for much of it;
    and what is asked is which structure is right, not which posterior mode is least sure of itself.
    """
    prepared = fit.model.check(record)[0]
    there = ~prepared.missing
    if score == "one step":
        density = one_step_density(fit, prepared)[fold]
    else:
        error, sd = forecast_errors(fit, prepared, fold)
        density = forecast_density(error[fold], sd[fold])
    scored: np.ndarray = density[there[fold]]
    return scored


def forecast_density(error: np.ndarray, sd: np.ndarray) -> np.ndarray:
    """Log-densities (n, n_y) of errors under the sds times the factor that suits them best [nats].

    NaN where the errors are.
    """
    z = error / sd
    spread = np.sqrt(np.nanmean(z**2, axis=0))
    density: np.ndarray = -0.5 * ((z / spread) ** 2 + np.log(2.0 * np.pi)) - np.log(spread * sd)
    return density


def forecast_errors(fit: Fit, record: Record, fold: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Errors (n, n_y) of forecasts of every stretch of a fold from its past, and their sds.

    In units of the output, NaN outside the fold; errors are NaN where the output is missing, too.
    """
    prepared = fit.model.check(record)[0]
    error = np.full(prepared.outputs.shape, np.nan)
    sd = error.copy()
    for part in stretches(fold):
        found = fit.forecast(prepared[: part.start], prepared[part], seed=fit.seed)
        error[part] = prepared.outputs[part] - found.mean
        sd[part] = found.sd
    return error, sd


def one_step_density(fit: Fit, record: Record) -> np.ndarray:
    """Log-density (n, n_y) of each output given the outputs before it, NaN where missing."""
    (along,) = fit.model.prepare(record)
    outputs = output_process(beginning(fit, along, predicting=True), along)
    each = pointwise_log_density(outputs, along.observations, "forecast")
    return logsumexp(each, axis=0) - np.log(len(each))


def stretches(mask: np.ndarray) -> list[slice]:
    """Stretches of samples for which a mask (n,) holds."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], mask.astype(int), [0]])))
    return [slice(int(a), int(b)) for a, b in zip(edges[::2], edges[1::2], strict=True)]


def interleaved(count: int, blocks: int) -> tuple[np.ndarray, ...]:
    """Two folds (n,): every other block of a record, and those between but for the first.

    What happens at one instant has data on either side of it in both.
    """
    number = np.arange(count) * blocks // max(count, 1)
    return (number % 2 == 1), ((number % 2 == 0) & (number > 0))
