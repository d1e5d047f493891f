"""Effects that go with time: drift, shifts of level and gain, periods, calendar, clock shift."""

from __future__ import annotations

from typing import Any

import numpy as np
import pandas as pd

from tests.discrepancy.plant_dynamics import Array, response
from tests.discrepancy.plant_setting import LEAD, ZONE, Generator, Setting, standard
from tests.discrepancy.planting import Planting, inside, outside

HOUR = 3600.0


def drift(s: Setting, rng: Generator) -> Planting:
    """Of the level, in one of three shapes, or (every third) of the gain, along a ramp."""
    shape = str(rng.choice(["ramp", "ageing", "slow wave"]))
    t, sign = np.linspace(0.0, 1.0, s.samples), float(rng.choice([-1.0, 1.0]))
    if shape == "ramp":
        added = t
    elif shape == "ageing":
        added = 1 - np.exp(-t / rng.uniform(0.3, 1.0))
    else:
        added = np.sin(2 * np.pi * (rng.uniform(0.4, 0.9) * t + rng.uniform()))
    if rng.uniform() < 1 / 3:
        ramp = (np.arange(len(s.u)) - LEAD) / s.samples - 0.5
        return inside(s, sign * ramp * s.linear, of="gain", shape="ramp")
    return outside(s, sign * standard(added, slice(None)), of="level", shape=shape)


def level_shift(s: Setting, rng: Generator) -> Planting:
    first, sign = int(rng.uniform(0.2, 0.7) * s.samples), float(rng.choice([-1.0, 1.0]))
    return outside(s, sign * (np.arange(s.samples) >= first).astype(float), first=first)


def gain_shift(s: Setting, rng: Generator) -> Planting:
    """All inputs act with another gain from an instant on."""
    first, sign = int(rng.uniform(0.2, 0.7) * s.samples), float(rng.choice([-1.0, 1.0]))
    later = np.arange(len(s.u)) - LEAD >= first
    return inside(s, sign * response(s.system, s.u * later[:, None]), first=first)


def periodic_disturbance(s: Setting, rng: Generator) -> Planting:
    period = float(np.exp(rng.uniform(np.log(8.0), np.log(100.0))))
    while s.start is not None and _near_calendar(period * s.step):
        period = float(np.exp(rng.uniform(np.log(8.0), np.log(100.0))))
    second = float(rng.choice([0.0, 0.4]))
    angle = 2 * np.pi * (np.arange(s.samples) / period + rng.uniform())
    added = np.sin(angle) + second * np.sin(2 * angle + rng.uniform(0, 2 * np.pi))
    return outside(s, added, period=period, second_harmonic=second)


def _near_calendar(period: float) -> bool:
    """Whether a period [s] is within 15 % of a day, a week, or one of their first harmonics."""
    days = np.array([7.0, 3.5, 7 / 3, 1.0, 1 / 2, 1 / 3, 1 / 4])
    return bool(np.abs(np.log(period / (24 * HOUR) / days)).min() < np.log(1.15))


def calendar(s: Setting, rng: Generator) -> Planting:
    """Something that follows the local clock: weekends, working hours, or the hour of the day."""
    kind = str(rng.choice(["weekend", "working hours", "hour of day"]))
    local = s.stamps(s.step)
    if kind == "hour of day":
        k, phases = np.arange(1, 5), rng.uniform(0, 2 * np.pi, 4)
        angle = 2 * np.pi * np.outer(np.arange(24) / 24, k) + phases
        added = (rng.uniform(0.5, 1.0, 4) * np.cos(angle)).sum(axis=1)[local.hour]
    else:
        weekday = np.asarray(local.day_of_week < 5)
        at_work = np.asarray((local.hour >= 8) & (local.hour < 17))
        added = (~weekday if kind == "weekend" else weekday & at_work).astype(float)
    return outside(s, float(rng.choice([-1.0, 1.0])) * added, kind=kind)


def clock_shift(s: Setting, rng: Generator) -> Planting:
    """From some instant on the clock of the inputs is an hour off; the amount is an hour's samples.

    What the record has at t then acted at t + shift; the output keeps the right time. Two thirds
    of the changes are those of daylight saving.
    """
    first, sign = int(rng.uniform(0.25, 0.65) * s.samples), int(rng.choice([-1, 1]))
    known = str(rng.choice(["2023-03-26 01:00", "2023-10-29 01:00", ""]))

    def recorded(amount: float) -> Array:
        shifted = np.roll(s.u, -sign * int(amount), axis=0)
        late = np.arange(len(s.u)) >= LEAD + first
        return np.where(late[:, None], shifted, s.u)

    def truth(amount: float) -> dict[str, Any]:
        step, start = HOUR / amount, s.start
        if known:
            start = pd.Timestamp(known, tz="UTC") - pd.Timedelta(seconds=first * step)
            start = start.tz_convert(ZONE)
        clock = {"start": start, "step": step}
        return {"first": first, "shift": sign * amount, "clock": clock}

    return Planting(
        lambda amount, w: s.observe(s.linear + w),
        (1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 10.0, 12.0),
        truth,
        linear=False,
        discrete=True,
        recorded=recorded,
    )
