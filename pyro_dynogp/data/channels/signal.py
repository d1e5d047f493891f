"""Channels made from recorded signals."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from pyro_dynogp.data.channels.base import Channel, Quantity, signal_of, unit_of
from pyro_dynogp.data.record import Record
from pyro_dynogp.data.signals import dead_zone, delayed, play
from pyro_dynogp.support.errors import invalid


@dataclass(frozen=True)
class Recorded(Channel):
    """An extra channel of the record as an input; its gaps hold the value before them."""

    channel: str

    def _names(self) -> tuple[str, ...]:
        return (self.channel,)

    def _units(self, record: Record) -> tuple[str, ...]:
        return (unit_of(record, self.channel),)

    def _columns(self, record: Record) -> np.ndarray:
        return signal_of(record, self.channel)


@dataclass(frozen=True)
class Replacement(Channel):
    """One input as something else in the same unit."""

    replacing: ClassVar[bool] = True
    label: ClassVar[str] = ""
    channel: str

    def _names(self) -> tuple[str, ...]:
        return (f"{self.channel} {self.label}",)

    def _units(self, record: Record) -> tuple[str, ...]:
        return (unit_of(record, self.channel),)


@dataclass(frozen=True)
class Delayed(Replacement):
    """An input that arrives later: u(t - delay), held between samples, averaged over each step.

    Before the record its first value is held, which is not what acted then: `close_loop` takes
    outputs for missing until the first input of the record has arrived, and in a record for `fit`
    they had better be NaN. Exact for whole numbers of steps; between them right for systems that
    are slow beside a step.

    Args:
        channel: name of the input. delay: [time unit], may be a fraction of a step.
    """

    label: ClassVar[str] = "delayed"
    numbers: ClassVar[Mapping[str, Quantity]] = {"delay": Quantity("dead time", "time", 0.0)}
    delay: float

    def _columns(self, record: Record) -> np.ndarray:
        return delayed(signal_of(record, self.channel), record.time, self.delay)


@dataclass(frozen=True)
class DeadZone(Replacement):
    """An input that does nothing between two limits: what of it lies beyond them.

    Args: channel: name of the input. low, high: limits [input].
    """

    label: ClassVar[str] = "beyond dead zone"
    numbers: ClassVar[Mapping[str, Quantity]] = {
        "low": Quantity("lower limit", "channel"),
        "high": Quantity("upper limit", "channel"),
    }
    low: float
    high: float

    def _columns(self, record: Record) -> np.ndarray:
        return dead_zone(signal_of(record, self.channel), self.low, self.high)


@dataclass(frozen=True)
class Play(Replacement):
    """An input behind mechanical play (backlash) of the given full width [input]."""

    label: ClassVar[str] = "behind play"
    numbers: ClassVar[Mapping[str, Quantity]] = {"width": Quantity("play", "channel", 0.0)}
    width: float

    def _columns(self, record: Record) -> np.ndarray:
        return play(signal_of(record, self.channel), self.width)


@dataclass(frozen=True)
class Transformed(Channel):
    """A function of a channel beside it: "square" or "absolute", about its `centre`.

    Args: channel: input or extra channel. form: the function. centre: subtracted first [channel].
    """

    channel: str
    form: str
    centre: float

    def __post_init__(self) -> None:
        if self.form not in ("square", "absolute"):
            raise invalid("form", expected="'square' or 'absolute'", got=repr(self.form))

    def _names(self) -> tuple[str, ...]:
        return (f"{self.form} of {self.channel}",)

    def _columns(self, record: Record) -> np.ndarray:
        x = signal_of(record, self.channel) - self.centre
        return x**2 if self.form == "square" else np.abs(x)


@dataclass(frozen=True)
class Product(Channel):
    """Product of two channels, each about its centre.

    Args: first, second: inputs or extra channels. first_centre, second_centre: subtracted.
    """

    first: str
    second: str
    first_centre: float
    second_centre: float

    def _names(self) -> tuple[str, ...]:
        return (f"{self.first} times {self.second}",)

    def _columns(self, record: Record) -> np.ndarray:
        a = signal_of(record, self.first) - self.first_centre
        return a * (signal_of(record, self.second) - self.second_centre)
