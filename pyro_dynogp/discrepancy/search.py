"""Which effects the residual speaks for, and which of them are worth a refit."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.stats import false_discovery_control

from pyro_dynogp.data.record import Record
from pyro_dynogp.effects import Effect
from pyro_dynogp.models.variants import Model
from pyro_dynogp.statistics.evidence import Evidence, Residuals
from pyro_dynogp.statistics.settings import LoopSettings
from pyro_dynogp.support.parallel import parallel_map


@dataclass(frozen=True, eq=False)
class Found:
    """Evidence with the effect that it is for, and its false discovery rate."""

    effect: Effect
    evidence: Evidence
    q_value: float


# An effect that the residual speaks for, and variants of the model with it.
Candidate = tuple[Found, tuple[Model, ...]]


@dataclass(frozen=True)
class _Look:
    effect: Effect
    residuals: Residuals
    settings: LoopSettings
    seed: int


def _look(task: _Look) -> list[Evidence] | str:
    """Evidence, or why the residual cannot be tested for the effect."""
    try:
        return list(task.effect.detect(task.residuals, task.settings, seed=task.seed))
    except ValueError as error:
        return str(error)


def look(
    residuals: Sequence[Residuals],
    effects: Sequence[Effect],
    settings: LoopSettings,
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
    tasks = [_Look(effect, one, settings, seed) for one in residuals for effect in effects]
    looked = parallel_map(
        _look, tasks, workers=workers, progress=progress, description="residual tests"
    )
    reasons: dict[str, list[str]] = {}
    for task, why in zip(tasks, looked, strict=True):
        if isinstance(why, str):
            reasons.setdefault(why, []).append(task.effect.name)
    skipped = [
        f"Not tested for {', '.join(dict.fromkeys(names))}: {why}" for why, names in reasons.items()
    ]
    found = [
        (
            task.effect,
            replace(
                one,
                p_value=min(1.0, one.p_value * len(residuals)),
                output=task.residuals.output_name,
            ),
        )
        for task, several in zip(tasks, looked, strict=True)
        if not isinstance(several, str)
        for one in several
    ]
    return rated(found), skipped


def rated(found: Sequence[tuple[Effect, Evidence]]) -> list[Found]:
    """With false discovery rates, most probable effects first."""
    if not found:
        return []
    p = np.clip([one.p_value for _, one in found], 0.0, 1.0)
    q = false_discovery_control(p, method="by")  # Benjamini & Yekutieli (2001)
    both = [Found(effect, one, float(v)) for (effect, one), v in zip(found, q, strict=True)]
    return sorted(both, key=lambda f: (f.evidence.p_value, -f.evidence.gain))


def extended_by(found: Found, model: Model, record: Record) -> tuple[Sequence[Model], str]:
    """Variants of the model with an effect, and why there are none, in words.

    Not every model can be extended by every effect: nothing can be made from an input whose dead
    time is a parameter.
    """
    try:
        return found.effect.extend(model, found.evidence, record), ""
    except ValueError as error:
        return (), f"the model cannot have it: {str(error).partition('. ')[0].rstrip('.')}"


def candidates_of(
    found: Sequence[Found],
    model: Model,
    record: Record,
    level: float,
    tries: int,
    settings: LoopSettings,
) -> list[Candidate]:
    """The most probable effects that can be added, best first.

    An effect is a candidate if its own test rejects at the level, or nearly does while that of a
    relative does: one cause makes the tests of a family go off together (a delay looks like
    dynamics, a dead zone like play), and refits alone tell its members apart. What is `imitated`
    is a candidate always, beside as many others as may be tried. Of several channels
    that one effect may come from, those that reject are candidates, each with what the others
    have not made of the model already.
    """
    families = {one.effect.family for one in found if one.evidence.p_value <= level}
    out: list[Candidate] = []
    made: dict[str, set[str]] = {}
    for one in found:
        p = one.evidence.p_value
        relative = one.effect.family in families and p <= settings.relative
        due = (p <= level or relative) and len(out) < tries
        if not (due or one.effect.imitated):
            continue
        known = made.setdefault(one.effect.name, set())
        extended, _ = extended_by(one, model, record)
        variants = tuple(variant for variant in extended if repr(variant) not in known)
        if variants:
            out.append((one, variants))
            known.update(repr(variant) for variant in variants)
    return out
