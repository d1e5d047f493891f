"""Channels made from a record: delayed, transformed, clock-driven ones, as inputs of a model.

A model may carry channels; each record that it meets is prepared with them, so that fits,
predictions and files keep to the record as it was measured. A channel replaces one of the inputs or
adds columns; those that are `direct` act on the output at once (see `direct` of the models). Times
are on the clock of the training record, which parts of one record share.
"""

from pyro_dynogp.data.channels.base import Channel, Quantity
from pyro_dynogp.data.channels.clock import (
    Calendar,
    Ramp,
    RampOfGain,
    ShiftedClock,
    Sinusoid,
    Step,
    StepInput,
    StepOfGain,
    Trend,
    TrendOfGain,
)
from pyro_dynogp.data.channels.prepare import count_direct, from_plain, prepared, to_plain
from pyro_dynogp.data.channels.signal import (
    DeadZone,
    Delayed,
    Play,
    Product,
    Recorded,
    Transformed,
)

__all__ = [
    "Calendar",
    "Channel",
    "DeadZone",
    "Delayed",
    "Play",
    "Product",
    "Quantity",
    "Ramp",
    "RampOfGain",
    "Recorded",
    "ShiftedClock",
    "Sinusoid",
    "Step",
    "StepInput",
    "StepOfGain",
    "Transformed",
    "Trend",
    "TrendOfGain",
    "count_direct",
    "from_plain",
    "prepared",
    "to_plain",
]
