"""Refits of two effects together, where neither of them alone is confirmed."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace

from pyro_dynogp.discrepancy.held_out import certain
from pyro_dynogp.discrepancy.judged import SPREAD, Judged, Kind, judge
from pyro_dynogp.discrepancy.refits import Refits
from pyro_dynogp.discrepancy.search import extended_by
from pyro_dynogp.discrepancy.trials import Trial
from pyro_dynogp.models.variants import Model, with_channels_of

# Effects of which pairs are tried.
MOST = 3


@dataclass(frozen=True, eq=False)
class Pair:
    """Two effects, variants of the model with both, and where these are scored.

    Attributes:
        models: with the second added to what was kept of the first. complete: whether the second is
            there as it was kept, too, so that its numbers (delays, limits) are not looked for once
            more: next to functions each variant takes as long as a refit.
    """

    members: tuple[Judged, Judged]
    models: tuple[Model, ...]
    complete: bool

    @property
    def kind(self) -> Kind:
        """Spread over the record where one of them acts at an instant."""
        first, second = self.members
        return SPREAD if second.kind == SPREAD else first.kind

    def trial(self, refits: Refits) -> Trial:
        """Of both."""
        first, second = self.members
        if self.complete:
            return refits.trial(self.models, self.kind, None, base=first.tried.fit)
        return refits.trial(self.models, self.kind, second.found)


def confirmed_together(refits: Refits, judged: Sequence[Judged], level: float) -> Judged | None:
    """The first of two effects that help together, and neither alone; None where there are none.

    Each may mask the other: errors of what is still missing hide what is gained. Both have to be
    beyond doubt in the residual (their false discovery rates no more than `unsure`), the pair has
    to gain, and more than either alone. It is the one of larger gain that is returned, to be added
    first; the other one has the next round.

    Args:
        refits: of the round. judged: candidates, of which none that is certain helps. level: of the
            tests.
    """
    pairs = _pairs(refits, judged, level)
    together = refits.run({k: pair.trial(refits) for k, pair in enumerate(pairs)}, "joint refits")
    spread = refits.on_spread_blocks(
        [one for pair in pairs if pair.kind == SPREAD for one in pair.members]
    )
    if refits.early:
        return None
    best, largest = None, 0.0
    for k, pair in enumerate(pairs):
        tried, base = together[k], refits.results["", pair.kind]
        both = judge(pair.members[1].found, pair.kind, tried, base, refits.number, refits.settings)
        alone = [
            one.tried if one.kind == pair.kind else spread[repr(one.tried.model)]
            for one in pair.members
        ]
        if not both.helps or any(one.failure for one in alone):
            continue
        more = [tried.densities - one.densities for one in alone]
        if not all(certain(gain, refits.settings) for gain in more):
            continue
        if both.attempt.gain > largest:
            first, second = pair.members
            if more[1].sum() < more[0].sum():
                first, second = second, first
            best, largest = _together_with(second, first, both), both.attempt.gain
    return best


def _pairs(refits: Refits, judged: Sequence[Judged], level: float) -> list[Pair]:
    """Pairs of the most gainful effects of structure that the residual has no doubt of."""
    level = min(level, refits.settings.unsure)
    sure = [
        one for one in judged
        if one.found.q_value <= level and one.kind[1] == "forecast" and not one.tried.failure
    ]  # fmt: skip
    sure = sorted(sure, key=lambda one: -one.attempt.gain)[:MOST]
    both = [_pair(refits, one, other) for one, other in itertools.combinations(sure, 2)]
    return [pair for pair in both if pair is not None]


def _pair(refits: Refits, one: Judged, other: Judged) -> Pair | None:
    """One effect added to the model with the other one; None where neither can be."""
    orders = ((one, other), (other, one))
    for first, second in orders:
        together = with_channels_of(first.tried.model, second.tried.model, refits.model)
        if together is not None:
            return Pair((first, second), (together,), complete=True)
    for first, second in orders:
        models, _ = extended_by(second.found, first.tried.model, refits.record)
        if models:
            return Pair((first, second), tuple(models), complete=False)
    return None


def _together_with(second: Judged, first: Judged, both: Judged) -> Judged:
    """The first effect, confirmed by what it gains together with the second."""
    own, joint = first.attempt, both.attempt
    reason = (
        f"held-out elpd {own.gain:+.1f} +- {own.gain_error:.1f} nats, together with "
        f"{second.found.effect.name} {joint.gain:+.1f} +- {joint.gain_error:.1f}"
    )
    return replace(first, helps=True, attempt=replace(own, reason=reason))
