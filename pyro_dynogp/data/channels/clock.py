"""Channels made from the clock of a record."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar
from zoneinfo import ZoneInfo, ZoneInfoNotFoundError

import numpy as np

from pyro_dynogp.data.channels.base import Channel, Quantity, signal_of
from pyro_dynogp.data.channels.signal import Replacement
from pyro_dynogp.data.record import Record
from pyro_dynogp.data.signals import delayed
from pyro_dynogp.support.errors import invalid

# Half the width of a hat at the turn of the year [days].
HAT = 4.0
# Seconds of a day, days of a year.
DAY, DAYS_A_YEAR = 86400.0, 365.2425


@dataclass(frozen=True)
class Step(Channel):
    """Zero before an instant, one from it on [time unit]: a shift of the output's level."""

    direct: ClassVar[bool] = True
    numbers: ClassVar[Mapping[str, Quantity]] = {"at": Quantity("instant", "time", inside=True)}
    at: float

    def _names(self) -> tuple[str, ...]:
        return (f"step at {self.at:.9g}",)

    def _columns(self, record: Record) -> np.ndarray:
        return (record.time >= self.at).astype(float)


@dataclass(frozen=True)
class StepInput(Step):
    """A step that acts through the dynamics, as a leak or a load that begins [time unit]."""

    direct: ClassVar[bool] = False

    def _names(self) -> tuple[str, ...]:
        return (f"disturbance from {self.at:.9g}",)


@dataclass(frozen=True)
class StepOfGain(Channel):
    """An input from an instant on: a gain that shifts.

    Args: channel: name of the input. centre: subtracted from it first [input]. at: [time unit].
    """

    numbers: ClassVar[Mapping[str, Quantity]] = {"at": Quantity("instant", "time", inside=True)}
    channel: str
    centre: float
    at: float

    def _names(self) -> tuple[str, ...]:
        return (f"{self.channel} from {self.at:.9g}",)

    def _columns(self, record: Record) -> np.ndarray:
        x = signal_of(record, self.channel) - self.centre
        return np.where(record.time >= self.at, x, 0.0)


@dataclass(frozen=True)
class Trend(Channel):
    """A straight line in time that goes from 0 at `begin` to 1 at `end` [time unit], and on."""

    direct: ClassVar[bool] = True
    begin: float
    end: float

    def _names(self) -> tuple[str, ...]:
        return ("trend",)

    def _columns(self, record: Record) -> np.ndarray:
        return (record.time - self.begin) / (self.end - self.begin)


@dataclass(frozen=True)
class TrendOfGain(Channel):
    """An input times a straight line in time, 0 at `begin` and 1 at `end`: a gain that drifts.

    Args:
        channel: name of the input. centre: subtracted from it first [input].
        begin, end: [time unit].
    """

    course: ClassVar[type[Trend]] = Trend
    channel: str
    centre: float
    begin: float
    end: float

    def _names(self) -> tuple[str, ...]:
        return (f"{self.channel} times trend",)

    def _columns(self, record: Record) -> np.ndarray:
        line = self.course(self.begin, self.end).columns(record)[:, 0]
        return (signal_of(record, self.channel) - self.centre) * line


@dataclass(frozen=True)
class Ramp(Trend):
    """Zero until `begin`, one from `end` on [time unit], a straight line between them.

    Several make a path of the output's level.
    """

    def _names(self) -> tuple[str, ...]:
        return (f"ramp {self.begin:.9g} to {self.end:.9g}",)

    def _columns(self, record: Record) -> np.ndarray:
        return np.clip(super()._columns(record), 0.0, 1.0)


@dataclass(frozen=True)
class RampOfGain(TrendOfGain):
    """An input times a `Ramp`. Several make a path of a gain.

    Args:
        channel: name of the input. centre: subtracted from it first [input].
        begin, end: [time unit].

    Examples:
        >>> from pyro_dynogp.data.channels import RampOfGain
        >>> record = dgp.Record([0.0, 1.0, 2.0, 3.0], [3.0, 3.0, 3.0, 3.0], [0.0, 1.0, 1.0, 2.0])
        >>> RampOfGain("u", 1.0, 0.0, 2.0).columns(record)[:, 0]
        array([0., 1., 2., 2.])
    """

    course: ClassVar[type[Trend]] = Ramp

    def _names(self) -> tuple[str, ...]:
        return (f"{self.channel} times ramp {self.begin:.9g} to {self.end:.9g}",)


@dataclass(frozen=True)
class Sinusoid(Channel):
    """Cosine and sine of a known period [time unit] and of its harmonics."""

    direct: ClassVar[bool] = True
    numbers: ClassVar[Mapping[str, Quantity]] = {"period": Quantity("period", "time")}
    period: float
    harmonics: int = 1

    def _names(self) -> tuple[str, ...]:
        return tuple(
            f"{form} {k} of period {self.period:.9g}"
            for k in range(1, self.harmonics + 1)
            for form in ("cosine", "sine")
        )

    def _columns(self, record: Record) -> np.ndarray:
        return fourier(record.time / self.period, self.harmonics)


@dataclass(frozen=True)
class Calendar(Channel):
    """Parts of the calendar in a time zone, for records with time stamps.

    Args:
        what: "hour of day" (harmonics of the day), "weekend" (one column), "weekday" (six), "hour
            of day by weekend" (both, and their products), "time of year" (harmonics of the year)
            or "turn of the year" (seven hats four days apart around the first of January: what
            shuts down over the holidays).
        zone: an IANA time zone such as "Australia/Melbourne".
        harmonics: of the day, or of the year.
    """

    direct: ClassVar[bool] = True
    what: str
    zone: str = "UTC"
    harmonics: int = 6

    def __post_init__(self) -> None:
        if self.what not in PARTS:
            raise invalid("what", expected=f"one of {list(PARTS)}", got=repr(self.what))
        try:
            ZoneInfo(self.zone)
        except (ZoneInfoNotFoundError, ValueError) as error:
            raise invalid("zone", expected="an IANA time zone", got=repr(self.zone)) from error

    def _names(self) -> tuple[str, ...]:
        nothing = np.zeros(1)
        count = PARTS[self.what](nothing, nothing, nothing, self.harmonics).shape[1]
        return tuple(f"{self.what} {k}" for k in range(1, count + 1))

    def _columns(self, record: Record) -> np.ndarray:
        if record.timestamps is None:
            raise invalid(
                "record", expected="time stamps, for a calendar", got="a clock without a date"
            )
        local = record.timestamps.tz_convert(self.zone)
        day = np.asarray(local.hour * 3600.0 + local.minute * 60.0 + local.second) / DAY
        year = (np.asarray(local.day_of_year) - 1.0 + day) / DAYS_A_YEAR
        weekday = np.asarray(local.day_of_week, dtype=float)
        return PARTS[self.what](day, weekday, year, self.harmonics)


@dataclass(frozen=True)
class ShiftedClock(Replacement):
    """An input whose clock is off by a constant between some instants: u(t + shift) there.

    Args:
        channel: name of the input. shift: by how much it is to be read ahead [time unit].
        times: instants at which the shift begins and, in turn, ends [time unit].
    """

    label: ClassVar[str] = "on a corrected clock"
    numbers: ClassVar[Mapping[str, Quantity]] = {"shift": Quantity("clock shift", "time")}
    shift: float
    times: tuple[float, ...]

    def _columns(self, record: Record) -> np.ndarray:
        signal = signal_of(record, self.channel)
        ahead = delayed(signal, record.time, -self.shift)
        off = np.searchsorted(np.asarray(self.times), record.time, side="right") % 2 == 1
        return np.where(off, ahead, signal)


def fourier(cycles: np.ndarray, harmonics: int) -> np.ndarray:
    """Cosines and sines (n, 2 harmonics) of cycles counted (n,)."""
    angles = 2.0 * np.pi * cycles[:, None] * np.arange(1, harmonics + 1)
    return np.stack([np.cos(angles), np.sin(angles)], -1).reshape(len(cycles), -1)


def _hours(day: np.ndarray, weekday: np.ndarray, year: np.ndarray, harmonics: int) -> np.ndarray:
    return fourier(day, harmonics)


def _weekend(day: np.ndarray, weekday: np.ndarray, year: np.ndarray, harmonics: int) -> np.ndarray:
    return (weekday >= 5).astype(float)[:, None]


def _weekday(day: np.ndarray, weekday: np.ndarray, year: np.ndarray, harmonics: int) -> np.ndarray:
    return (weekday[:, None] == np.arange(1, 7)).astype(float)


def _both(day: np.ndarray, weekday: np.ndarray, year: np.ndarray, harmonics: int) -> np.ndarray:
    rest, hours = _weekend(day, weekday, year, harmonics), fourier(day, harmonics)
    return np.column_stack([hours, rest, rest * hours])


def _seasons(day: np.ndarray, weekday: np.ndarray, year: np.ndarray, harmonics: int) -> np.ndarray:
    return fourier(year, harmonics)


def turn_of_the_year(year: np.ndarray) -> np.ndarray:
    """Seven hats (n, 7) around the turn of the year, zero from 16 days before and after it.

    Args:
        year: (n,) share of the year that has gone by.
    """
    days = (np.asarray(year) % 1.0 + 0.5) % 1.0 * DAYS_A_YEAR - 0.5 * DAYS_A_YEAR
    centres = HAT * np.arange(-3.0, 4.0)
    return np.clip(1.0 - np.abs(days[:, None] - centres) / HAT, 0.0, None)


def _turn(day: np.ndarray, weekday: np.ndarray, year: np.ndarray, harmonics: int) -> np.ndarray:
    return turn_of_the_year(year)


# Columns of each part of the calendar from the share of the day, the day of the week (Monday 0)
# and the share of the year that have gone by.
PARTS = {
    "hour of day": _hours,
    "weekend": _weekend,
    "weekday": _weekday,
    "hour of day by weekend": _both,
    "time of year": _seasons,
    "turn of the year": _turn,
}
