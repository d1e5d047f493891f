"""Effects that are functions: static ones at either end, and play."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import ClassVar

import numpy as np

from pyro_dynogp.data.channels import DeadZone, Play
from pyro_dynogp.data.record import Record
from pyro_dynogp.effects.base import AROUND, FINER, Effect, changed, finer, number_of
from pyro_dynogp.effects.shape_effects import (
    dead_zone,
    hysteresis,
    input_nonlinearity,
    output_nonlinearity,
    saturation,
)
from pyro_dynogp.models.variants import (
    Model,
    with_channel,
    with_input_function,
    with_output_function,
)
from pyro_dynogp.statistics.evidence import Evidence


class Nonlinearity(Effect):
    """A static function at one end of the model.

    Attributes:
        add: the model with that function, None where it has one.
    """

    family = "shapes"
    freedom = 4
    add: ClassVar[Callable[..., Model | None]]

    def extend(self, model: Model, evidence: Evidence, record: Record) -> Sequence[Model]:
        """A static layer at that end."""
        extended = self.add(model)
        return [] if extended is None else [extended]


class OutputNonlinearity(Nonlinearity):
    """A function of the model's output: a sensor that is not linear."""

    name = "output nonlinearity"
    test = staticmethod(output_nonlinearity)
    add = staticmethod(with_output_function)


class Saturation(Effect):
    """A sensor that clips."""

    name = "saturation"
    family = "shapes"
    special_of = OutputNonlinearity.name
    once = True
    test = staticmethod(saturation)

    def extend(self, model: Model, evidence: Evidence, record: Record) -> Sequence[Model]:
        """A static layer at the output whose prior mean stops at the limits."""
        low, high = (
            at if np.isfinite(at := number_of(evidence, end)) else None for end in ("low", "high")
        )
        # Which of several outputs the limits are of is not said, and what acts on the output
        # directly comes on top of the sensor.
        if model.outputs > 1 or model.direct:
            low = high = None
        limits = None if low is None and high is None else (low, high)
        extended = with_output_function(model, limits)
        return [] if extended is None else [extended]


class InputNonlinearity(Nonlinearity):
    """A function of an input: an actuator that is not linear."""

    name = "input nonlinearity"
    test = staticmethod(input_nonlinearity)
    add = staticmethod(with_input_function)


class DeadZoneOfInput(Effect):
    """An actuator that does nothing around the middle."""

    name = "dead zone"
    family = "shapes"
    freedom = 2
    test = staticmethod(dead_zone)

    def extend(self, model: Model, evidence: Evidence, record: Record) -> Sequence[Model]:
        """The input beyond limits around the estimate."""
        channel = str(evidence.where["channel"])
        low, high = number_of(evidence, "low"), number_of(evidence, "high")
        middle, half = 0.5 * (low + high), 0.5 * (high - low)
        return [
            with_channel(model, DeadZone(channel, middle - share * half, middle + share * half))
            for share in AROUND
        ]

    def refine(self, model: Model, record: Record, times: int) -> Sequence[Model]:
        """Each limit a little lower and higher."""
        last = model.channels[-1]
        assert isinstance(last, DeadZone)
        width = last.high - last.low
        return [
            changed(model, [last], **{limit: getattr(last, limit) + (share - 1.0) * width})
            for share in FINER[times]
            for limit in ("low", "high")
        ]


class Hysteresis(Effect):
    """Mechanical play of an actuator."""

    name = "hysteresis"
    family = "shapes"
    freedom = 2
    test = staticmethod(hysteresis)

    def extend(self, model: Model, evidence: Evidence, record: Record) -> Sequence[Model]:
        """The input behind play of widths around the estimate; play of a sensor is reported."""
        channel, width = str(evidence.where["channel"]), number_of(evidence, "width")
        if channel in record.output_names:
            return []
        return [with_channel(model, Play(channel, share * width)) for share in AROUND]

    def refine(self, model: Model, record: Record, times: int) -> Sequence[Model]:
        """The play a little narrower and wider."""
        return finer(model, "width", times)
