"""Refits of the effects that the residual speaks for: which of them held-out data confirm."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, Literal

import numpy as np

from pyro_dynogp.criticism.comparison import block_standard_error
from pyro_dynogp.data.record import Record
from pyro_dynogp.discrepancy.result import Attempt
from pyro_dynogp.discrepancy.search import Candidate, Found
from pyro_dynogp.discrepancy.trials import Score, Trial, Tried, interleaved, run
from pyro_dynogp.fitting import Fit
from pyro_dynogp.models.variants import Model
from pyro_dynogp.statistics.settings import LoopSettings
from pyro_dynogp.support.parallel import parallel_map

# Where densities are scored: after the training data, or on blocks spread over the whole record.
Where = Literal["after", "spread"]
Kind = tuple[Where, Score]
STRUCTURE_FIRST = "what certainly lies between inputs and output comes first"


@dataclass(frozen=True, eq=False)
class Confirmed:
    """What refits say about the candidates of a round.

    Attributes:
        attempts: of all candidates. winner: the one to add, None if none helps.
        before: the model without it. model: extended by it. attempt: that of the winner.
        fit: of the extended model to what is not held out; None where there is none yet.
        ties: names of effects that explain as much.
    """

    attempts: tuple[Attempt, ...]
    winner: Found | None
    before: Model
    model: Model | None
    attempt: Attempt | None
    fit: Fit | None
    ties: tuple[str, ...]


@dataclass(frozen=True, eq=False)
class _Judged:
    """A candidate, its refit, its gain over the model without it, and whether that is enough."""

    found: Found
    kind: Kind
    tried: Tried
    attempt: Attempt
    helps: bool = False


@dataclass(eq=False)
class _Refits:
    """Refits of a round, and what they say: each block is fitted once.

    Attributes:
        current: fit of the model that is extended, to what is not held out.
        record: blocks A and B. held_out: (n,) True in B.
        number: of the round. seed, settings, workers, progress: as of `confirm`.
        results: of the trials so far, by the models and how they are scored.
    """

    current: Fit
    record: Record
    held_out: np.ndarray
    number: int
    seed: int
    settings: LoopSettings
    workers: int | None
    progress: bool
    results: dict[tuple[str, Kind], Tried] = field(default_factory=dict)

    @cached_property
    def model(self) -> Model:
        """The model that is extended."""
        return replace(self.current.model, scaling=None)

    def trial(self, models: tuple[Model, ...], kind: Kind, found: Found | None) -> Trial:
        """Of variants of an effect, or of the model itself."""
        where, score = kind
        known = self.current if found is None and where == "after" else None
        spread = interleaved(len(self.record), self.settings.folds)
        folds = spread if where == "spread" else (self.held_out,)
        plain = Trial(
            models, self.record, folds, self.current, self.seed, self.settings, score, fit=known
        )
        if found is None:
            return plain
        return replace(plain, refine=found.effect.refine, compared=found.effect.compared)

    def run(self, tasks: dict[Any, Trial], label: str) -> dict[Any, Tried]:
        """Results of trials by key."""
        done = parallel_map(
            run, list(tasks.values()), workers=self.workers, progress=self.progress,
            description=f"{label}, round {self.number}",
        )  # fmt: skip
        return dict(zip(tasks, done, strict=True))

    def judge(self, candidates: Sequence[Candidate]) -> list[_Judged]:
        """Candidates, each against the model without it."""
        # Two effects may be the same block of the model: it is fitted once.
        kinds = [_kind(found) for found, _ in candidates]
        tasks = {("", kind): self.trial((self.model,), kind, None) for kind in kinds}
        for (found, variants), kind in zip(candidates, kinds, strict=True):
            tasks[repr(variants), kind] = self.trial(variants, kind, found)
        self.results.update(self.run(tasks, "refits"))
        return [
            self.judged(found, kind, self.results[repr(variants), kind])
            for (found, variants), kind in zip(candidates, kinds, strict=True)
        ]

    def judged(self, found: Found, kind: Kind, tried: Tried) -> _Judged:
        """One candidate against the model without it."""
        base = self.results["", kind]
        return _judge(found, kind, tried, base, self.number, self.settings)

    def on_one_scale(self, better: Sequence[_Judged]) -> list[_Judged]:
        """The same candidates scored alike, since gains on different densities do not compare."""
        if len({one.kind for one in better}) == 1:
            return list(better)
        common: Kind = ("spread", "forecast")
        others = [one for one in better if one.kind != common]
        more = {
            repr(one.tried.model): self.trial((one.tried.model,), common, one.found)
            for one in others
        }
        again = self.run(more, "refits once more")
        return [
            one if one.kind == common
            else self.judged(one.found, common, again[repr(one.tried.model)])
            for one in better
        ]  # fmt: skip


def confirm(
    candidates: Sequence[Candidate],
    current: Fit,
    record: Record,
    held_out: np.ndarray,
    *,
    number: int,
    seed: int,
    level: float,
    settings: LoopSettings,
    workers: int | None = None,
    progress: bool = False,
) -> Confirmed:
    """Add each candidate alone, refit, and compare the densities of what was held out.

    What belongs to the noise is tried where no structure is certain: its lack looks like noise.

    Args:
        candidates: from `candidates_of`. current: fit of the model that is extended, to what is not
            held out. record: blocks A and B. held_out: (n,) True in B.
        number: of the round. seed: of refits. level: of the tests. settings: thresholds.
    """
    refits = _Refits(current, record, held_out, number, seed, settings, workers, progress)
    judged = refits.judge([one for one in candidates if _kind(one[0])[1] == "forecast"])
    waiting = [one for one in candidates if _kind(one[0])[1] != "forecast"]
    if not any(one.helps and one.found.q_value <= level for one in judged):
        places = {id(found): place for place, (found, _) in enumerate(candidates)}
        judged = sorted([*judged, *refits.judge(waiting)], key=lambda one: places[id(one.found)])
        waiting = []
    untried = [
        Attempt(number, found.evidence, found.q_value, "not tried", STRUCTURE_FIRST)
        for found, _ in waiting
    ]
    better = _first_in_line([one for one in judged if one.helps], level)
    if not better:
        attempts = (*(one.attempt for one in judged), *untried)
        return Confirmed(attempts, None, refits.model, None, None, None, ())
    playing = refits.on_one_scale(better)
    best = _best([one for one in playing if not one.tried.failure])
    equal = [k for k, one in enumerate(playing) if one is best or _ties(one, best, settings)]
    winner = better[_chosen(better, playing, equal, level)]
    name = winner.found.effect.name
    names = dict.fromkeys(better[k].found.effect.name for k in equal)
    decided = [_decided(one, winner, any(one is better[k] for k in equal), name) for one in judged]
    return Confirmed(
        attempts=(*decided, *untried),
        winner=winner.found,
        before=refits.model,
        model=winner.tried.model,
        attempt=next(a for a in decided if a.decision == "accepted"),
        fit=winner.tried.fit if winner.kind[0] == "after" else None,
        ties=tuple(one for one in names if one != name),
    )


def _chosen(
    better: Sequence[_Judged], playing: Sequence[_Judged], equal: Sequence[int], level: float
) -> int:
    """Which of several that explain as much is added: the one that leaves least open.

    Of effects that are one block of the model that which leaves least open gives it its name, if
    the residual is certain of it, else the most probable one.
    """
    first: dict[str, int] = {}
    well = {better[k].found.effect.name for k in equal}
    named = [k for k in equal if not _too_special(better[k].found, well, level)]
    for k in sorted(named, key=lambda k: _specific(better[k].found, level)):
        first.setdefault(repr(playing[k].tried.model), k)
    return min(
        first.values(), key=lambda k: (better[k].found.effect.freedom, -playing[k].attempt.gain)
    )


def _decided(one: _Judged, winner: _Judged, ties: bool, name: str) -> Attempt:
    """What became of a candidate."""
    if one is winner:
        return replace(one.attempt, decision="accepted")
    if ties:
        return replace(one.attempt, decision="tie", reason=f"explains as much as {name}")
    if one.helps:
        return replace(one.attempt, decision="rejected", reason=f"{name} comes first")
    return one.attempt


def _kind(found: Found) -> Kind:
    """Where an effect is scored, and on which densities."""
    effect = found.effect
    return ("spread", "forecast") if effect.localised else ("after", effect.score)


def _judge(
    found: Found,
    kind: Kind,
    tried: Tried,
    base: Tried,
    number: int,
    settings: LoopSettings,
) -> _Judged:
    """A candidate against the model without it."""
    evidence, q = found.evidence, found.q_value
    if tried.failure or base.failure:
        reason = f"could not be fitted: {tried.failure or base.failure}"
        return _Judged(found, kind, tried, Attempt(number, evidence, q, "rejected", reason))
    d = tried.densities - base.densities
    gain, error = float(d.sum()), block_standard_error(d)[0]
    reason = f"held-out elpd {gain:+.1f} +- {error:.1f} nats"
    helps, capped = certain(d, settings), np.minimum(d, settings.cap)
    if not helps and certain(capped, settings):
        helps = True
        reason += f"; {capped.sum():+.1f} with no sample counted for more than {settings.cap:.0f}"
    if len(tried.errors):  # what is one step ahead for the noise must not cost the structure
        loss = _loss(tried.errors, base.errors)
        if harms := certain(loss, settings) and loss.mean() > settings.harm:
            reason += (
                f"; forecasts worse by {loss.sum():.1f} +- {block_standard_error(loss)[0]:.1f}"
            )
        helps = helps and not harms
    attempt = Attempt(number, evidence, q, "rejected", reason, gain, error, tried.seconds)
    return _Judged(found, kind, tried, attempt, helps)


def certain(gains: np.ndarray, settings: LoopSettings) -> bool:
    """Whether gains (N,) of single samples are certainly more than nothing in all."""
    error = settings.standard_errors * block_standard_error(gains)[0]
    return bool(gains.sum() > max(settings.gain, error))


def _loss(errors: np.ndarray, base: np.ndarray) -> np.ndarray:
    """By how much forecasts are worse than those of the base, sample by sample [nats].

    Log-densities of errors (M, n_y) under one double exponential distribution, that which suits the
    base: what the noise is thought to be does not come in, and outliers hardly.
    """
    worse = (np.abs(errors) - np.abs(base)) / np.nanmean(np.abs(base), axis=0)
    return worse[np.isfinite(worse)]


def _first_in_line(better: Sequence[_Judged], level: float) -> list[_Judged]:
    """Of effects that help those that the residual itself speaks for, structure before noise.

    Gains of forecasts and of one step ahead do not compare: first comes what lies between inputs
    and output, whose lack looks like noise, and noise when nothing of that kind is left.

    With eight candidates one improves on held-out data by luck, and flexible ones take up much of
    what others should. Where the residual is certain of an effect (by its false discovery rate)
    only that and its relatives count, of structure; where it is certain of noise alone, noise comes
    first: what structure there may be is seen better beside the noise that there is.
    """
    structural = [one for one in better if one.kind[1] == "forecast"]
    certain = {one.found.effect.family for one in structural if one.found.q_value <= level}
    if certain:
        return [one for one in structural if one.found.effect.family in certain]
    noise = [one for one in better if one.kind[1] != "forecast"]
    if not structural or any(one.found.q_value <= level for one in noise):
        return noise
    return structural


def _specific(found: Found, level: float) -> tuple[bool, int]:
    """Certain effects first, and of those the ones that leave less open."""
    certain = found.q_value <= level
    return not certain, found.effect.freedom if certain else 0


def _too_special(one: Found, names: Collection[str], level: float) -> bool:
    """Whether it is a special case, of which the residual is not certain, of what does as well."""
    return one.effect.special_of in names and one.q_value > level


def _best(judged: Sequence[_Judged]) -> _Judged:
    return max(judged, key=lambda one: one.attempt.gain)


def _ties(one: _Judged, best: _Judged, settings: LoopSettings) -> bool:
    """Whether two candidates explain held-out data equally well, within two standard errors.

    A special case of the best one need not gain quite as much: what is left of it are differences
    of fits.
    """
    if one.tried.failure:
        return False
    d = best.tried.densities - one.tried.densities
    slack = max(settings.standard_errors * block_standard_error(d)[0], settings.gain)
    if one.found.effect.special_of == best.found.effect.name:
        slack = max(slack, settings.special * best.attempt.gain)
    return bool(d.sum() <= slack)
