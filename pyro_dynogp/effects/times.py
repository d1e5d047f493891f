"""Effects that go with time: drifts, steps, periods, calendars, clocks."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pandas as pd

from pyro_dynogp.data.channels import Calendar, ShiftedClock, Sinusoid, Step, Trend, TrendOfGain
from pyro_dynogp.data.channels.clock import DAY
from pyro_dynogp.data.record import Record
from pyro_dynogp.effects.base import (
    Effect,
    centre_of,
    changed,
    listed,
    number_of,
    set_last,
    unit_of,
)
from pyro_dynogp.effects.calendar import calendar
from pyro_dynogp.effects.clock_effects import clock_shift, off
from pyro_dynogp.effects.periodic import periodic_disturbance
from pyro_dynogp.effects.time_effects import drift, level_shift
from pyro_dynogp.models.variants import (
    Model,
    with_channel,
    with_pairs,
    with_process_noise,
    without_channel,
)
from pyro_dynogp.statistics.evidence import Evidence, Residuals
from pyro_dynogp.statistics.time_pictures import in_words

# One zone for each common rule of daylight saving: clocks tell zones apart by their transitions.
ZONES = (
    "UTC", "Europe/Berlin", "America/New_York", "America/Santiago", "Australia/Melbourne",
    "Pacific/Auckland",
)  # fmt: skip
# Parts of the calendar under the names of the channel that stands for them.
CALENDAR_PARTS = {
    "hour of day by weekday/weekend": "hour of day by weekend",
    "season": "time of year",
}

# Samples by which the instant of a shifted clock is moved to refine it, first and then.
FARTHEST = ((7, 14, 21, 28, 35), (1, 2, 3))

# Shares of its resolution by which a period is moved to refine it, first and then.
NEARER = ((-0.1, -0.05, 0.05, 0.1), (-0.03, 0.03))


class Drift(Effect):
    """A level, or a gain, that changes slowly."""

    name = "drift"
    family = "time"
    compared = "held out"
    test = staticmethod(drift)

    def extend(self, model: Model, evidence: Evidence, record: Record) -> Sequence[Model]:
        """A straight line in time, or a random path; or each input times a line.

        The random path is a pair of poles, as slow as suits it, that process noise drives. What is
        nearly straight so far need not go on so: held-out data say whether it does.
        """
        begin, end = float(record.time[0]), float(record.time[-1])
        if evidence.where["form"] == "additive":
            path = with_process_noise(with_pairs(model, 1))
            return [with_channel(model, Trend(begin, end)), path]
        extended = model
        prepared = model.check(record)[0]
        driving = prepared.n_inputs - model.direct
        for name in prepared.input_names[:driving]:
            extended = with_channel(
                extended, TrendOfGain(name, centre_of(prepared, name), begin, end)
            )
        return [extended]


class LevelShift(Effect):
    """A level that jumps at one instant."""

    name = "level shift"
    family = "time"
    localised = True
    test = staticmethod(level_shift)

    def extend(self, model: Model, evidence: Evidence, record: Record) -> Sequence[Model]:
        """A step at the instant."""
        return [with_channel(model, Step(number_of(evidence, "time")))]


class PeriodicDisturbance(Effect):
    """A line that no input explains."""

    name = "periodic disturbance"
    family = "time"
    freedom = 4  # its period is free, where the calendar's are known
    test = staticmethod(periodic_disturbance)

    def extend(self, model: Model, evidence: Evidence, record: Record) -> Sequence[Model]:
        """A sinusoid of the period, and of periods within its resolution.

        Or of two and three times the period: process noise may have taken the fundamental, and the
        residual has a harmonic only.
        """
        period = number_of(evidence, "period")
        width = period**2 / record.duration
        waves = [Sinusoid(period + share * width, 1) for share in (-0.2, -0.1, 0.0, 0.1, 0.2)]
        waves.append(Sinusoid(period, 3))
        # What does not come twice in a record is a drift.
        waves += [Sinusoid(k * period, k) for k in (2, 3) if 2 * k * period <= record.duration]
        return [with_channel(model, wave) for wave in waves]

    def refine(self, model: Model, record: Record, times: int) -> Sequence[Model]:
        """The period a little shorter and longer, in shares of its resolution."""
        wave = model.channels[-1]
        assert isinstance(wave, Sinusoid)
        width = wave.period**2 / record.duration
        return [
            changed(model, [wave], period=wave.period + share * width) for share in NEARER[times]
        ]

    def sentence(self, evidence: Evidence, model: Model) -> str:
        """The period as refits have it."""
        wave = model.channels[-1]
        assert isinstance(wave, Sinusoid)
        several = f" and {wave.harmonics} harmonics" if wave.harmonics > 1 else ""
        return (
            f"A disturbance of {evidence.where['output']!r} with a period of "
            f"{wave.period:.4g}{unit_of(evidence)}{several}."
        )


class CalendarEffect(Effect):
    """Hours, weekdays or seasons, for records with time stamps.

    Args:
        zones: IANA zones on whose clocks the calendar may run, beside that of the stamps.
    """

    name = "calendar"
    family = "time"
    freedom = 3

    def __init__(self, zones: Sequence[str] = ZONES) -> None:
        self.zones = tuple(zones)

    def detect(self, residuals: Residuals, seed: int = 0) -> Sequence[Evidence]:
        """One of the day and the week, and one of the year where the record is long enough."""
        if residuals.stamps is None:
            return []
        return calendar(residuals, zones=self.zones, seed=seed)

    def extend(self, model: Model, evidence: Evidence, record: Record) -> Sequence[Model]:
        """The part of the calendar as direct inputs; or all that the model has, on that clock.

        In place of the same part, if the model has it: with twice the harmonics if on that clock,
        as far as the steps of the record tell harmonics of a day apart.
        """
        what, zone = str(evidence.where["what"]), str(evidence.where["zone"])
        part = CALENDAR_PARTS.get(what, what)
        there = [one for one in model.channels if isinstance(one, Calendar)]
        harmonics, plain = 3 if part == "time of year" else 6, model
        for one in there:
            if one.what == part:
                plain = without_channel(plain, one)
                harmonics = max(harmonics, one.harmonics * (2 if one.zone == zone else 1))
        if part != "time of year":
            harmonics = max(1, min(harmonics, int(0.5 * DAY / record.sampling_time)))
        variants = [with_channel(plain, Calendar(part, zone, harmonics))]
        if any(one.zone != zone for one in there):
            channels = tuple(
                replace(c, zone=zone) if isinstance(c, Calendar) else c for c in model.channels
            )
            variants.append(replace(model, channels=channels))
        return variants


class ClockShift(Effect):
    """An input whose clock is off in part of the record.

    Args:
        zones: IANA zones whose daylight saving may be what shifts it, for records with stamps.
    """

    name = "clock shift"
    family = "time"
    localised = True

    def __init__(self, zones: Sequence[str] = ZONES) -> None:
        self.zones = tuple(zones)

    def detect(self, residuals: Residuals, seed: int = 0) -> Sequence[Evidence]:
        """One for each input."""
        zones = () if residuals.stamps is None else self.zones
        return listed(clock_shift(residuals, zones=zones, seed=seed))

    def extend(self, model: Model, evidence: Evidence, record: Record) -> Sequence[Model]:
        """The input, and all inputs, read at other times from the instant on."""
        channel, shift = str(evidence.where["channel"]), number_of(evidence, "shift")
        times: tuple[float, ...] = (number_of(evidence, "time"),)
        if "rule" in evidence.where:
            times = seasons(record, str(evidence.where["rule"]), str(evidence.where["season"]))
        together = model
        prepared = model.check(record)[0]
        for name in prepared.input_names[: prepared.n_inputs - model.direct]:
            together = with_channel(together, ShiftedClock(name, shift, times))
        alone = with_channel(model, ShiftedClock(channel, shift, times))
        return [alone] if together == alone else [alone, together]

    def sentence(self, evidence: Evidence, model: Model) -> str:
        """The shift and its instant as refits have them."""
        found = set_last(model, ShiftedClock, "times")
        last = found[-1]
        if len(last.times) > 1:
            return evidence.sentence
        (at,), where = last.times, evidence.where
        names = " and ".join(repr(c.channel) for c in found)
        if "stamp" in where:
            stamp = pd.Timestamp(str(where["stamp"])).tz_convert(str(where["zone"]))
            stamp += pd.Timedelta(at - number_of(evidence, "time"), "s")
            when = in_words(stamp)
        else:
            when = f"time {at:.5g}{unit_of(evidence)}"
        return f"{off(names, last.shift, unit_of(evidence))} from {when}."

    def refine(self, model: Model, record: Record, times: int) -> Sequence[Model]:
        """Other instants and shifts nearby, some samples away; what a rule says stays."""
        found = set_last(model, ShiftedClock, "times")
        last = found[-1]
        if len(last.times) > 1:
            return []
        step, coarse = record.sampling_time, FARTHEST[times]
        offsets = sorted({sign * k for k in coarse for sign in (-1, 0, 1)})
        moved = {
            (last.times[0] + i * step, last.shift + k * step) for i in offsets for k in range(-3, 4)
        }
        inside = [
            (time, shift)
            for time, shift in sorted(moved)
            if record.time[0] < time < record.time[-1] and shift
            if (time, shift) != (last.times[0], last.shift)
        ]
        return [changed(model, found, shift=shift, times=(time,)) for time, shift in inside]


def seasons(record: Record, zone: str, season: str) -> tuple[float, ...]:
    """Times at which a zone's summers (or winters) begin and, in turn, end.

    Over a record and a year before and after it. The first is a beginning.
    """
    assert record.start is not None
    # Clocks change at full or half hours of UTC, whenever the record starts.
    first = (record.start + pd.Timedelta(record.time[0] - 366 * DAY, "s")).tz_convert("UTC")
    halves = pd.date_range(
        first.floor("30min"), periods=48 * int(record.duration / DAY + 2 * 366), freq="30min"
    )
    saving = np.array([bool(stamp.dst()) for stamp in halves.tz_convert(zone).to_pydatetime()])
    there = saving if season == "summers" else ~saving
    changes = np.flatnonzero(np.diff(there.astype(int))) + 1
    if len(changes) and not there[changes[0]]:
        changes = changes[1:]
    seconds = np.asarray((halves - record.start).total_seconds())
    return tuple(float(seconds[k]) for k in changes)
