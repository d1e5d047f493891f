"""Refits of two effects together, where neither of them alone is confirmed."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace

from pyro_dynogp.discrepancy.held_out import certain
from pyro_dynogp.discrepancy.judged import SPREAD, Judged, Kind, judge
from pyro_dynogp.discrepancy.refits import Refits
from pyro_dynogp.discrepancy.search import extended_by
from pyro_dynogp.discrepancy.trials import Trial, Tried
from pyro_dynogp.models.variants import Model

# Effects of which pairs are tried.
MOST = 3


@dataclass(frozen=True, eq=False)
class Pair:
    """Two effects, variants of the model with both, and where these are scored."""

    one: Judged
    other: Judged
    models: tuple[Model, ...]

    @property
    def kind(self) -> Kind:
        """Spread over the record where one of them acts at an instant."""
        return max(self.one.kind, self.other.kind, key=lambda kind: kind == SPREAD)


def confirmed_together(refits: Refits, judged: Sequence[Judged], level: float) -> Judged | None:
    """The first of two effects that help together, and neither alone; None where there are none.

    Each may mask the other: errors of what is still missing hide what is gained. Both have to be
    certain in the residual, the pair has to gain, and more than either alone. It is the one of
    larger gain that is returned, to be added first; the other one has the next round.

    Args:
        refits: of the round. judged: candidates, of which none that is certain helps. level: of the
            tests.
    """
    pairs = _pairs(refits, judged, level)
    together = refits.run(
        {k: refits.trial(one.models, one.kind, one.other.found) for k, one in enumerate(pairs)},
        "joint refits",
    )
    alone = _alone(refits, pairs)
    if refits.early:
        return None
    best, largest = None, 0.0
    for k, pair in enumerate(pairs):
        tried, base = together[k], refits.results["", pair.kind]
        both = judge(pair.other.found, pair.kind, tried, base, refits.number, refits.settings)
        members = [alone[id(one), pair.kind] for one in (pair.one, pair.other)]
        if not both.helps or any(one.failure for one in members):
            continue
        more = [tried.densities - one.densities for one in members]
        if not all(certain(gain, refits.settings) for gain in more):
            continue
        if both.attempt.gain > largest:
            first = pair.one if more[1].sum() >= more[0].sum() else pair.other
            best, largest = _first_of(pair, first, both), both.attempt.gain
    return best


def _pairs(refits: Refits, judged: Sequence[Judged], level: float) -> list[Pair]:
    """Pairs of the most gainful effects of structure that the residual is certain of."""
    sure = [
        one for one in judged
        if one.found.q_value <= level and one.kind[1] == "forecast" and not one.tried.failure
    ]  # fmt: skip
    sure = sorted(sure, key=lambda one: -one.attempt.gain)[:MOST]
    pairs = []
    for one, other in itertools.combinations(sure, 2):
        for first, second in ((one, other), (other, one)):
            models, _ = extended_by(second.found, first.tried.model, refits.record)
            if models:
                pairs.append(Pair(first, second, tuple(models)))
                break
    return pairs


def _alone(refits: Refits, pairs: Sequence[Pair]) -> dict[tuple[int, Kind], Tried]:
    """Every member of a pair by itself, scored as the pair is."""
    found: dict[tuple[int, Kind], Tried] = {}
    missing: dict[tuple[int, Kind], Trial] = {}
    for pair in pairs:
        for one in (pair.one, pair.other):
            if one.kind == pair.kind:
                found[id(one), pair.kind] = one.tried
            else:
                trial = refits.trial((one.tried.model,), pair.kind, one.found)
                missing[id(one), pair.kind] = trial
    return found | refits.run(missing, "refits once more")


def _first_of(pair: Pair, first: Judged, both: Judged) -> Judged:
    """An effect that is confirmed by what it gains together with another one."""
    second = pair.other if first is pair.one else pair.one
    own, joint = first.attempt, both.attempt
    reason = (
        f"held-out elpd {own.gain:+.1f} +- {own.gain_error:.1f} nats, together with "
        f"{second.found.effect.name} {joint.gain:+.1f} +- {joint.gain_error:.1f}"
    )
    return replace(first, helps=True, attempt=replace(own, reason=reason))
