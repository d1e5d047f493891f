"""Channels made from recorded signals."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from pyro_dynogp.data.channels.base import Channel, Quantity, signal_of, unit_of
from pyro_dynogp.data.record import Record
from pyro_dynogp.data.signals import dead_zone, delayed, play
from pyro_dynogp.support.errors import POSITIVE, between, instance, invalid

FINITE = between(-np.inf, np.inf, "a finite number [time unit], or none")


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
    """An input that arrives later: u(t - delay), held between samples.

    Without a number the dead time is a parameter with a posterior, an entry of the site ``delay``
    of the model, which `fit` estimates: fractions of a sample, too. Its prior is half-Cauchy,

        p(d) = 2 / (pi m (1 + (d / m)^2)),   d >= 0,

    with the median m = sqrt(step * duration / pi), between the fastest and the slowest rates that
    the record can show: 3 samples of 30, 10 of 300, 18 of 1000. It is level near zero, and beyond m
    it falls as 1/d^2 alone, so that a few changes of the input say more than it does. The first
    dynamic layer has no direct path (`feedthrough`) for the input: an effect that begins a step
    later and another dead time would be one and the same. The output of a plant that answers within
    a step moves at the next sample, and its dead time comes out up to a step shorter.

    Before the record its first value is held, which is not what acted then. `fit` and `close_loop`
    take outputs for missing until the first input of the record has arrived, and the state of the
    dynamics for unknown then.

    A given delay averages the input over each step: exact for whole numbers of steps; between them
    right for systems that are slow beside a step. A free one is exact for a dynamic layer that sees
    the inputs, at any fraction (`models.late_systems`); for others it averages, too.

    Args:
        channel: name of the input.
        delay: dead time [time unit], may be a fraction of a step; None where data are to say it.
        median: of the prior of a dead time that data are to say [time unit]; None for the above.

    Raises:
        ValueError: where `delay` or `median` is no number, or both are given.

    Examples:
        >>> import numpy as np, pyro_dynogp as dgp
        >>> rng = np.random.default_rng(0)
        >>> u, y = np.repeat(rng.normal(size=20), 6), np.zeros(120)
        >>> for k in range(4, 120):
        ...     y[k] = 0.8 * y[k - 1] + 0.2 * u[k - 4]  # held inputs, three steps late
        >>> record = dgp.Record(3.0 * np.arange(120), u, y + 0.02 * rng.normal(size=120),
        ...                     input_names=("u",), time_unit="s")
        >>> model = dgp.LinearDynamicGP(inputs=1, pairs=1, channels=(dgp.Delayed("u"),))
        >>> fit = dgp.fit(model, record, progress=False)
        >>> round(float(fit.draws["delay"].mean()))  # fit.summary() has it with its spread
        9
    """

    label: ClassVar[str] = "delayed"
    numbers: ClassVar[Mapping[str, Quantity]] = {"delay": Quantity("dead time", "time", 0.0)}
    delay: float | None = None
    median: float | None = None

    def __post_init__(self) -> None:
        instance("channel", self.channel, str)
        if self.delay is not None:
            FINITE.check("delay", self.delay)
        if self.median is not None:
            POSITIVE.check("median", self.median)
            if self.delay is not None:
                raise invalid(
                    "median",
                    expected="None where the delay is given",
                    got=repr(self.median),
                    advice="It is of the prior of a dead time that is not known: leave delay out.",
                )

    @property
    def free(self) -> bool:
        """Whether the dead time is a parameter of the model."""
        return self.delay is None

    def _columns(self, record: Record) -> np.ndarray:
        signal = signal_of(record, self.channel)
        if self.delay is None:  # the model delays it
            return signal
        return delayed(signal, record.time, self.delay)


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
