"""A candidate's refit against the model without it: whether held-out data speak for it."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from pyro_dynogp.criticism.comparison import block_standard_error
from pyro_dynogp.discrepancy.held_out import certain
from pyro_dynogp.discrepancy.result import Attempt, Decision
from pyro_dynogp.discrepancy.search import Found
from pyro_dynogp.discrepancy.trials import Tried
from pyro_dynogp.effects.base import Score
from pyro_dynogp.statistics.settings import LoopSettings

# Where densities are scored: after the training data, or on blocks spread over the whole record.
Where = Literal["after", "spread"]
Kind = tuple[Where, Score]
# Of forecasts of blocks that are spread over the record.
SPREAD: Kind = ("spread", "forecast")
# How a reason ends that asks for more samples.
MORE = "would settle it"
# So many times as many samples are not called more of them.
MOST_MORE = 10.0


@dataclass(frozen=True, eq=False)
class Judged:
    """A candidate, its refit, its gain over the model without it, and whether that is enough.

    Attributes:
        helps: whether it gains for certain. harms: whether its forecasts are certainly worse.
    """

    found: Found
    kind: Kind
    tried: Tried
    attempt: Attempt
    helps: bool = False
    harms: bool = False


def kind_of(found: Found) -> Kind:
    """Where an effect is scored, and on which densities."""
    effect = found.effect
    return SPREAD if effect.localised else ("after", effect.score)


def judge(
    found: Found,
    kind: Kind,
    tried: Tried,
    base: Tried,
    number: int,
    settings: LoopSettings,
) -> Judged:
    """A candidate against the model without it.

    What the residual hardly speaks for has to gain by more standard errors: some of several
    refits gain by chance.
    """
    evidence, q = found.evidence, found.q_value
    enough = settings
    if evidence.p_value > settings.unsure:
        errors = max(settings.standard_errors, settings.unsure_errors)
        enough = replace(settings, standard_errors=errors)
    if tried.failure or base.failure:
        reason = f"could not be fitted: {tried.failure or base.failure}"
        return Judged(found, kind, tried, Attempt(number, evidence, q, "rejected", reason))
    d = tried.densities - base.densities
    gain, error = float(d.sum()), block_standard_error(d)[0]
    reason = f"held-out elpd {gain:+.1f} +- {error:.1f} nats"
    helps, capped = certain(d, enough), np.minimum(d, settings.cap)
    if not helps and certain(capped, enough):
        helps = True
        reason += f"; {capped.sum():+.1f} with no sample counted for more than {settings.cap:.0f}"
    harms = False
    if len(tried.errors):  # what makes data more probable must not cost their forecasts
        loss = loss_of(tried.errors, base.errors)
        harms = certain(loss, settings) and bool(loss.mean() > settings.harm)
        if harms:
            reason += (
                f"; forecasts worse by {loss.sum():.1f} +- {block_standard_error(loss)[0]:.1f}"
            )
    helps = helps and not harms
    wanted = 0 if helps or harms else enough_samples(gain, error, len(d), enough)
    if wanted:
        reason += f"; about {wanted} samples like these {len(d)} {MORE}"
    decision: Decision = "nearly" if wanted else "rejected"
    attempt = Attempt(number, evidence, q, decision, reason, gain, error, tried.seconds)
    return Judged(found, kind, tried, attempt, helps, harms)


def enough_samples(gain: float, error: float, count: int, settings: LoopSettings) -> int:
    """How many samples would make a gain certain that nearly is; 0 where it is not nearly so.

    Nearly is from `settings.nearly` block standard errors on. A gain grows like the number of
    samples and its error like the square root of it, so that gain / error = c takes
    (c error / gain)^2 times as many; rounded up to two digits. What takes more than `MOST_MORE`
    times as many is no gain.

    Args:
        gain, error: in log density of `count` samples, with its block standard error [nats].
    """
    if not settings.nearly * error <= gain <= settings.standard_errors * error or gain <= 0.0:
        return 0
    times = max((settings.standard_errors * error / gain) ** 2, settings.gain / gain)
    if times > MOST_MORE:
        return 0
    wanted = count * times
    digit = 10 ** max(int(np.log10(wanted)) - 1, 0)
    return int(np.ceil(wanted / digit)) * digit


def loss_of(errors: np.ndarray, base: np.ndarray) -> np.ndarray:
    """By how much forecasts are worse than those of the base, sample by sample [nats].

    Log-densities of errors (M, n_y) under one double exponential distribution, that which suits the
    base: what the noise is thought to be does not come in, and outliers hardly.
    """
    worse = (np.abs(errors) - np.abs(base)) / np.nanmean(np.abs(base), axis=0)
    return worse[np.isfinite(worse)]
