"""One round: which effects the residual speaks for, and which of them held-out data confirm."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from pyro_dynogp.criticism.comparison import block_standard_error
from pyro_dynogp.discrepancy.effects import Effect
from pyro_dynogp.discrepancy.evidence import Evidence, Residuals
from pyro_dynogp.discrepancy.extend import Model
from pyro_dynogp.discrepancy.report import Attempt
from pyro_dynogp.discrepancy.trials import Score, Trial, Tried, blocks, run
from pyro_dynogp.parallel import parallel_map
from pyro_dynogp.record import Record

# A gain counts if it is more than so many block standard errors, and than so many nats.
ERRORS, NATS = 2.0, 4.0
# Least probable evidence of an effect that is tried because a relative's test rejects.
RELATIVE = 0.3
# Blocks of the whole record on which effects of one instant are scored.
FOLDS = 4


Folds = tuple[np.ndarray, ...]
# A candidate that helps: with its variants, its trial, its attempt, and what it was scored on.
Better = tuple["Found", tuple[Model, ...], Tried, Attempt, tuple[int, Score]]


@dataclass(frozen=True, eq=False)
class Found:
    """Evidence with the effect that it is for, and its false discovery rate."""

    effect: Effect
    evidence: Evidence
    q_value: float


@dataclass(frozen=True)
class _Look:
    effect: Effect
    residuals: Residuals
    seed: int


def _look(task: _Look) -> list[Evidence] | str:
    """Evidence, or why the residual cannot be tested for the effect."""
    try:
        return list(task.effect.detect(task.residuals, seed=task.seed))
    except ValueError as error:
        return str(error)


def look(
    residuals: Sequence[Residuals],
    effects: Sequence[Effect],
    *,
    seed: int,
    workers: int | None = None,
    progress: bool = False,
) -> tuple[list[Found], list[str]]:
    """Evidence of every effect in the residuals of each output, most probable effects first.

    Second, in words, effects for which the residuals cannot be tested.

    Each is paid for: p-values are multiplied by the number of outputs, and q-values are those of
    Benjamini and Yekutieli (2001), which hold however the tests depend on each other.
    """
    tasks = [_Look(effect, one, seed) for one in residuals for effect in effects]
    looked = parallel_map(
        _look, tasks, workers=workers, progress=progress, description="residual tests"
    )
    skipped = [
        f"Not tested for {task.effect.name}: {why}"
        for task, why in zip(tasks, looked, strict=True)
        if isinstance(why, str)
    ]
    found = [
        (task.effect, replace(one, p_value=min(1.0, one.p_value * len(residuals))))
        for task, several in zip(tasks, looked, strict=True)
        if not isinstance(several, str)
        for one in several
    ]
    q = false_discovery_rates(np.array([one.p_value for _, one in found]))
    rated = [Found(effect, one, float(v)) for (effect, one), v in zip(found, q, strict=True)]
    return sorted(rated, key=lambda f: (f.evidence.p_value, -f.evidence.gain)), skipped


def false_discovery_rates(p_values: np.ndarray) -> np.ndarray:
    """Adjusted p-values (m,) of Benjamini and Yekutieli (2001)."""
    m = len(p_values)
    if not m:
        return p_values
    order = np.argsort(p_values)
    harmonic = np.sum(1.0 / np.arange(1, m + 1))
    scaled = p_values[order] * m * harmonic / np.arange(1, m + 1)
    q = np.empty(m)
    q[order] = np.minimum(1.0, np.minimum.accumulate(scaled[::-1])[::-1])
    return q


@dataclass(frozen=True, eq=False)
class Confirmed:
    """What refits say about the candidates of a round.

    Attributes:
        attempts: of all candidates. winner: the one to add, None if none helps.
        before: the model without it. model: extended by it. attempt: that of the winner.
        ties: names of effects that explain as much.
    """

    attempts: tuple[Attempt, ...]
    winner: Found | None
    before: Model
    model: Model | None
    attempt: Attempt | None
    ties: tuple[str, ...]


def candidates_of(
    found: Sequence[Found], model: Model, record: Record, level: float, tries: int
) -> list[tuple[Found, tuple[Model, ...]]]:
    """The most probable effects that can be added, best first.

    An effect is a candidate if its own test rejects at the level, or nearly does while that of a
    relative does: one cause makes the tests of a family go off together (a delay looks like
    dynamics, a dead zone like play), and refits alone tell its members apart. Of several channels
    that one effect may come from, those that reject are candidates.
    """
    families = {one.effect.family for one in found if one.evidence.p_value <= level}
    out: list[tuple[Found, tuple[Model, ...]]] = []
    for one in found:
        p = one.evidence.p_value
        relative = one.effect.family in families and p <= RELATIVE
        if (p > level and not relative) or len(out) >= tries:
            continue
        variants = tuple(one.effect.extend(model, one.evidence, record))
        if variants:
            out.append((one, variants))
    return out


def confirm(
    candidates: Sequence[tuple[Found, tuple[Model, ...]]],
    model: Model,
    record: Record,
    held_out: np.ndarray,
    poles: np.ndarray | None,
    *,
    number: int,
    seed: int,
    workers: int | None = None,
    progress: bool = False,
) -> Confirmed:
    """Add each candidate alone, refit, and compare the densities of what was held out.

    Args:
        candidates: from `candidates_of`. model: that is extended. record: blocks A and B.
        held_out: (n,) True in B. poles: of the model. number: of the round. seed: of refits.
    """
    after, whole = (held_out,), blocks(len(record), FOLDS)
    kinds: list[tuple[Folds, Score]] = [
        (whole, "one step") if one.effect.localised else (after, one.effect.score)
        for one, _ in candidates
    ]
    bases = {(len(folds), score): folds for folds, score in kinds}
    # Two effects may be the same block of the model: it is fitted once.
    tasks: dict[Any, Trial] = {
        (repr((model,)), *kind): Trial((model,), record, folds, poles, seed, kind[1])
        for kind, folds in bases.items()
    }
    keys = []
    for (one, variants), (folds, score) in zip(candidates, kinds, strict=True):
        keys.append((repr(variants), len(folds), score))
        tasks[keys[-1]] = Trial(variants, record, folds, poles, seed, score, one.effect.refine)
    done = parallel_map(
        run,
        list(tasks.values()),
        workers=workers,
        progress=progress,
        description=f"refits, round {number}",
    )
    results = dict(zip(tasks, done, strict=True))
    base = {kind: results[(repr((model,)), *kind)] for kind in bases}
    attempts, better = [], []
    for (one, variants), key in zip(candidates, keys, strict=True):
        tried = results[key]
        attempt, good = _judge(one, tried, base[key[1:]], number)
        attempts.append(attempt)
        if good:
            better.append((one, variants, tried, attempt, key[1:]))
    if not better:
        return Confirmed(tuple(attempts), None, model, None, None, ())
    # Gains of forecasts and of one step ahead do not compare: first what lies between inputs and
    # output, whose lack looks like noise, and noise when nothing of that kind is left.
    structural = [b for b in better if b[0].effect.score == "forecast"]
    better = structural or better
    best = max(better, key=lambda b: b[3].gain / (1.0 if b[4][0] == 1 else _ratio(held_out)))
    equal = [b for b in better if b is best or _ties(b, best)]
    # Of effects that are one block of the model the most probable one gives it its name.
    first = {id(b[2]): b for b in reversed(equal)}
    chosen = min(first.values(), key=lambda b: (b[0].effect.freedom, -b[3].gain))
    names = tuple(dict.fromkeys(b[0].effect.name for b in equal))
    ties = tuple(name for name in names if name != chosen[0].effect.name)
    final = []
    for attempt in attempts:
        if attempt is chosen[3]:
            attempt = replace(attempt, decision="accepted")
        elif any(attempt is b[3] for b in equal):
            attempt = replace(
                attempt, decision="tie", reason=f"explains as much as {chosen[0].effect.name}"
            )
        elif attempt.gain > max(NATS, ERRORS * attempt.gain_error):
            attempt = replace(
                attempt, decision="rejected", reason=f"{chosen[0].effect.name} comes first"
            )
        final.append(attempt)
    accepted = next(a for a in final if a.decision == "accepted")
    return Confirmed(tuple(final), chosen[0], model, chosen[2].model, accepted, ties)


def _judge(one: Found, tried: Tried, base: Tried, number: int) -> tuple[Attempt, bool]:
    """The attempt, and whether it helps."""
    if tried.failure or base.failure:
        reason = f"could not be fitted: {tried.failure or base.failure}"
        return Attempt(number, one.evidence, one.q_value, "rejected", reason), False
    d = tried.densities - base.densities
    gain, error = float(d.sum()), block_standard_error(d)[0]
    good = gain > NATS and gain > ERRORS * error
    reason = f"held-out elpd {gain:+.1f} +- {error:.1f} nats"
    attempt = Attempt(
        number, one.evidence, one.q_value, "rejected", reason, gain, error, tried.seconds
    )
    return attempt, good


def _ratio(held_out: np.ndarray) -> float:
    """How many more samples the blocks of the whole record score than block B does."""
    return float(len(held_out) / held_out.sum())


def _ties(
    one: Better,
    best: Better,
) -> bool:
    """Whether two candidates explain held-out data equally well, within two standard errors."""
    if one[4] != best[4]:
        return False
    d = best[2].densities - one[2].densities
    return bool(d.sum() <= max(ERRORS * block_standard_error(d)[0], NATS))
