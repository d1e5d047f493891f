"""Effects that a model may lack: how each is found, and which blocks add it to the model.

An effect is a class with a name, a test and a way to extend a model. To add one of your own, write
such a class and give it to `close_loop` among `effects`:

    class Ageing(Effect):
        name = "ageing"

        def detect(self, residuals, seed=0):
            found = lasting(residuals, [with_past(my_column(residuals))], None, seed)
            return [evidence(self.name, found, {}, "The gain falls with age.", None)]

        def extend(self, model, evidence, record):
            return [with_channel(model, MyChannel(...))]
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import ClassVar

import numpy as np
import pandas as pd

from pyro_dynogp.channels import (
    Calendar,
    Channel,
    DeadZone,
    Delayed,
    Play,
    Product,
    Recorded,
    ShiftedClock,
    Sinusoid,
    Step,
    Transformed,
    Trend,
    TrendOfGain,
)
from pyro_dynogp.channels.base import signal_of
from pyro_dynogp.channels.clock import DAY
from pyro_dynogp.discrepancy.calendar_effects import calendar
from pyro_dynogp.discrepancy.clock_effects import clock_shift
from pyro_dynogp.discrepancy.delays import likely_delays
from pyro_dynogp.discrepancy.evidence import Curve, Evidence, Residuals
from pyro_dynogp.discrepancy.extend import (
    Model,
    has_process_noise,
    with_channel,
    with_input_function,
    with_likelihood,
    with_output_function,
    with_pairs,
    with_process_noise,
    without_channel,
)
from pyro_dynogp.discrepancy.noise_effects import (
    feedback,
    heavy_tails,
    heteroscedastic_noise,
    process_noise,
)
from pyro_dynogp.discrepancy.path_effects import dead_time, extra_input, unmodelled_dynamics
from pyro_dynogp.discrepancy.periodic import periodic_disturbance
from pyro_dynogp.discrepancy.shape_effects import (
    dead_zone,
    hysteresis,
    input_nonlinearity,
    output_nonlinearity,
    saturation,
)
from pyro_dynogp.discrepancy.time_effects import drift, level_shift
from pyro_dynogp.discrepancy.trials import Score
from pyro_dynogp.layers.noise import Heteroscedastic, StudentT
from pyro_dynogp.record import Record

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
# Delays that are tried whatever the data say.
COARSE = 5
# Share of a drift's variance from which it counts as a straight line.
STRAIGHT = 0.95
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
        once: whether it is not looked for again in a model that has it.
        added: whether a block mends it; False for what is only reported.
        test: finds evidence in residuals; a class whose test needs more overrides `detect`.
    """

    name: ClassVar[str] = ""
    family: ClassVar[str] = ""
    freedom: ClassVar[int] = 1
    localised: ClassVar[bool] = False
    score: ClassVar[Score] = "forecast"
    once: ClassVar[bool] = False
    added: ClassVar[bool] = True
    test: ClassVar[Callable[..., Evidence | Sequence[Evidence]]]

    def detect(self, residuals: Residuals, seed: int = 0) -> Sequence[Evidence]:
        """Evidence for the effect, one for each channel it may come from; may be empty."""
        return _listed(self.test(residuals, seed=seed))

    def extend(self, model: Model, evidence: Evidence, record: Record) -> Sequence[Model]:
        """Variants of the model with the effect as a block; empty where it is only reported."""
        raise NotImplementedError

    def refine(self, model: Model, times: int) -> Sequence[Model]:
        """Variants close to the best one so far, closer each time; none by default."""
        return []

    def sentence(self, evidence: Evidence, model: Model) -> str:
        """What it is, once the model has it; what the test said by default."""
        return evidence.sentence


def _listed(found: Evidence | Sequence[Evidence]) -> Sequence[Evidence]:
    return [found] if isinstance(found, Evidence) else found


def _number(evidence: Evidence, key: str) -> float:
    return float(evidence.where[key])


def _unit(evidence: Evidence) -> str:
    """Time unit of the record, after a number."""
    unit = str(evidence.where.get("time_unit", ""))
    return f" {unit}" if unit else ""


def _centre(record: Record, name: str) -> float:
    return float(np.mean(signal_of(record, name)))


def _finer(model: Model, number: str, times: int) -> list[Model]:
    """The model with a number of its last channel a little smaller and larger."""
    *rest, last = model.channels
    values = [share * getattr(last, number) for share in FINER[times]]
    return [replace(model, channels=(*rest, replace(last, **{number: v}))) for v in values]


class ExtraInput(Effect):
    """A recorded channel that acts: through dynamics, alone, squared, or times an input."""

    name = "extra input"
    family = "paths"
    freedom = 2
    test = staticmethod(extra_input)

    def extend(self, model: Model, evidence: Evidence, record: Record) -> Sequence[Model]:
        """The channel, or what is made from it, as an input; with its delay where there is one."""
        channel, form = str(evidence.where["channel"]), str(evidence.where["form"])
        delay = _number(evidence, "delay")
        if form == "linear":
            plain = with_channel(model, Recorded(channel))
            if delay < 2.0 * record.sampling_time:
                return [plain]
            return [plain, with_channel(plain, Delayed(channel, delay))]
        made: Channel
        if form in ("square", "absolute"):
            made = Transformed(channel, form, _centre(record, channel))
        else:
            other = form.removeprefix("product with ")
            made = Product(channel, other, _centre(record, channel), _centre(record, other))
        alone = with_channel(model, made)
        return [alone, with_channel(alone, Recorded(channel))]


class DeadTime(Effect):
    """An input that arrives later than the model has it."""

    name = "dead time"
    family = "paths"

    def detect(self, residuals: Residuals, seed: int = 0) -> Sequence[Evidence]:
        """One for each input."""
        found = _listed(dead_time(residuals, seed=seed))
        return [replace(e, where={**e.where, "time_unit": residuals.time_unit}) for e in found]

    def extend(self, model: Model, evidence: Evidence, record: Record) -> Sequence[Model]:
        """Each input, and all of them, delayed: by what regressions and the evidence say, and more.

        Poles make up for much of a delay, so that estimates of it are rough.
        """
        channel, more = str(evidence.where["channel"]), _number(evidence, "delay")
        step, longest = record.sampling_time, len(record) // 10
        grid = {float(d) for d in step * np.geomspace(1.0, longest, COARSE)}
        around = {share * more for share in AROUND}
        prepared = model.check(record)[0]
        names = prepared.input_names[: prepared.n_inputs - model.direct]
        places: list[tuple[int, ...]] = [(k,) for k in range(len(names))]
        if len(names) > 1:
            places.append(tuple(range(len(names))))
        variants = []
        for place in places:
            chosen = tuple(names[k] for k in place)
            u, y = prepared.inputs[:, : len(names)], prepared.outputs[:, 0]
            found = {step * d for d in likely_delays(y, u, place, longest)}
            delays = grid | found | (around if channel in chosen else set())
            tried = (_later(model, chosen, delay, 0.2 * step) for delay in sorted(delays))
            variants += [one for one in tried if one is not None]
        return variants

    def sentence(self, evidence: Evidence, model: Model) -> str:
        """The channels and their delay as refits have them."""
        found = self._found(model)
        names = " and ".join(repr(one.channel) for one in found)
        start = f"Channel {names} acts" if len(found) == 1 else f"Channels {names} act"
        return f"{start} with a dead time of {found[0].delay:.3g}{_unit(evidence)}."

    def refine(self, model: Model, times: int) -> Sequence[Model]:
        """The delay a little shorter and longer."""
        found = self._found(model)
        return [
            replace(
                model,
                channels=tuple(
                    replace(one, delay=share * one.delay) if one in found else one
                    for one in model.channels
                ),
            )
            for share in FINER[times]
        ]

    def _found(self, model: Model) -> list[Delayed]:
        """Delays that were set last, together."""
        last = model.channels[-1]
        assert isinstance(last, Delayed)
        return [c for c in model.channels if isinstance(c, Delayed) and c.delay == last.delay]


def _later(model: Model, names: Sequence[str], more: float, least: float) -> Model | None:
    """The model with inputs delayed by more than they are; None for less than the least delay."""
    for name in names:
        source, known = name, 0.0
        for one in model.channels:
            if isinstance(one, Delayed) and name in one.names:  # correct the delay it has
                source, known = one.channel, one.delay
                model = without_channel(model, one)
        if known + more < least:
            return None
        model = with_channel(model, Delayed(source, known + more))
    return model


class UnmodelledDynamics(Effect):
    """More poles than the model has."""

    name = "unmodelled dynamics"
    family = "paths"
    freedom = 5
    test = staticmethod(unmodelled_dynamics)

    def extend(self, model: Model, evidence: Evidence, record: Record) -> Sequence[Model]:
        """One pair of poles more, or two."""
        return [with_pairs(model, 1), with_pairs(model, 2)]


class OutputNonlinearity(Effect):
    """A function of the model's output: a sensor that is not linear."""

    name = "output nonlinearity"
    family = "shapes"
    freedom = 4
    test = staticmethod(output_nonlinearity)

    def extend(self, model: Model, evidence: Evidence, record: Record) -> Sequence[Model]:
        """A static layer after the last dynamic one."""
        extended = with_output_function(model)
        return [] if extended is None else [extended]


class Saturation(OutputNonlinearity):
    """A sensor that clips."""

    name = "saturation"
    family = "shapes"
    freedom = 1
    test = staticmethod(saturation)


class InputNonlinearity(Effect):
    """A function of an input: an actuator that is not linear."""

    name = "input nonlinearity"
    family = "shapes"
    freedom = 4
    test = staticmethod(input_nonlinearity)

    def extend(self, model: Model, evidence: Evidence, record: Record) -> Sequence[Model]:
        """A static layer before the first dynamic one."""
        extended = with_input_function(model)
        return [] if extended is None else [extended]


class DeadZoneOfInput(Effect):
    """An actuator that does nothing around the middle."""

    name = "dead zone"
    family = "shapes"
    freedom = 2
    test = staticmethod(dead_zone)

    def extend(self, model: Model, evidence: Evidence, record: Record) -> Sequence[Model]:
        """The input beyond limits around the estimate."""
        channel = str(evidence.where["channel"])
        low, high = _number(evidence, "low"), _number(evidence, "high")
        middle, half = 0.5 * (low + high), 0.5 * (high - low)
        return [
            with_channel(model, DeadZone(channel, middle - share * half, middle + share * half))
            for share in AROUND
        ]

    def refine(self, model: Model, times: int) -> Sequence[Model]:
        """Each limit a little lower and higher."""
        last = model.channels[-1]
        assert isinstance(last, DeadZone)
        width = last.high - last.low
        finer = [
            replace(last, **{limit: getattr(last, limit) + (share - 1.0) * width})
            for share in FINER[times]
            for limit in ("low", "high")
        ]
        return [replace(model, channels=(*model.channels[:-1], one)) for one in finer]


class Hysteresis(Effect):
    """Mechanical play of an actuator."""

    name = "hysteresis"
    family = "shapes"
    freedom = 2
    test = staticmethod(hysteresis)

    def extend(self, model: Model, evidence: Evidence, record: Record) -> Sequence[Model]:
        """The input behind play of widths around the estimate; play of a sensor is reported."""
        channel, width = str(evidence.where["channel"]), _number(evidence, "width")
        if channel in record.output_names:
            return []
        return [with_channel(model, Play(channel, share * width)) for share in AROUND]

    def refine(self, model: Model, times: int) -> Sequence[Model]:
        """The play a little narrower and wider."""
        return _finer(model, "width", times)


class Drift(Effect):
    """A level, or a gain, that changes slowly."""

    name = "drift"
    family = "time"
    test = staticmethod(drift)

    def extend(self, model: Model, evidence: Evidence, record: Record) -> Sequence[Model]:
        """A straight line in time or, where it bends, a random path; or each input times a line.

        The random path is a pair of poles, as slow as suits it, that process noise drives: a line
        through a bend would go on to where nothing is.
        """
        begin, end = float(record.time[0]), float(record.time[-1])
        if evidence.where["form"] == "additive":
            if evidence.curve is not None and _straightness(evidence.curve) < STRAIGHT:
                return [with_process_noise(with_pairs(model, 1))]
            return [with_channel(model, Trend(begin, end))]
        extended = model
        prepared = model.check(record)[0]
        driving = prepared.n_inputs - model.direct
        for name in prepared.input_names[:driving]:
            extended = with_channel(
                extended, TrendOfGain(name, _centre(prepared, name), begin, end)
            )
        return [extended]


def _straightness(curve: Curve) -> float:
    """Share of a curve's variance that a straight line has."""
    there = np.isfinite(curve.x) & np.isfinite(curve.fitted)
    x, y = curve.x[there], curve.fitted[there]
    if len(x) < 3 or not np.std(y) or not np.std(x):
        return 1.0
    return float(np.corrcoef(x, y)[0, 1] ** 2)


class LevelShift(Effect):
    """A level that jumps at one instant."""

    name = "level shift"
    family = "time"
    localised = True
    test = staticmethod(level_shift)

    def extend(self, model: Model, evidence: Evidence, record: Record) -> Sequence[Model]:
        """A step at the instant."""
        return [with_channel(model, Step(_number(evidence, "time")))]


class PeriodicDisturbance(Effect):
    """A line that no input explains."""

    name = "periodic disturbance"
    family = "time"
    test = staticmethod(periodic_disturbance)

    def extend(self, model: Model, evidence: Evidence, record: Record) -> Sequence[Model]:
        """A sinusoid of the period, and of periods within its resolution."""
        period = _number(evidence, "period")
        width = period**2 / record.duration
        return [
            with_channel(model, Sinusoid(period + share * width, 1))
            for share in (-0.2, -0.1, 0.0, 0.1, 0.2)
        ] + [with_channel(model, Sinusoid(period, 3))]


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
        """One for each part of the calendar."""
        if residuals.stamps is None:
            return []
        return _listed(calendar(residuals, zones=self.zones, seed=seed))

    def extend(self, model: Model, evidence: Evidence, record: Record) -> Sequence[Model]:
        """The part of the calendar as direct inputs; or all that the model has, on that clock.

        In place of the same part, if the model has it: with twice the harmonics if on that clock.
        """
        what, zone = str(evidence.where["what"]), str(evidence.where["zone"])
        part = CALENDAR_PARTS.get(what, what)
        there = [one for one in model.channels if isinstance(one, Calendar)]
        harmonics, plain = 3 if part == "time of year" else 6, model
        for one in there:
            if one.what == part:
                plain = without_channel(plain, one)
                harmonics = max(harmonics, one.harmonics * (2 if one.zone == zone else 1))
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
        return _listed(clock_shift(residuals, zones=zones, seed=seed))

    def extend(self, model: Model, evidence: Evidence, record: Record) -> Sequence[Model]:
        """The input, and all inputs, read at other times from the instant on."""
        channel, shift = str(evidence.where["channel"]), _number(evidence, "shift")
        times: tuple[float, ...] = (_number(evidence, "time"),)
        if "rule" in evidence.where:
            times = summers(record, str(evidence.where["rule"]))
        together = model
        prepared = model.check(record)[0]
        for name in prepared.input_names[: prepared.n_inputs - model.direct]:
            together = with_channel(together, ShiftedClock(name, shift, times))
        alone = with_channel(model, ShiftedClock(channel, shift, times))
        return [alone] if together == alone else [alone, together]


def summers(record: Record, zone: str) -> tuple[float, ...]:
    """Times at which a zone's daylight saving begins and, in turn, ends, over a record and a year.

    Begins with the beginning of a summer, which may lie before the record.
    """
    assert record.start is not None
    first = record.start + pd.Timedelta(record.time[0] - 366 * DAY, "s")
    hours = pd.date_range(first, periods=24 * int(record.duration / DAY + 2 * 366), freq="h")
    saving = np.array([bool(stamp.dst()) for stamp in hours.tz_convert(zone).to_pydatetime()])
    changes = np.flatnonzero(np.diff(saving.astype(int))) + 1
    if len(changes) and not saving[changes[0]]:
        changes = changes[1:]
    seconds = np.asarray((hours - record.start).total_seconds())
    return tuple(float(seconds[k]) for k in changes)


class HeavyTails(Effect):
    """Measurement noise with outliers."""

    name = "heavy tails"
    once = True
    score = "one step"
    family = "noise"
    test = staticmethod(heavy_tails)

    def extend(self, model: Model, evidence: Evidence, record: Record) -> Sequence[Model]:
        """Student-t measurement noise."""
        nu = min(max(_number(evidence, "degrees_of_freedom"), 2.2), 30.0)
        return [with_likelihood(model, StudentT(nu))]


class HeteroscedasticNoise(Effect):
    """Noise whose size depends on an input."""

    name = "heteroscedastic noise"
    once = True
    score = "one step"
    family = "noise"
    freedom = 3
    test = staticmethod(heteroscedastic_noise)

    def extend(self, model: Model, evidence: Evidence, record: Record) -> Sequence[Model]:
        """Log standard deviation of the noise as a Gaussian process of the inputs."""
        if model.inputs == model.direct:
            return []
        return [with_likelihood(model, Heteroscedastic())]


class ProcessNoise(Effect):
    """Disturbances that pass through dynamics."""

    name = "process noise"
    score = "one step"
    family = "paths"
    freedom = 6
    test = staticmethod(process_noise)

    def extend(self, model: Model, evidence: Evidence, record: Record) -> Sequence[Model]:
        """Process noise in every dynamic layer; where it is there, more poles are for dynamics."""
        if has_process_noise(model):
            return []
        noisy = with_process_noise(model)
        return [noisy, with_pairs(noisy, 1)]


class Feedback(Effect):
    """Inputs that follow the output: the record comes from a closed loop."""

    name = "feedback"
    family = "feedback"
    added = False
    test = staticmethod(feedback)

    def extend(self, model: Model, evidence: Evidence, record: Record) -> Sequence[Model]:
        """Nothing: it is reported."""
        return []


CATALOGUE: tuple[Effect, ...] = (
    ExtraInput(), DeadTime(), UnmodelledDynamics(), OutputNonlinearity(), InputNonlinearity(),
    Saturation(), DeadZoneOfInput(), Hysteresis(), Drift(), LevelShift(), PeriodicDisturbance(),
    CalendarEffect(), ClockShift(), HeavyTails(), HeteroscedasticNoise(), ProcessNoise(),
    Feedback(),
)  # fmt: skip
