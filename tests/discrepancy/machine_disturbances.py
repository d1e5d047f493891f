"""Effects that depend on time or on other channels; each builder draws what is random."""

from __future__ import annotations

import numpy as np

from tests.discrepancy.machine_inputs import Array, Generator, excitation
from tests.discrepancy.machine_planting import BEYOND_LAGS, PLAIN, Ground, Planting
from tests.discrepancy.machine_rigs import LEAD

# Amounts are sizes over the standard deviation of the output, where that is possible.
AMOUNTS = (0.002, 1.0)
# Between which shares of the record something begins.
BEGINNING = (0.2, 0.75)
HOLIDAYS = 0.15
LONGEST_SHIFT = 6  # hours


def undeclared_input(base: Ground, rng: Generator) -> Planting:
    """A second input of the machine that the model does not have; it is among the channels."""
    rig = base.rig
    x = excitation(rng, rig.total, rig.memory, rig.split)
    unit = base.unit_drive(x)
    if "inflow" in rig.numbers:  # an inflow is never below zero
        unit = unit + np.abs(unit).max()
    name = "undeclared input"
    return Planting(
        name, ("extra input",), PLAIN, AMOUNTS, drive=lambda amount: amount * unit,
        channel=lambda amount: amount * unit[LEAD:],
    )  # fmt: skip


def _step(base: Ground, rng: Generator) -> Array:
    """One from some instant on, (total,)."""
    first = LEAD + int(rng.uniform(*BEGINNING) * base.rig.samples)
    return (np.arange(base.rig.total) >= first).astype(float)


def offset(base: Ground, rng: Generator) -> Planting:
    """A sensor whose zero jumps, or a consumer that is new."""
    size = _step(base, rng)[LEAD:]
    size = size / size.std() * float(rng.choice([-1.0, 1.0]))
    return _added(base, "level shift", size)


def leak_or_offset(base: Ground, rng: Generator) -> Planting:
    """A leak that begins, or a sensor whose zero jumps."""
    if rng.uniform() < 0.5:
        return offset(base, rng)
    unit = base.unit_drive(-_step(base, rng))
    name = "level shift"
    return Planting(name, (name,), PLAIN, AMOUNTS, drive=lambda amount: amount * unit)


def _course(samples: int, rng: Generator) -> Array:
    """A slow change over the record: straight, levelling off, or a part of a wave."""
    t = np.linspace(0.0, 1.0, samples)
    kind = str(rng.choice(["straight", "levelling off", "wave"]))
    if kind == "straight":
        course = t
    elif kind == "levelling off":
        course = 1 - np.exp(-t / rng.uniform(0.4, 1.0))
    else:
        course = np.sin(2 * np.pi * (rng.uniform(0.4, 0.8) * t + rng.uniform()))
    course = course - course.mean()
    return np.asarray(course / course.std() * float(rng.choice([-1.0, 1.0])))


def drift(base: Ground, rng: Generator) -> Planting:
    """A sensor whose zero drifts."""
    return _added(base, "drift", _course(base.rig.samples, rng))


def fouling(base: Ground, rng: Generator) -> Planting:
    """Deposits: the level of the output changes, or the gain of the input about its average."""
    course, mean = _course(base.rig.samples, rng), base.output.mean(axis=0)
    if rng.uniform() < 0.5:
        return _added(base, "drift", course)
    return Planting(
        "drift", ("drift",), PLAIN, AMOUNTS, stage=0,
        sensor=lambda y, amount: y + amount * course[:, None] * (y - mean),
    )  # fmt: skip


def periodic_torque(base: Ground, rng: Generator) -> Planting:
    """Cogging or hum: a torque of one period, with a second harmonic in half of the cases."""
    rig = base.rig
    # Slow against the motor, so that the speed follows, and many times in the record.
    period = float(np.exp(rng.uniform(np.log(8.0), np.log(60.0))))
    angle = 2 * np.pi * (np.arange(rig.total) / period + rng.uniform())
    second = float(rng.choice([0.0, 0.4]))
    unit = base.unit_drive(np.sin(angle) + second * np.sin(2 * angle + rng.uniform(0, 2 * np.pi)))
    name = "periodic disturbance"
    return Planting(name, (name,), PLAIN, AMOUNTS, drive=lambda amount: amount * unit)


def _added(base: Ground, name: str, course: Array) -> Planting:
    """A course (n,) of standard deviation one, added behind the sensor."""
    sd = base.sd
    return Planting(
        name, (name,), PLAIN, AMOUNTS, stage=3,
        sensor=lambda y, amount: y + amount * course[:, None] * sd,
    )  # fmt: skip


def calendar(base: Ground, rng: Generator) -> Planting:
    """A level that follows the local clock: weekends, weekdays, working hours, hours of the day."""
    stamps = base.rig.stamps
    assert stamps is not None
    kind = str(rng.choice(["weekend", "weekday", "working hours", "hour of day"]))
    hour, day = np.asarray(stamps.hour), np.asarray(stamps.day_of_week)
    if kind == "weekend":
        course = (day < 5).astype(float)
    elif kind == "weekday":
        course = rng.standard_normal(7)[day]
    elif kind == "working hours":
        course = ((day < 5) & (hour >= 8) & (hour < 18)).astype(float)
    else:
        course = np.repeat(rng.standard_normal(8), 3)[hour]
    course = (course - course.mean()) / course.std()
    sd = base.sd
    # What repeats every day is a disturbance of that period as well.
    accepted = ("calendar", "periodic disturbance") if kind == "hour of day" else ("calendar",)
    return Planting(
        "calendar", accepted, BEYOND_LAGS, (0.002, 2.0), stage=3,
        sensor=lambda y, amount: y + amount * course[:, None] * sd,
    )  # fmt: skip


def holidays(base: Ground, rng: Generator) -> Planting:
    """Days on which the load is lower, which a channel flags; they come in both halves."""
    stamps = base.rig.stamps
    assert stamps is not None
    codes = np.unique(np.asarray(stamps.date), return_inverse=True)[1]
    days = int(codes.max()) + 1
    half = days // 2
    count = max(round(HOLIDAYS * half), 2)
    chosen = np.concatenate(
        [rng.permutation(half)[:count], half + rng.permutation(days - half)[:count]]
    )
    flag = np.isin(codes, chosen).astype(float)
    unit, sd = flag / flag.std(), base.sd
    return Planting(
        "undeclared input", ("extra input",), PLAIN, AMOUNTS, stage=3,
        sensor=lambda y, amount: y - amount * unit[:, None] * sd, channel=lambda _: flag,
    )  # fmt: skip


def clock_shift(base: Ground, rng: Generator) -> Planting:
    """From some instant on the stamps of the temperature are wrong; amount: by how many hours."""
    late = _step(base, rng) > 0
    sign = int(rng.choice([-1, 1]))

    def recorded(u: Array, amount: float) -> Array:
        rows = np.arange(len(u))
        rows[late] = np.minimum(rows[late] - sign * int(amount), len(u) - 1)
        return np.asarray(u[rows])

    hours = tuple(float(h) for h in range(1, LONGEST_SHIFT + 1))
    name = "clock shift"
    return Planting(name, (name,), BEYOND_LAGS, hours, discrete=True, recorded=recorded)
