"""Clocks of zones, inputs that are clocks, and what each channel contributes to the mean."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pandas as pd

from pyro_dynogp.statistics.evidence import Residuals
from pyro_dynogp.statistics.responses import responses
from pyro_dynogp.statistics.shares_of_inputs import paths
from pyro_dynogp.support.errors import invalid

# One zone for each common rule of daylight saving: clocks tell zones apart by their transitions.
ZONES = (
    "UTC", "Europe/Berlin", "America/New_York", "America/Santiago", "Australia/Melbourne",
    "Pacific/Auckland",
)  # fmt: skip
# A channel is a clock where what is left of it within equal times of day is less than this share.
EXACT = 1e-9
# A share below this part of the largest one is none.
LEAST = 1e-3


def stamps_of(residuals: Residuals) -> pd.DatetimeIndex:
    """The stamps, which must have a zone.

    Raises:
        ValueError: where there are none, or without a zone.
    """
    stamps = residuals.stamps
    if stamps is None or stamps.tz is None:
        got = "none" if stamps is None else "stamps without one"
        raise invalid("residuals", expected="time stamps with a time zone", got=got)
    return stamps


def in_zone(stamps: pd.DatetimeIndex, zone: str) -> pd.DatetimeIndex:
    """Stamps on the clock of a zone.

    Raises:
        ValueError: where the zone is unknown.
    """
    try:
        return stamps.tz_convert(zone)
    except (KeyError, ValueError, OSError) as error:
        raise invalid("zones", expected="IANA names of time zones", got=repr(zone)) from error


def all_zones(stamps: pd.DatetimeIndex, zones: Sequence[str]) -> list[str]:
    """That of the stamps, then the others, each once."""
    return list(dict.fromkeys([str(stamps.tz), *zones]))


def clock_shares(
    residuals: Residuals, zones: Sequence[str], most: int
) -> tuple[list[tuple[str, ...]], np.ndarray]:
    """Names and shares (n, c) [output] of the channels that act on the mean, the largest first.

    All clocks together are one channel of several names.

    Args:
        residuals: of one output (n,). zones: clocks that inputs may follow. most: c at most.
    """
    r = residuals
    clocks, phase = clock_inputs(r, zones)
    others = [j for j in range(len(r.input_names)) if j not in clocks]
    names, shares = list[tuple[str, ...]](), list[np.ndarray]()
    if clocks:
        names.append(tuple(r.input_names[j] for j in clocks))
        shares.append(_repeated(r, phase, others))
    if others:
        linear = paths(r).shares
        for j in others:
            names.append((r.input_names[j],))
            shares.append(linear[:, j])
    size = np.array([s.std() for s in shares])
    order = [int(k) for k in np.argsort(-size, kind="stable")[:most]]
    order = [k for k in order if size[k] > LEAST * size.max()]
    if not order:
        return [], np.zeros((len(r), 0))
    return [names[k] for k in order], np.column_stack([shares[k] - shares[k].mean() for k in order])


def clock_inputs(residuals: Residuals, zones: Sequence[str]) -> tuple[list[int], np.ndarray]:
    """Inputs that are functions of the time of day or week, and the phase (n,) they are of.

    Without stamps a clock is what repeats exactly.
    """
    r = residuals
    phases = list[np.ndarray]()
    if r.stamps is not None and r.stamps.tz is not None:
        for zone in dict.fromkeys([*all_zones(r.stamps, zones), "UTC"]):
            local = in_zone(r.stamps, zone)
            second = np.asarray(local.hour * 3600 + local.minute * 60 + local.second)
            phases += [second, second + 86400 * np.asarray(local.day_of_week)]
    else:
        period = _exact_period(r)
        phases += [np.arange(len(r)) % period] if period else []
    best, phase = list[int](), np.zeros(len(r), dtype=int)
    for candidate in phases:
        groups, at, count = np.unique(candidate, return_inverse=True, return_counts=True)
        if len(groups) < 3 or len(groups) > len(r) // 3:
            continue
        average = np.stack([np.bincount(at, u) / count for u in r.inputs.T], axis=1)
        left = np.square(r.inputs - average[at]).sum(0)
        total = np.square(r.inputs - r.inputs.mean(0)).sum(0)
        clocks = [j for j in range(len(left)) if left[j] < EXACT * total[j]]
        if len(clocks) > len(best):
            best, phase = clocks, at
    return best, phase


def _exact_period(r: Residuals) -> int:
    """Number of samples after which most inputs that repeat at all do so; 0: none does."""
    n = len(r)
    periods = list[int]()
    for u in r.inputs.T:
        scale = float(np.ptp(u))
        # What repeats after P samples has the same first values there.
        starts = np.flatnonzero(np.abs(u[3 : n // 3 + 1] - u[0]) < 1e-9 * scale) + 3
        for P in starts:
            if np.abs(u[P:] - u[:-P]).max() < 1e-9 * scale:
                periods.append(int(P))
                break
    return max(periods, default=0)


def _repeated(r: Residuals, phase: np.ndarray, others: list[int]) -> np.ndarray:
    """Part of the mean that is a function of the phase, beside what the other inputs do (n,)."""
    groups = int(phase.max()) + 1
    left = r.mean - r.mean.mean()
    if others:
        bank = responses(r.inputs[:, others], r.step, r.time)

        def within(values: np.ndarray) -> np.ndarray:
            count = np.bincount(phase, minlength=groups)
            average = np.stack([np.bincount(phase, v, groups) / count for v in values.T], axis=1)
            return values - average[phase]

        inner = within(np.column_stack([left, bank]))
        left = left - bank @ np.linalg.lstsq(inner[:, 1:], inner[:, 0], rcond=1e-7)[0]
    average = np.bincount(phase, left, groups) / np.bincount(phase, minlength=groups)
    return average[phase]
