"""What every effect has: how it is detected, which blocks add it, what tells it from others."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any, ClassVar, Literal, TypeVar

import numpy as np

from pyro_dynogp.data.channels.base import Channel, signal_of
from pyro_dynogp.data.record import Record
from pyro_dynogp.models.variants import Model
from pyro_dynogp.statistics.evidence import Evidence, Residuals
from pyro_dynogp.statistics.settings import LoopSettings

if TYPE_CHECKING:
    from pyro_dynogp.fitting import Fit

# Densities on which an effect must pay.
Score = Literal["one step", "forecast"]
# Data on which variants of an effect are compared.
Compared = Literal["training", "known", "held out", "rehearsed"]
ActsOn = Literal["inputs", "time", "noise"]
# Posterior mean and standard deviation of numbers by label, unit included.
Parameters = dict[str, tuple[float, float]]
Kind = TypeVar("Kind", bound=Channel)
# Share of its estimate by which a limit or a width may be off, tried by refits, and then finer.
AROUND = (0.75, 1.0, 1.3)
FINER = ((0.88, 1.13), (0.95, 1.05))
# In a tie, what products of inputs at two times, or responses that change with time, speak for.
OUTSIDE = "a cause outside the catalogue"
_OUTSIDE_EXPERIMENT = (
    "the same input twice, at another time and at half the size: what is constant responds "
    "alike, what is linear half as much"
)


class Effect:
    """Something that a model may lack.

    Attributes:
        name: of the effect. family: those that one cause may set off together.
        freedom: how much it leaves open; of two that explain the same, the one with less is kept.
        score: on which densities it must pay: of forecasts, or one step ahead.
        acts_on: what the test looks at. "inputs": responses of the output to inputs, looked for in
            all data and in what the model leaves without its process noise, which takes up what
            inputs do. "time" or "noise": looked for in the held-out residuals of the model as it
            is, which follow both.
        special_of: name of an effect of which it is a special case; its own name is given only
            where the residual is certain of it.
        once: whether it is not looked for again in a model that has it.
        imitated: whether slow poles and process noise imitate it so well that its test hardly ever
            sees it: it is refitted wherever something is left, or forecasts miss.
        added: whether a block mends it; False for what is only reported.
        localised: whether it happens at one instant, so that refits are scored on blocks of the
            whole record rather than after it.
        compared: on which data its variants are: those that are fitted to; all that are "known",
            where they differ at an instant that may be held out; those held out, where the first is
            kept, or a later one that is certainly better; or "rehearsed", for variants that differ
            in how they extrapolate: held out, of those whose forecasts last.
        absorbs_structure: whether its block takes up whatever else a model lacks, so that a search
            begins without it.
        settled_by_evidence: whether the density of one block may be far too uncertain to confirm
            it, however right it is: where tests are certain and it gains at all, the evidence of
            all known data decides.
        experiments: by name of another effect, the experiment that tells the two apart. One of
            the two effects need say so.
        test: finds evidence in residuals; a class whose test needs more overrides `detect`.
    """

    name: ClassVar[str] = ""
    family: ClassVar[str] = ""
    freedom: ClassVar[int] = 1
    score: ClassVar[Score] = "forecast"
    acts_on: ClassVar[ActsOn] = "time"
    special_of: ClassVar[str] = ""
    once: ClassVar[bool] = False
    imitated: ClassVar[bool] = False
    added: ClassVar[bool] = True
    localised: ClassVar[bool] = False
    compared: ClassVar[Compared] = "training"
    absorbs_structure: ClassVar[bool] = False
    settled_by_evidence: ClassVar[bool] = False
    experiments: ClassVar[Mapping[str, str]] = {}
    test: ClassVar[Callable[..., Evidence | Sequence[Evidence]]]

    @property
    def mimicked_by_feedback(self) -> bool:
        """Whether inputs that follow the output's disturbances may look like it."""
        return self.acts_on == "inputs"

    def detect(
        self, residuals: Residuals, settings: LoopSettings, seed: int = 0
    ) -> Sequence[Evidence]:
        """Evidence for the effect, one for each channel it may come from; may be empty.

        Args:
            residuals: of one output (n,). settings: thresholds, those of the loop.
            seed: of what is simulated under the null.

        Raises:
            ValueError: where the residuals cannot be tested for it, as where too few samples are
                measured (those held out, for effects that are looked for there).
        """
        return listed(self.test(residuals, settings, seed=seed))

    def extend(self, model: Model, evidence: Evidence, record: Record) -> Sequence[Model]:
        """Variants of the model with the effect as a block; empty where it is only reported."""
        raise NotImplementedError

    def refine(self, model: Model, record: Record, times: int) -> Sequence[Model]:
        """Variants close to the best one so far, closer each time; none by default."""
        return []

    def sentence(self, evidence: Evidence, model: Model) -> str:
        """What it is, once the model has it; what the test said by default."""
        return evidence.sentence

    def shape(self, parameters: Parameters) -> str:
        """What its numbers come to, in a sentence of its own that follows; "" for nothing.

        Args:
            parameters: of its channels, and those that the effect adds.
        """
        return ""

    def parameters(self, fit: Fit, evidence: Evidence, record: Record) -> Parameters:
        """Posterior mean and standard deviation of numbers that are not those of its channels.

        Numbers of the channels that `extend` adds (their gains, and the fields that they list in
        `numbers`) have a posterior without this. None more by default.

        Args:
            fit: of the extended model, to the record. evidence: that the effect was added for.
            record: as measured, without the channels.
        """
        return {}


def experiment(name: str, others: Sequence[str], effects: Collection[Effect]) -> str:
    """Which experiment tells an effect from others; "" for no others.

    Args:
        name: of the effect. others: names of those that explain the data as well, or `OUTSIDE`.
        effects: those that were looked for; they say which experiments tell them apart.
    """
    said = {(e.name, other): text for e in effects for other, text in e.experiments.items()}
    texts = [said.get((name, other)) or said.get((other, name)) for other in others]
    known = [text for text in texts if text]
    if OUTSIDE in others:
        known.append(_OUTSIDE_EXPERIMENT)
    if known:
        return "; ".join(dict.fromkeys(known))
    return "a record with inputs for which their predictions differ" if others else ""


def listed(evidence: Evidence | Sequence[Evidence]) -> Sequence[Evidence]:
    """What a test returns, as a sequence."""
    return [evidence] if isinstance(evidence, Evidence) else evidence


def variants_of(extended: Model | None) -> list[Model]:
    """The one variant that an extension gives; none where it gives none."""
    return [] if extended is None else [extended]


def number_of(evidence: Evidence, key: str) -> float:
    """A number that names the effect: a delay, a limit, a frequency."""
    return float(evidence.where[key])


def unit_of(evidence: Evidence) -> str:
    """Time unit of the record, after a number."""
    unit = str(evidence.where.get("time_unit", ""))
    return f" {unit}" if unit else ""


def driving_names(model: Model, prepared: Record) -> tuple[str, ...]:
    """Inputs that act through dynamics, of a record that is prepared for the model."""
    return prepared.input_names[: prepared.n_inputs - model.direct]


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
