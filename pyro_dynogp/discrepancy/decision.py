"""Refits of the effects that the residual speaks for: which of them held-out data confirm."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, replace

import numpy as np

from pyro_dynogp.criticism.comparison import block_standard_error
from pyro_dynogp.data.record import Record
from pyro_dynogp.discrepancy.held_out import LITTLE_ELSE, NOISE_ALONE, are_noise
from pyro_dynogp.discrepancy.joint_refits import confirmed_together
from pyro_dynogp.discrepancy.judged import Judged, kind_of
from pyro_dynogp.discrepancy.refits import Refits
from pyro_dynogp.discrepancy.result import Attempt
from pyro_dynogp.discrepancy.search import Candidate, Found
from pyro_dynogp.discrepancy.stretches import latest
from pyro_dynogp.fitting import Fit
from pyro_dynogp.inference.bayes_factor import VERY_STRONG, counted, log_bayes_factor
from pyro_dynogp.models.variants import Model
from pyro_dynogp.statistics.settings import LoopSettings

CERTAIN_FIRST = "what certainly lies between inputs and output comes first"
LITTLE_LEFT = "with what the residual speaks more for, little else than noise is left"
LATE = "the time limit was passed"


@dataclass(frozen=True, eq=False)
class Confirmed:
    """What refits say about the candidates of a round.

    Attributes:
        attempts: of all candidates. winner: the one to add, None if none helps.
        before: the model without it. model: extended by it. attempt: that of the winner.
        fit: of the extended model to what is not held out; None where there is none yet.
        ties: names of effects that explain as much.
        early: whether the time limit was passed first; then nothing is decided.
    """

    attempts: tuple[Attempt, ...]
    winner: Found | None
    before: Model
    model: Model | None
    attempt: Attempt | None
    fit: Fit | None
    ties: tuple[str, ...]
    early: bool = False


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
    late: Callable[[], bool] | None = None,
    weighed: bool = False,
) -> Confirmed:
    """Add each candidate alone, refit, and compare the densities of what was held out.

    Structure of which the residual is certain is tried first. Where that helps only relatives of it
    are tried beside it. What belongs to the noise is tried where no structure is certain: its lack
    looks like noise.

    Args:
        candidates: from `candidates_of`. current: fit of the model that is extended, to what is not
            held out. record: blocks A and B. held_out: (n,) True in B.
        number: of the round. seed: of refits. level: of the tests. settings: thresholds.
        late: says whether the time limit has passed; None for none. A round that it cuts short adds
            nothing: what was refitted is not compared with all others.
        weighed: whether there must be evidence for whatever is added, in all known data: no test
            says for certain that anything is missing.
    """
    begin = latest([one.evidence for one, _ in candidates if one.effect.localised], record)
    refits = Refits(
        current, record, held_out, number, seed, settings, workers, progress, late, begin, weighed
    )
    structure = [one for one in candidates if kind_of(one[0])[1] == "forecast"]
    sure = [one for one in structure if one[0].q_value <= level]
    judged = refits.by_evidence(refits.settled(_judged(refits, sure, ()), level), level)
    certain = {one.found.effect.family for one in judged if one.helps}
    further = [
        one for one in structure
        if one not in sure and (not certain or one[0].effect.family in certain)
    ]  # fmt: skip
    judged += _judged(refits, further, judged)
    if weighed:
        judged = refits.by_evidence(judged, level)
    if not certain:
        first = confirmed_together(refits, judged, level)
        judged = [first if first and one.found is first.found else one for one in judged]
    if not _confirms(judged, level):
        noise = [one for one in candidates if one not in structure]
        judged += refits.by_evidence(refits.judge(noise), level)
    places = {id(found): place for place, (found, _) in enumerate(candidates)}
    judged = sorted(judged, key=lambda one: places[id(one.found)])
    done = [id(one.found) for one in judged]
    untried = [
        Attempt(number, one[0].evidence, one[0].q_value, "not tried",
                LITTLE_LEFT if one in sure or one in further else CERTAIN_FIRST)
        for one in candidates
        if id(one[0]) not in done
    ]  # fmt: skip
    while better := _first_in_line([one for one in judged if one.helps], level):
        playing = refits.on_one_scale(better) if not refits.early else []
        if refits.early:
            break
        best = _best([one for one in playing if not one.tried.failure])
        equal = [k for k, one in enumerate(playing) if one is best or _ties(one, best, settings)]
        equal = _needed(equal, playing)
        winner = better[_chosen(better, playing, equal, level)]
        fair = refits.supported(refits.against_refit(winner))
        judged = [fair if one is winner else one for one in judged]
        if fair.helps:
            better, winner = [fair if one is winner else one for one in better], fair
            break
    if refits.early:
        return _cut_short(candidates, judged, refits)
    if not better:
        attempts = (*(one.attempt for one in judged), *untried)
        return Confirmed(attempts, None, refits.model, None, None, None, ())
    name = winner.found.effect.name
    names = dict.fromkeys(better[k].found.effect.name for k in equal)
    tried = refits.with_substeps(winner)
    decided = [_decided(one, winner, any(one is better[k] for k in equal), name) for one in judged]
    return Confirmed(
        attempts=(*decided, *untried),
        winner=winner.found,
        before=refits.model,
        model=tried.model,
        attempt=next(a for a in decided if a.decision == "accepted"),
        fit=tried.fit if winner.kind[0] == "after" else None,
        ties=tuple(one for one in names if one != name),
    )


def _judged(
    refits: Refits, candidates: Sequence[Candidate], before: Sequence[Judged]
) -> list[Judged]:
    """Candidates, at last those that add functions in feedback: they take most of the time.

    Args:
        before: what was judged earlier in the round.
    """
    layers = len(refits.model.layers)
    slow = [
        one for one in candidates
        if any(model.has_feedback and len(model.layers) > layers for model in one[1])
    ]  # fmt: skip
    judged = refits.judge([one for one in candidates if one not in slow])
    there = [*before, *judged]
    return judged + refits.judge([one for one in slow if not _is_needless(refits, one, there)])


def _is_needless(refits: Refits, candidate: Candidate, judged: Sequence[Judged]) -> bool:
    """Whether a candidate with functions in feedback need not be tried.

    The residual speaks more for something else, and with that forecasts of what was held out have
    little else than noise for errors; with a relative noise alone. What functions would explain
    beside it shows in the next round.
    """
    family = candidate[0].effect.family

    def leaves_little(one: Judged) -> bool:
        most = NOISE_ALONE if one.found.effect.family == family else LITTLE_ELSE
        return one.tried.fit is not None and are_noise(one.tried.errors, one.tried.fit, most)

    return any(
        one.helps
        and one.found.q_value < candidate[0].q_value
        and leaves_little(one)
        and refits.supported(refits.against_refit(one)).helps  # else nothing may be added
        for one in judged
    )


def _confirms(judged: Sequence[Judged], level: float) -> bool:
    """Whether one that the residual is certain of helps."""
    return any(one.helps and one.found.q_value <= level for one in judged)


def _cut_short(
    candidates: Sequence[Candidate], judged: Sequence[Judged], refits: Refits
) -> Confirmed:
    """A round that the time limit ended: nothing is added, and what was tried is said."""
    tried = [id(one.found) for one in judged]
    attempts = [
        replace(one.attempt, decision="undecided", reason=f"{one.attempt.reason}; {LATE}")
        if one.helps else one.attempt
        for one in judged
    ]  # fmt: skip
    attempts += [
        Attempt(refits.number, found.evidence, found.q_value, "not tried", LATE)
        for found, _ in candidates
        if id(found) not in tried
    ]
    return Confirmed(tuple(attempts), None, refits.model, None, None, None, (), early=True)


def _needed(equal: Sequence[int], playing: Sequence[Judged]) -> list[int]:
    """Of those that explain as much the ones that training data do not find too stiff."""

    def stiff(k: int) -> bool:
        return any(_needs_more(playing[k], playing[j]) for j in equal if j != k)

    return [k for k in equal if not stiff(k)]


def _needs_more(own: Judged, other: Judged) -> bool:
    """Whether there is very strong evidence for another candidate that has more parameters.

    In the data that both are fitted to, by Laplace's approximation, less what it loses of the data
    held out: forecasts of a short block differ by chance.
    """
    fit, larger = own.tried.fit, other.tried.fit
    if fit is None or larger is None:
        return False
    (fewer, measured), (more, same) = counted(fit), counted(larger)
    if measured != same or more <= fewer:
        return False
    lost = min(other.attempt.gain - own.attempt.gain, 0.0)
    return log_bayes_factor(larger, fit) + lost > VERY_STRONG


def _chosen(
    better: Sequence[Judged], playing: Sequence[Judged], equal: Sequence[int], level: float
) -> int:
    """Which of several that explain as much is added: the one that leaves least open.

    Of those of which the residual is certain, where there are such: what it hardly speaks for may
    stand for them. Of effects that are one block of the model that which leaves least open gives it
    its name, if the residual is certain of it, else the most probable one.
    """
    first: dict[str, int] = {}
    well = {better[k].found.effect.name for k in equal}
    named = [k for k in equal if better[k].found.q_value <= level]
    named = named or [k for k in equal if not _too_special(better[k].found, well, level)]
    for k in sorted(named, key=lambda k: _specific(better[k].found, level)):
        first.setdefault(repr(playing[k].tried.model), k)
    return min(
        first.values(), key=lambda k: (better[k].found.effect.freedom, -playing[k].attempt.gain)
    )


def _decided(one: Judged, winner: Judged, ties: bool, name: str) -> Attempt:
    """What became of a candidate."""
    if one is winner:
        return replace(one.attempt, decision="accepted")
    if ties:
        return replace(one.attempt, decision="tie", reason=f"explains as much as {name}")
    if one.helps:
        return replace(one.attempt, decision="rejected", reason=f"{name} comes first")
    return one.attempt


def _first_in_line(better: Sequence[Judged], level: float) -> list[Judged]:
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


def _best(judged: Sequence[Judged]) -> Judged:
    return max(judged, key=lambda one: one.attempt.gain)


def _ties(one: Judged, best: Judged, settings: LoopSettings) -> bool:
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
