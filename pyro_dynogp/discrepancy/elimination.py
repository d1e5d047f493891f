"""Backward elimination: effects that those added after them have made superfluous."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from pyro_dynogp.data.record import Record
from pyro_dynogp.discrepancy.decision import Confirmed
from pyro_dynogp.discrepancy.held_out import certain, held_out_density
from pyro_dynogp.discrepancy.result import Attempt, EffectTest
from pyro_dynogp.discrepancy.search import Found
from pyro_dynogp.fitting import Fit
from pyro_dynogp.inference.bayes_factor import log_bayes_factor
from pyro_dynogp.models.variants import Model, without_change_of
from pyro_dynogp.statistics.evidence import Residuals
from pyro_dynogp.statistics.settings import LoopSettings


@dataclass(frozen=True, eq=False)
class Added:
    """An effect that was added.

    Attributes:
        found: the evidence. confirmed: what refits said. seen: residuals before it was added.
        base: fit without it. fit: with it, and with those before.
    """

    found: Found
    confirmed: Confirmed
    seen: Sequence[Residuals]
    base: Fit
    fit: Fit


# A model that extends the one of a fit, fitted to the same data.
Refit = Callable[[Fit, Model], Fit]


def without(added: Sequence[Added], place: int, refit: Refit) -> list[Added] | None:
    """The others, fitted without the channels and poles that one adds; None where it adds others.

    Each that came later extends what was there before it.

    Args:
        added: in order. place: of the one that goes. refit: fits a model from a fit.
    """
    gone = added[place].confirmed
    assert gone.model is not None

    def reduced(model: Model) -> Model | None:
        own = replace(model, scaling=None)
        return without_change_of(own, gone.model or own, gone.before)

    left, base, smaller = list(added[:place]), added[place].base, []
    for one in added[place + 1 :]:
        assert one.confirmed.model is not None
        before, after = reduced(one.confirmed.before), reduced(one.confirmed.model)
        whole = reduced(one.fit.model)
        if before is None or after is None or whole is None:
            return None
        smaller.append((one, before, after, whole))
    for one, before, after, whole in smaller:
        fit = refit(base, whole)
        confirmed = replace(one.confirmed, before=before, model=after, fit=None)
        left.append(replace(one, confirmed=confirmed, base=base, fit=fit))
        base = fit
    return left


def is_superfluous(
    one: Added,
    with_it: Fit,
    without_it: Fit,
    record: Record,
    held_out: np.ndarray,
    settings: LoopSettings,
) -> bool:
    """Whether neither training data nor those held out speak for an effect, next to later ones.

    Args:
        one: the effect. with_it, without_it: fits of the model with all later ones.
        record: blocks A and B. held_out: (n,) True where neither fit has seen outputs.
    """
    if log_bayes_factor(with_it, without_it) > 0.0:
        return False
    more, less = (
        held_out_density(fit, record, held_out, one.found.effect.score)
        for fit in (with_it, without_it)
    )
    return not certain(more - less, settings)


def withdrawn(
    attempts: Sequence[Attempt], tests: Sequence[EffectTest], one: Added, later: str
) -> tuple[list[Attempt], list[EffectTest]]:
    """What was tried, and all tests, where an effect is rejected after all.

    Args:
        one: the effect. later: name of that which makes it superfluous.
    """
    (own,) = (a for a in attempts if a.decision == "accepted" and a.evidence is one.found.evidence)
    reason = f"{own.reason}; superfluous next to {later}"
    rejected = replace(own, decision="rejected", reason=reason)
    key = (own.round, own.name, own.output)
    return [rejected if a is own else a for a in attempts], [
        replace(t, decision="rejected")
        if (t.round, t.effect, t.output) == key and t.decision == "accepted" else t
        for t in tests
    ]  # fmt: skip
