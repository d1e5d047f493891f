"""Refits of extended models, and what they come to on what they have not seen."""

from __future__ import annotations

import itertools
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np
from tqdm import tqdm

from pyro_dynogp.data.record import Record
from pyro_dynogp.discrepancy.failures import TimeLimitError, why_not
from pyro_dynogp.discrepancy.held_out import (
    LITTLE_ELSE,
    are_noise,
    certain,
    held_out_density,
    is_more_probable,
    scored,
    without,
)
from pyro_dynogp.discrepancy.leading_variant import leading, unscaled
from pyro_dynogp.discrepancy.rehearsal import lasting
from pyro_dynogp.effects.base import Compared, Score
from pyro_dynogp.fitting import Fit
from pyro_dynogp.inference.bayes_factor import energy
from pyro_dynogp.inference.refit import race, refit, refits
from pyro_dynogp.inference.run import Run
from pyro_dynogp.models.delays import longest_delay
from pyro_dynogp.models.feedback_variants import (
    acting_back,
    has_other_dynamics,
    with_usual_substeps,
)
from pyro_dynogp.models.variants import Model
from pyro_dynogp.statistics.settings import LoopSettings
from pyro_dynogp.support.parallel import parallel_map

# Most steps of one size that a number of a variant takes.
MOVES = 4


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
        """How refits are run: trials, or variants of one, share the processors."""
        return Run(self.seed, workers=1)

    @property
    def is_long(self) -> bool:
        """Whether its variants are compared ahead, and so fitted one by one."""
        return len(self.models) > 1 and self.compared in ("held out", "rehearsed")


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


# Fits of variants, and why others could not be fitted.
_Refitted = tuple[list[Fit], list[ValueError]]


class _Rated(NamedTuple):
    """A variant's fit, and densities and errors of its forecasts as of `scored`."""

    fit: Fit
    densities: np.ndarray
    errors: np.ndarray


class Ahead(NamedTuple):
    """How variants are fitted that are compared ahead; results are the same.

    workers: processes. progress: label of a bar, "" for none. late: says whether the time limit has
    passed, asked before each of them; None for none.
    """

    workers: int = 1
    progress: str = ""
    late: Callable[[], bool] | None = None


ALONE = Ahead()


def run(trial: Trial, ahead: Ahead = ALONE) -> Tried:
    """Refit the variants on the first fold's training data, the best on all; score the folds.

    Raises:
        TimeLimitError: where the time limit has passed before all variants were fitted.
    """
    begin = time.perf_counter()
    first: Fit | None = None
    parts, beside = [np.zeros(0)], [np.zeros((0, trial.record.n_outputs))]
    failure = ""
    try:
        first = _kept(trial, without(trial.record, trial.folds[0]), ahead)
        for index, fold in enumerate(trial.folds):
            found = first
            if index > 0:
                rest = without(trial.record, fold)
                # With functions every start of an effect would climb again for each of the folds.
                start = first if first.model.has_function else trial.base
                found = refit(start, rest, model=first.model, run=trial.run)
            density, error = scored(found, trial.record, fold, trial.score)
            parts.append(density)
            beside.append(error)
    except ValueError as error:
        failure = why_not(trial.models, trial.record, trial.folds, error)
        parts = [np.zeros(0)]
    return Tried(
        trial.models[0] if first is None else unscaled(first),
        np.concatenate(parts),
        time.perf_counter() - begin,
        failure,
        first,
        np.concatenate(beside),
    )


def _kept(trial: Trial, training: Record, ahead: Ahead) -> Fit:
    """The variant that is kept, fitted to the training data."""
    if trial.fit is not None:
        return trial.fit
    if trial.is_long:
        return _best_ahead(trial, training, ahead)
    (model, *others), start = trial.models, trial.base
    seen = trial.record if trial.compared == "known" else training
    finer = _finer(trial, model, seen, 0)
    if others or finer:
        reach = trial.settings.reach
        start, same, longest = leading(trial.base, trial.models, finer, seen, reach, trial.run)
        for times in range(trial.settings.refinements):
            start = _refined(trial, start, seen, same, times, longest)
        model = start.model
        if model.has_function:  # few steps may have led to a poor optimum
            start, model = trial.base, unscaled(start)
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
        here = unscaled(start)
        close = _finer(trial, here, training, times)
        known = [one for one in close if longest_delay(one) <= longest]
        if not known:
            break
        # The variant itself takes part: all climb further in a race.
        ranked, _ = race(start, [here, *known], same, trial.run)
        own = next(one for one in ranked if unscaled(one) == here)
        start = ranked[0]
        if energy(own) - energy(start) <= trial.settings.gain:
            break
    return start


def _best_ahead(trial: Trial, training: Record, ahead: Ahead) -> Fit:
    """The first variant, or a later one that is certainly better on the data held out.

    A block that goes beyond what the training data have seen says little of a shape: of shapes that
    forecast no worse the one is kept that is more probable given the training data.

    Where they differ in how they extrapolate what is right in one stretch may be luck: of those
    that are rehearsed only those count whose forecasts are no worse than those of the base held at
    its last level, or else the last one, which leaves most open. Of others those are fitted that
    are `_wanted`. Variants that cannot be fitted are left out.
    """
    fold, settings = trial.folds[0], trial.settings
    workers, progress, late = ahead

    def refitted(places: Sequence[int], label: str = "") -> list[_Refitted]:
        return parallel_map(
            lambda place: refits(trial.base, [trial.models[place]], training, lambda _: trial.run),
            places, workers=workers, progress=bool(label), description=label,
        )  # fmt: skip

    def rated(fits: Sequence[Fit]) -> list[_Rated]:
        return [_Rated(fit, *scored(fit, trial.record, fold, trial.score)) for fit in fits]

    every = range(len(trial.models))
    found: list[_Rated] = []
    made: dict[int, _Refitted] = {}
    if trial.compared == "rehearsed":
        made.update(zip(every, refitted(every, progress), strict=True))
        fits = [fit for done, _ in made.values() for fit in done]
        # But those that the training data say nothing of, as a later ramp.
        if fits:
            fits = lasting(fits, trial.base, trial.record, fold, trial.run, settings) or fits[-1:]
        found = rated(fits)
    else:
        for place in tqdm(every, desc=progress, disable=not progress):
            if not _wanted(trial, place, found):
                continue
            if place not in made:
                if late is not None and late():
                    raise TimeLimitError
                # What is not wanted once others are rated is dropped again.
                later = (k for k in every[place:] if k not in made and _wanted(trial, k, found))
                some = list(itertools.islice(later, workers))
                made.update(zip(some, refitted(some), strict=True))
            found += rated(made[place][0])
    if not found:
        raise next(why for _, problems in made.values() for why in problems)
    shape = trial.compared == "held out"
    best, highest, _ = found[0]
    for one, own, _ in found[1:]:
        gain = own - highest
        if certain(gain, settings) or (shape and is_more_probable(one, best, gain, settings)):
            best, highest = one, own
    return best


def _wanted(trial: Trial, place: int, found: Sequence[_Rated]) -> bool:
    """Whether the variant at a place is fitted, given what those before it come to.

    The first two are, and later ones while none leaves nothing but noise; those that join what two
    earlier ones have, which take most of the time, only where one of these forecasts best, and
    better than the base; other dynamics only beside more than `LITTLE_ELSE`, of the noise of the
    base, too.
    """
    if place < 2 or not found:
        return True
    leading, most, errors = max(found, key=lambda one: float(one.densities.sum()))
    model, before = trial.models[place], trial.models[:place]
    if are_noise(errors, leading):
        return False
    if has_other_dynamics(model) and all(
        are_noise(errors, fit, LITTLE_ELSE) for fit in (leading, trial.base)
    ):
        return False
    joined = [acting_back(one) for one in before if acting_back(one) < acting_back(model)]
    if len(joined) < 2:
        return True
    least = held_out_density(trial.base, trial.record, trial.folds[0], trial.score)
    return bool(most.sum() > least.sum()) and acting_back(leading.model) in joined


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
