"""Refits of extended models, and how well they predict what they have not seen."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import numpy as np
from scipy.special import logsumexp

from pyro_dynogp.criticism.densities import pointwise_log_density
from pyro_dynogp.discrepancy.extend import Model, has_function
from pyro_dynogp.inference.cascade_fit import climb, grow, starting_points
from pyro_dynogp.inference.checkpoints import NOTHING_KEPT
from pyro_dynogp.inference.fit import at_optimum
from pyro_dynogp.inference.maximum import Optimum, maximise
from pyro_dynogp.inference.result import Fit
from pyro_dynogp.inference.starts import (
    grown,
    random_poles,
    starting_values,
    values_given_poles,
)
from pyro_dynogp.models.cascade import Cascade
from pyro_dynogp.models.collapsed import collapsed_of
from pyro_dynogp.models.linear import LinearDynamicGP
from pyro_dynogp.prediction.beginning import beginning
from pyro_dynogp.prediction.linear import prior_process
from pyro_dynogp.record import Record

# Work spent on a refit: iterations and fresh starts beside the warm one, of linear models and of
# cascades.
LINEAR_STEPS, LINEAR_STARTS = 120, 2
CASCADE_STEPS, CASCADE_STARTS = 300, 4
# Iterations from what the base of a cascade has learnt.
WARM_STEPS = 100
# Blocks of a record on which effects of one instant are scored, every other one at a time.
BLOCKS = 12
Score = Literal["one step", "forecast"]
# Starts that climb side by side: processors are kept busy by other trials.
TOGETHER = 8
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
        base: fit of the model that is extended, to start from.
        seed: of fresh starts.
        score: what densities are of, see `held_out_density`.
        fit: of a single model to the first fold's training data, where there is one already.
    """

    models: tuple[Model, ...]
    record: Record
    folds: tuple[np.ndarray, ...]
    base: Fit
    seed: int
    score: Score = "one step"
    refine: Callable[[Model, int], Sequence[Model]] | None = None
    fit: Fit | None = None


@dataclass(frozen=True, eq=False)
class Tried:
    """Result of a trial.

    Attributes:
        model: the variant kept. densities: (N,) log-density of each output scored, fold after fold
            [nats].
        seconds: it took. failure: why there is no result, "" if there is one.
        fit: of the model to the first fold's training data.
        forecasts: (N,) where densities are one step ahead, those of forecasts beside them.
    """

    model: Model
    densities: np.ndarray
    seconds: float
    failure: str = ""
    fit: Fit | None = None
    forecasts: np.ndarray = field(default_factory=lambda: np.zeros(0))


def run(trial: Trial) -> Tried:
    """Refit the variants on the first fold's training data, the best on all; score the folds."""
    begin = time.perf_counter()
    training = without(trial.record, trial.folds[0])
    several = len(trial.models) > 1
    poles = poles_of(trial.base)
    problems: list[str] = []
    fitted: list[Fit] = []

    def look(models: Sequence[Model]) -> None:
        for model in models:
            try:
                found = quick_fit(model, training, poles, trial.seed, trial.base, short=several)
                fitted.append(found)
            except ValueError as error:  # for instance a channel that is constant there
                problems.append(str(error))

    def best() -> Fit:
        return min(fitted, key=lambda found: float(found.start_energies[0]))

    def unscaled(found: Fit) -> Model:
        return replace(found.model, scaling=None)

    if trial.fit is not None:
        fitted.append(trial.fit)
    else:
        look(trial.models)
    if not fitted:
        return Tried(trial.models[0], np.zeros(0), time.perf_counter() - begin, problems[0])
    if trial.refine is not None and several:
        for times in range(REFINEMENTS):
            look(trial.refine(unscaled(best()), times))
    model = unscaled(best())
    parts, beside, first = [], [np.zeros(0)], best()
    try:
        for index, fold in enumerate(trial.folds):
            if index == 0:
                if several:  # so far only to rank it
                    first = quick_fit(model, training, poles, trial.seed, trial.base)
                found = first
            else:
                rest = without(trial.record, fold)
                found = quick_fit(model, rest, poles, trial.seed, trial.base)
            parts.append(held_out_density(found, trial.record, fold, trial.score))
            if trial.score == "one step":
                beside.append(held_out_density(found, trial.record, fold, "forecast"))
    except ValueError as error:
        problems.append(str(error))
        parts = [np.zeros(0)]
    seconds = time.perf_counter() - begin
    failure = problems[-1] if not len(parts[0]) else ""
    densities, forecasts = np.concatenate(parts), np.concatenate(beside)
    return Tried(model, densities, seconds, failure, first, forecasts)


def without(record: Record, fold: np.ndarray) -> Record:
    """The record with the outputs of a fold missing; cut where nothing is left to the end."""
    y = record.outputs.copy()
    y[fold] = np.nan
    there = np.flatnonzero(np.isfinite(y).any(1))
    return record.with_outputs(y)[: there[-1] + 1]


def quick_fit(
    model: Model,
    record: Record,
    poles: np.ndarray | None,
    seed: int,
    base: Fit | None = None,
    *,
    short: bool = False,
) -> Fit:
    """Posterior mode of a model, from few starts and from the fit of the model it extends.

    Args:
        model: the model. record: training record. poles: (P,) of a linear model [1/time unit].
        seed: of fresh starts. base: fit of the model that it extends, where it may start.
        short: fewer iterations, to rank variants.

    Raises:
        ValueError: where the record does not fit the model, or a channel is constant.
    """
    records = model.check(record)
    scaled = replace(model, scaling=None).scaled_to(records)
    if isinstance(scaled, Cascade):
        optima = _cascade(scaled, records, seed, base, short)
    else:
        steps = LINEAR_STEPS // 3 if short else LINEAR_STEPS
        optima = _linear(scaled, records, poles, seed, steps, base)
    return at_optimum(scaled, optima, seed, records)


def _linear(
    model: LinearDynamicGP,
    records: Sequence[Record],
    poles: np.ndarray | None,
    seed: int,
    steps: int,
    base: Fit | None,
) -> list[Optimum]:
    """Fresh starts, from the poles of the base, and from all that it has learnt."""
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
    if base is not None and not isinstance(base.model, Cascade):
        starts.append(grown(base.mode, starts[-1]))
    return maximise(
        model, records[0], starts, optimizer="preconditioned", steps=steps, seed=seed, workers=1,
        together=TOGETHER,
    )  # fmt: skip


def _cascade(
    model: Cascade, records: Sequence[Record], seed: int, base: Fit | None, short: bool
) -> list[Optimum]:
    """From what the base has learnt, where it has the same layers; else from fresh starts.

    Without a function a cascade starts at its optimum but for the noise: one start is enough.
    """
    target, record = model.collapsed, records[0]
    before = None if base is None else base.model
    if base is None or not isinstance(before, Cascade) or len(before.layers) != len(model.layers):
        count = CASCADE_STARTS if has_function(model) else 1
        starts = starting_points(target, records, count, LINEAR_STEPS, seed, 1, False, NOTHING_KEPT)
        return climb(
            target, record, starts, [], optimizer="adam", steps=CASCADE_STEPS, seed=seed,
            workers=1, together=TOGETHER,
        )  # fmt: skip
    linear = 5 if short else LINEAR_STEPS // 3
    (start,) = starting_points(target, records, 1, linear, seed, 1, False, NOTHING_KEPT)
    learnt = grown(base.mode, start, silent=True)
    steps = WARM_STEPS // 3 if short else WARM_STEPS
    return grow(target, record, learnt, start, steps=steps, seed=seed)


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
    given the inputs and the outputs before its stretch of the fold, as a normal whose standard
    deviation is that of the forecast times the factor that suits the fold best. What is wrong
    between inputs and output shows there, while outputs of one step before make up for much of it;
    and what is asked is which structure is right, not which posterior mode is least sure of itself.
    """
    prepared = fit.model.check(record)[0]
    there = ~prepared.missing
    if score == "one step":
        density = one_step_density(fit, prepared)
    else:
        density = np.full(there.shape, np.nan)
        z, sd = density.copy(), density.copy()
        for part in stretches(fold):
            found = fit.forecast(prepared[: part.start], prepared[part], seed=fit.seed)
            z[part] = (prepared.outputs[part] - found.mean) / found.sd
            sd[part] = found.sd
        spread = np.sqrt(np.nanmean(z[fold] ** 2, axis=0))
        density = -0.5 * ((z / spread) ** 2 + np.log(2.0 * np.pi)) - np.log(spread * sd)
    scored: np.ndarray = density[fold][there[fold]]
    return scored


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


def stretches(mask: np.ndarray) -> list[slice]:
    """Stretches of samples for which a mask (n,) holds."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], mask.astype(int), [0]])))
    return [slice(int(a), int(b)) for a, b in zip(edges[::2], edges[1::2], strict=True)]


def interleaved(count: int) -> tuple[np.ndarray, ...]:
    """Two folds (n,): every other block of a record, and those between but for the first.

    What happens at one instant has data on either side of it in both.
    """
    number = np.arange(count) * BLOCKS // max(count, 1)
    return (number % 2 == 1), ((number % 2 == 0) & (number > 0))
