"""What every effect has: names, how it is found, which blocks add it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any, ClassVar, TypeVar

import numpy as np

from pyro_dynogp.data.channels.base import Channel, signal_of
from pyro_dynogp.data.record import Record
from pyro_dynogp.discrepancy.trials import Compared, Score
from pyro_dynogp.models.variants import Model
from pyro_dynogp.statistics.evidence import Evidence, Residuals

Kind = TypeVar("Kind", bound=Channel)
# Share of its estimate by which a limit or a width may be off, tried by refits, and then finer.
AROUND = (0.75, 1.0, 1.3)
FINER = ((0.88, 1.13), (0.95, 1.05))


class Effect:
    """Something that a model may lack.

    Attributes:
        name: of the effect. family: those that one cause may set off together.
        freedom: how much it leaves open; of two that explain the same, the one with less is kept.
        localised: whether it happens at one instant, so that refits are scored on blocks of the
            whole record rather than after it.
        score: on which densities it must pay: of forecasts, or one step ahead.
        compared: on which data its variants are: those that are fitted to, or, where variants
            differ in how they go on, those held out (the first that does as well as the best).
        special_of: name of an effect of which it is a special case; its own name is given only
            where the residual is certain of it.
        once: whether it is not looked for again in a model that has it.
        added: whether a block mends it; False for what is only reported.
        test: finds evidence in residuals; a class whose test needs more overrides `detect`.
    """

    name: ClassVar[str] = ""
    family: ClassVar[str] = ""
    freedom: ClassVar[int] = 1
    localised: ClassVar[bool] = False
    score: ClassVar[Score] = "forecast"
    compared: ClassVar[Compared] = "training"
    special_of: ClassVar[str] = ""
    once: ClassVar[bool] = False
    added: ClassVar[bool] = True
    test: ClassVar[Callable[..., Evidence | Sequence[Evidence]]]

    def detect(self, residuals: Residuals, seed: int = 0) -> Sequence[Evidence]:
        """Evidence for the effect, one for each channel it may come from; may be empty."""
        return listed(self.test(residuals, seed=seed))

    def extend(self, model: Model, evidence: Evidence, record: Record) -> Sequence[Model]:
        """Variants of the model with the effect as a block; empty where it is only reported."""
        raise NotImplementedError

    def refine(self, model: Model, record: Record, times: int) -> Sequence[Model]:
        """Variants close to the best one so far, closer each time; none by default."""
        return []

    def sentence(self, evidence: Evidence, model: Model) -> str:
        """What it is, once the model has it; what the test said by default."""
        return evidence.sentence


def listed(found: Evidence | Sequence[Evidence]) -> Sequence[Evidence]:
    """What a test found, as a sequence."""
    return [found] if isinstance(found, Evidence) else found


def number_of(evidence: Evidence, key: str) -> float:
    """A number that names the effect: a delay, a limit, a frequency."""
    return float(evidence.where[key])


def unit_of(evidence: Evidence) -> str:
    """Time unit of the record, after a number."""
    unit = str(evidence.where.get("time_unit", ""))
    return f" {unit}" if unit else ""


def centre_of(record: Record, name: str) -> float:
    """Mean of a channel [its unit]."""
    return float(np.mean(signal_of(record, name)))


def finer(model: Model, number: str, times: int) -> list[Model]:
    """The model with a number of its last channel a little smaller and larger."""
    last = model.channels[-1]
    values = [share * getattr(last, number) for share in FINER[times]]
    return [changed(model, [last], **{number: value}) for value in values]


def set_last(model: Model, kind: type[Kind], number: str) -> list[Kind]:
    """Channels of a kind that were added last, together: those that share a number."""
    last = model.channels[-1]
    assert isinstance(last, kind)
    same = getattr(last, number)
    return [c for c in model.channels if isinstance(c, kind) and getattr(c, number) == same]


def changed(model: Model, channels: Sequence[Channel], **values: Any) -> Model:
    """The model with other values of some of its channels."""
    new = tuple(replace(c, **values) if c in channels else c for c in model.channels)
    return replace(model, channels=new)
