"""Refits of extended models, and what they come to on what they have not seen."""

from __future__ import annotations

import itertools
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from pyro_dynogp.data.channels import prepared
from pyro_dynogp.data.record import Record
from pyro_dynogp.discrepancy.held_out import certain, held_out_density, scored, without
from pyro_dynogp.discrepancy.rehearsal import lasting
from pyro_dynogp.effects.base import Compared, Score
from pyro_dynogp.fitting import Fit
from pyro_dynogp.inference.bayes_factor import VERY_STRONG, energy, log_bayes_factor
from pyro_dynogp.inference.refit import race, refit, refits
from pyro_dynogp.inference.run import Run
from pyro_dynogp.models.delays import comparable, longest_delay
from pyro_dynogp.models.feedback_variants import with_usual_substeps
from pyro_dynogp.models.variants import Model
from pyro_dynogp.statistics.settings import LoopSettings

# Most steps of one size that a number of a variant takes.
MOVES = 4
# A signal that varies by no more than this share of its size is constant, as for a fit.
CONSTANT = 1e-12
# Errors of forecasts are noise alone up to so many of its standard deviations: parameters learnt
# from a few hundred samples add some percent, and so many errors tell their size to four.
NOISE_ALONE = 1.1
# Other dynamics are tried beside more than this: what an effect leaves that is not described is
# several times the noise, and parameters of a step or a cube, learnt from 500 samples of systems
# with friction, add up to half of it. They take most of the time.
LITTLE_ELSE = 1.5


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
        errors: (M, n_y) of forecasts of the stretches scored, fold after fold [output], NaN where
            missing.
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
            density, error = scored(found, trial.record, fold, trial.score)
            parts.append(density)
            beside.append(error)
    except ValueError as error:
        failure, parts = why_not(trial, error), [np.zeros(0)]
    return Tried(
        trial.models[0] if first is None else _unscaled(first),
        np.concatenate(parts),
        time.perf_counter() - begin,
        failure,
        first,
        np.concatenate(beside),
    )


def why_not(trial: Trial, error: ValueError) -> str:
    """Why none of the variants could be fitted, in words of the data rather than of the refit."""
    several = len(trial.folds) > 1
    where = "training blocks" if several else "training block"
    reasons: list[str] = []
    for model, fold in itertools.product(trial.models, trial.folds):
        names = [name for channel in model.channels for name in channel.names]
        if len(set(names)) < len(names):
            twice = next(name for name in names if names.count(name) > 1)
            reasons.append(f"the model has {twice!r} already")
            continue
        training = without(trial.record, fold)
        for place, channel in enumerate(model.channels):
            columns = channel.columns(prepared(training, model.channels[:place]))
            for name, x in zip(channel.names, columns.T, strict=True):
                if np.ptp(x) <= CONSTANT * np.abs(x).max():
                    reasons.append(f"{name!r} is constant on the {where}")
    # What else a refit refuses, without what its caller should do about it.
    return reasons[0] if reasons else str(error).partition(". ")[0].rstrip(".")


def _kept(trial: Trial, training: Record) -> Fit:
    """The variant that is kept, fitted to the training data."""
    if trial.fit is not None:
        return trial.fit
    if len(trial.models) > 1 and trial.compared != "training":
        return _best_ahead(trial, training)
    (model, *others), start = trial.models, trial.base
    finer = _finer(trial, model, training, 0)
    if others or finer:
        same = comparable(training, [*trial.models, *finer], trial.settings.reach)
        found, problems = race(trial.base, trial.models, same, trial.run)
        if not found:
            raise problems[0]
        start = found[0]
        longest = trial.settings.reach * longest_delay(*trial.models, *finer)
        for times in range(trial.settings.refinements):
            start = _refined(trial, start, training, same, times, longest)
        model = start.model
        if model.has_function:  # few steps may have led to a poor optimum
            start, model = trial.base, _unscaled(start)
    return refit(start, training, model=model, run=trial.run)


def _finer(trial: Trial, model: Model, training: Record, times: int) -> Sequence[Model]:
    """Variants close to a model."""
    return [] if trial.refine is None else trial.refine(model, training, times)


def _refined(
    trial: Trial, start: Fit, training: Record, same: Record, times: int, longest: float
) -> Fit:
    """The best of variants close to one, then of those close to that, for as long as they gain.

    Hooke & Jeeves (J. ACM 8:212, 1961): steps are made smaller where none of them leads further.

    Args:
        start: a mode. same: the training data on which variants are compared. times: which steps.
        longest: delay that variants may have there.
    """
    for _ in range(MOVES):
        here = _unscaled(start)
        close = _finer(trial, here, training, times)
        known = [one for one in close if longest_delay(one) <= longest]
        if not known:
            break
        # The variant itself takes part: all climb further in a race.
        ranked, _ = race(start, [here, *known], same, trial.run)
        own = next(one for one in ranked if _unscaled(one) == here)
        start = ranked[0]
        if energy(own) - energy(start) <= trial.settings.gain:
            break
    return start


def _best_ahead(trial: Trial, training: Record) -> Fit:
    """The first variant, or a later one that is certainly better on the data held out.

    A block that goes beyond what the training data have seen says little of a shape: of shapes that
    forecast no worse the one is kept that is more probable given the training data.

    Where they differ in how they extrapolate what is right in one stretch may be luck: of those
    that are rehearsed only those count whose forecasts are no worse than those of the base held at
    its last level, or else the last one, which leaves most open. Of others the first two are
    fitted, and later ones while none leaves nothing but noise; those that join what two earlier
    ones have, which take most of the time, only where one of these forecasts best, and better than
    the base; other dynamics only beside more than `LITTLE_ELSE`, of the noise of the base, too.
    Variants that cannot be fitted are left out.
    """
    fold, settings = trial.folds[0], trial.settings
    problems: list[ValueError] = []

    def refitted(models: Sequence[Model]) -> list[Fit]:
        fits, why = refits(trial.base, models, training, lambda _: trial.run)
        problems.extend(why)
        return fits

    def rated(fits: Sequence[Fit]) -> list[tuple[Fit, np.ndarray, np.ndarray]]:
        return [(fit, *scored(fit, trial.record, fold, trial.score)) for fit in fits]

    if trial.compared == "rehearsed":
        # But those that the training data say nothing of, as a later ramp.
        fits = refitted(trial.models)
        if fits:
            fits = lasting(fits, trial.base, trial.record, fold, trial.run, settings) or fits[-1:]
        found = rated(fits)
    else:
        found = rated(refitted(trial.models[:2]))
        for place, model in enumerate(trial.models[2:], 2):
            if found:
                leading, most, errors = max(found, key=lambda one: float(one[1].sum()))
                if are_noise(errors, leading):
                    break
                if _has_other_dynamics(model) and all(
                    are_noise(errors, fit, LITTLE_ELSE) for fit in (leading, trial.base)
                ):
                    continue
                joined = [_back(one) for one in trial.models[:place] if _back(one) < _back(model)]
                if len(joined) > 1:
                    least = held_out_density(trial.base, trial.record, fold, trial.score)
                    if most.sum() <= least.sum() or _back(leading.model) not in joined:
                        continue
            found += rated(refitted([model]))
    if not found:
        raise problems[0]
    shape = trial.compared == "held out"
    best, highest, _ = found[0]
    for one, own, _ in found[1:]:
        gain = own - highest
        if certain(gain, settings) or (shape and _is_more_probable(one, best, gain, settings)):
            best, highest = one, own
    return best


def _back(model: Model) -> set[str]:
    """Names of what acts back on the dynamics."""
    return {name for _, layer in model.dynamic for name in layer.feedback}


def _has_other_dynamics(model: Model) -> bool:
    """Whether dynamics are a chain of lags, or have more hidden signals than outputs."""
    return any(layer.real or layer.mostly_hidden for _, layer in model.dynamic)


def are_noise(errors: np.ndarray, fit: Fit, most: float = NOISE_ALONE) -> bool:
    """Whether errors (M, n_y) of forecasts are at most so often the noise that a fit has learnt."""
    if fit.system.noise.constant_sd is None:  # its size varies
        return False
    rmse = np.sqrt(np.nanmean(np.square(errors), axis=0))
    return bool((rmse <= most * fit.noise_sd).all())


def _is_more_probable(one: Fit, best: Fit, gain: np.ndarray, settings: LoopSettings) -> bool:
    """Whether there is very strong evidence for a variant in the data of both, learnt and held out.

    The density of the data held out adds to the evidence of those learnt from. Neither may speak
    against it: these with very strong evidence, those with certainty. A block is short.

    Args:
        gain: of its log-density on held-out data [nats].
    """
    factor = log_bayes_factor(one, best)
    against = factor < -VERY_STRONG or certain(-gain, settings)
    return factor + float(gain.sum()) > VERY_STRONG and not against


def with_substeps(trial: Trial, tried: Tried) -> Tried:
    """What was kept, with the usual substeps of a step in feedback where they are certainly better.

    A step takes three times as long with its substeps: what is added gets them, and keeps them in
    the rounds to come, only where they pay.
    """
    finer = with_usual_substeps(tried.model, trial.base.model)
    if tried.fit is None or finer == tried.model:
        return tried
    found = run(replace(trial, models=(finer,), base=tried.fit))
    if found.failure or not certain(found.densities - tried.densities, trial.settings):
        return tried
    return found


def _unscaled(fit: Fit) -> Model:
    model: Model = replace(fit.model, scaling=None)
    return model
