"""Refits of extended models, and how well they predict what they have not seen."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from types import MappingProxyType
from typing import Any, Literal

import numpy as np
from scipy.special import logsumexp

from pyro_dynogp.criticism.densities import pointwise_log_density
from pyro_dynogp.discrepancy.extend import Model
from pyro_dynogp.inference.fit import fit as fit_model
from pyro_dynogp.inference.maximum import maximise
from pyro_dynogp.inference.result import Fit
from pyro_dynogp.inference.starts import random_poles, starting_values, values_given_poles
from pyro_dynogp.models.cascade import Cascade
from pyro_dynogp.models.collapsed import collapsed_of
from pyro_dynogp.models.linear import LinearDynamicGP
from pyro_dynogp.prediction.beginning import beginning
from pyro_dynogp.prediction.linear import prior_process
from pyro_dynogp.record import Record

# Work spent on a refit: iterations and fresh starts beside the warm one, of linear models and of
# cascades.
LINEAR_STEPS, LINEAR_STARTS = 120, 2
CASCADE_STEPS, CASCADE_STARTS = 400, 6
Score = Literal["one step", "forecast"]
# How often the best variant is refined.
REFINEMENTS = 2


@dataclass(frozen=True)
class Trial:
    """One effect to be tried: variants of the extended model, and what to learn and score on.

    Attributes:
        models: variants, of which the one most probable on the training data is kept.
        record: without the block that nobody has seen.
        folds: (n,) True where a fold is scored; it is trained on the rest.
        refine: makes finer variants of the best one, given how many times it did so; none for none.
        poles: (P,) of the model that is extended [1/time unit], to start from; none for a cascade.
        seed: of fresh starts.
        score: what densities are of, see `held_out_density`.
    """

    models: tuple[Model, ...]
    record: Record
    folds: tuple[np.ndarray, ...]
    poles: np.ndarray | None
    seed: int
    score: Score = "one step"
    refine: Callable[[Model, int], Sequence[Model]] | None = None


@dataclass(frozen=True, eq=False)
class Tried:
    """Result of a trial.

    Attributes:
        model: the variant kept. densities: (N,) log-density of each output scored, fold after fold
            [nats].
        seconds: it took. failure: why there is no result, "" if there is one.
    """

    model: Model
    densities: np.ndarray
    seconds: float
    failure: str = ""


def run(trial: Trial) -> Tried:
    """Refit the variants on the first fold's training data, the best on all; score the folds."""
    begin = time.perf_counter()
    training = without(trial.record, trial.folds[0])
    several = len(trial.models) > 1
    problems: list[str] = []
    fitted: list[Fit] = []

    def look(models: Sequence[Model]) -> None:
        for model in models:
            try:
                fitted.append(quick_fit(model, training, trial.poles, trial.seed, short=several))
            except ValueError as error:  # for instance a channel that is constant there
                problems.append(str(error))

    def best() -> Fit:
        return min(fitted, key=lambda found: float(found.start_energies[0]))

    def unscaled(found: Fit) -> Model:
        return replace(found.model, scaling=None)

    look(trial.models)
    if not fitted:
        return Tried(trial.models[0], np.zeros(0), time.perf_counter() - begin, problems[0])
    if trial.refine is not None:
        for times in range(REFINEMENTS):
            look(trial.refine(unscaled(best()), times))
    model = unscaled(best())
    parts = []
    try:
        for index, fold in enumerate(trial.folds):
            if index == 0 and not several:  # fitted in full already
                found = best()
            else:
                found = quick_fit(model, without(trial.record, fold), trial.poles, trial.seed)
            parts.append(held_out_density(found, trial.record, fold, trial.score))
    except ValueError as error:
        problems.append(str(error))
        parts = [np.zeros(0)]
    seconds = time.perf_counter() - begin
    failure = problems[-1] if not len(parts[0]) else ""
    return Tried(model, np.concatenate(parts), seconds, failure)


def without(record: Record, fold: np.ndarray) -> Record:
    """The record with the outputs of a fold missing; cut where nothing is left to the end."""
    y = record.outputs.copy()
    y[fold] = np.nan
    there = np.flatnonzero(np.isfinite(y).any(1))
    return record.with_outputs(y)[: there[-1] + 1]


def quick_fit(
    model: Model, record: Record, poles: np.ndarray | None, seed: int, *, short: bool = False
) -> Fit:
    """Posterior mode of a model; a linear one starts from the poles of the one it extends, too.

    Args:
        model: the model. record: training record. poles: (P,) of a linear model [1/time unit].
        seed: of fresh starts. short: fewer iterations, to rank variants of a linear model.

    Raises:
        ValueError: where the record does not fit the model, or a channel is constant.
    """
    if isinstance(model, Cascade):
        return fit_model(
            replace(model, scaling=None), record, method="map", restarts=CASCADE_STARTS,
            steps=CASCADE_STEPS, seed=seed, workers=1, progress=False,
        )  # fmt: skip
    steps = LINEAR_STEPS // 3 if short else LINEAR_STEPS
    return _linear(replace(model, scaling=None), record, poles, seed, steps)


def _linear(
    model: LinearDynamicGP, record: Record, poles: np.ndarray | None, seed: int, steps: int
) -> Fit:
    records = model.check(record)
    model = model.scaled_to(record)
    assert model.scaling is not None
    starts = starting_values(model, records, count=LINEAR_STARTS, seed=seed)
    if poles is not None:
        generator = np.random.default_rng(seed)
        more = model.pairs - len(poles)
        for _ in range(1 if more <= 0 else 3):
            kept = poles[: model.pairs]
            if more > 0:
                fresh = random_poles(more, model.scaling, generator)
                kept = np.concatenate([kept, fresh])
            starts.append(values_given_poles(model, records, model.scaling, kept)[1])
    optima = maximise(model, records[0], starts, steps=steps, seed=seed, workers=1)
    best = optima[0]
    return Fit(
        model=model,
        method="map",
        draws=MappingProxyType({k: v.unsqueeze(0) for k, v in best.values.items()}),
        mode=MappingProxyType(dict(best.values)),
        history=best.history,
        start_energies=np.array([one.energy for one in optima]),
        diagnostics=MappingProxyType({"iterations": float(len(best.history))}),
        seed=seed,
        records=records,
    )


def poles_of(fit: Fit) -> np.ndarray | None:
    """Poles (P,) at the mode of a linear model [1/time unit]; None for a cascade."""
    if isinstance(fit.model, Cascade):
        return None
    poles: np.ndarray = fit._system_at(fit.mode).modes.poles.numpy()
    return poles


def held_out_density(fit: Fit, record: Record, fold: np.ndarray, score: Score) -> np.ndarray:
    """Log-densities (N,) of the measured outputs of a fold [nats].

    "one step": each given all outputs before it, of the mixture of the fit's draws; outputs of one
    time follow one another. What is wrong with the noise shows there. "forecast": each by itself,
    given the inputs and the outputs before the fold, as a normal whose standard deviation is that
    of the forecast times the factor that suits the fold best. What is wrong between inputs and
    output shows there, while outputs of one step before make up for much of it; and what is asked
    is which structure is right, not which posterior mode is least sure of itself.
    """
    prepared = fit.model.check(record)[0]
    if score == "one step":
        density = one_step_density(fit, prepared)[fold]
    else:
        first, last = np.flatnonzero(fold)[[0, -1]]
        future = prepared[first : last + 1]
        found = fit.forecast(prepared[:first], future, seed=fit.seed)
        z = (future.outputs - found.mean) / found.sd
        spread = np.sqrt(np.nanmean(z**2, axis=0))
        density = -0.5 * ((z / spread) ** 2 + np.log(2.0 * np.pi)) - np.log(spread * found.sd)
    return density[~prepared.missing[fold]]


def one_step_density(fit: Fit, record: Record) -> np.ndarray:
    """Log-density (n, n_y) of each output given the outputs before it, NaN where missing."""
    prepared = fit.model.check(record)[0]
    observed: Any
    if isinstance(fit.model, Cascade):
        observed = collapsed_of(beginning(fit, prepared), fit.scaling, prepared)
    else:
        observed = prior_process(fit, prepared, unknown_start=True).observed(fit.system.noise_sd)
    y = prepared.tensors().outputs
    y = y if fit.model.several_outputs else y[:, 0]
    each = pointwise_log_density(observed, y, "forecast")
    return logsumexp(each, axis=0) - np.log(len(each))


def blocks(count: int, folds: int) -> tuple[np.ndarray, ...]:
    """Contiguous folds (n,) of a record's samples."""
    edges = np.linspace(0, count, folds + 1).astype(int)
    index = np.arange(count)
    return tuple((index >= a) & (index < b) for a, b in pairwise(edges))
