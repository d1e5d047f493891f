"""A clock that is wrong in part of the record: daylight saving, a changed logger, a moved file."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pandas as pd

from pyro_dynogp.data.channels import ShiftedClock
from pyro_dynogp.data.channels.clock import DAY
from pyro_dynogp.data.record import Record
from pyro_dynogp.data.signals import shifted
from pyro_dynogp.effects.base import (
    Effect,
    changed,
    driving_names,
    listed,
    number_of,
    set_last,
    unit_of,
)
from pyro_dynogp.effects.clock_shift_score import refined_shift, score_of_shifts, shifts_of
from pyro_dynogp.effects.clocks import ZONES, all_zones, clock_shares, in_zone
from pyro_dynogp.models.variants import Model, with_channel, with_channels
from pyro_dynogp.statistics.evidence import Evidence, Residuals
from pyro_dynogp.statistics.pictures import about, evidence, in_words, instant, over_time
from pyro_dynogp.statistics.prewhitening import prewhitened, spanning
from pyro_dynogp.statistics.settings import LoopSettings
from pyro_dynogp.statistics.shares_of_inputs import check_inputs
from pyro_dynogp.support.errors import invalid

# Shifts of the whole record, which are none of the clock's, together with their sums [steps].
WHOLE = (-4, -2, -1, 0, 1, 2, 4)
# Channels of the largest share that are tried.
CHANNELS = 6
# Samples by which the instant of a shifted clock is moved to refine it, first and then.
FARTHEST = ((7, 14, 21, 28, 35), (1, 2, 3))


def clock_shift(
    residuals: Residuals, settings: LoopSettings, *, zones: Sequence[str] = (), seed: int = 0
) -> Evidence:
    """An input's time stamps that are off by a constant in part of the record.

    Where they are, the output has the input's share of the mean at another time: s(t + shift) in
    place of s(t). Tried are shifts from a change at any instant to the end, and, with stamps, in
    the summers or the winters of the zones given and of the stamps' own (winters, where the model
    was fitted to a summer, whose hour it takes for right). The effect has no free size, which is
    what tells a shift from a change of gain. Inputs that are functions of the time of day or week
    are one clock, whose share is what the mean repeats.

    Args:
        residuals: of one output (n,). settings: thresholds.
        zones: IANA names of time zones whose daylight saving is tried.
        seed: of the replicates.

    Returns:
        where: channel (of several clocks the first), shift [time unit] (above zero: what the
        channel says at t + shift belongs to t, it is recorded too late), time of the (first) change
        [time unit], and rule (the zone whose daylight saving it follows) with season ("summers" or
        "winters": when the channel is off) where one fits as well as any instant.

    Raises:
        ValueError: where too few samples are measured, there is no input that acts on the
            mean, or a zone is unknown.

    Source: likelihood ratio with an unknown instant of change, as Andrews, Econometrica 61(4):821
    (1993), in the whitened residual; the null by `prewhitened`.
    """
    r = residuals
    check_inputs(r)
    names, shares = clock_shares(r, zones, CHANNELS)
    if not names:
        raise invalid("residuals", expected="an input that acts on the mean", got="none")
    rules, parts = _rules(r, zones)
    tried = shifts_of(r, shares, parts, settings)
    # A shift of the whole record is a dead time, and a wrong gain is not a matter of clocks.
    everywhere = [shifted(s, r.time, k * r.step) for s in shares.T for k in WHOLE]
    nuisance = spanning(np.column_stack([r.mean, *everywhere]))
    variants = score_of_shifts(tried)
    scan = prewhitened(r.residual, variants, nuisance, r.deviations, settings, seed=seed)
    J = tried.changes.shape[1]
    best = _preferred(scan.gains, scan.best, rules, J, settings.preference)
    place, j = divmod(best, J)
    name, shift = names[tried.channels[j]], float(tried.shifts[j])
    share = shares[:, tried.channels[j]]
    # Several inputs that are clocks are one effect; the first stands for them.
    where: dict[str, float | str] = {"channel": name[0]}
    if place < len(parts):
        at = int(np.flatnonzero(np.diff(parts[place]) != 0)[0]) + 1
        effect = tried.effect(best)
        where["season"], where["rule"] = rules[place]
        when = f"in the {where['season']} of {where['rule']}"
    else:
        first = int(tried.edges[place - len(parts)])
        at, shift, effect = refined_shift(
            r, scan.whitener, nuisance, share, first, shift, tried.edges, settings
        )
        when = f"from {instant(r, at)}"
    where |= {"shift": shift, "time": float(r.time[at]), "time_unit": r.time_unit}
    if r.stamps is not None:
        where |= {"stamp": r.stamps[at].isoformat(), "zone": str(r.stamps.tz)}
    size = float(np.std(effect))
    return evidence(
        "clock shift",
        replace(scan, best=best),
        where,
        f"{off(' and '.join(map(repr, name)), shift, f' {r.time_unit}')} {when}: "
        f"{about(r, size)} of {r.output_name!r}.",
        over_time(r, effect - effect.mean()),
        size,
    )


def _preferred(
    gains: np.ndarray,
    best: int,
    rules: Sequence[tuple[str, str]],
    count: int,
    preference: float,
) -> int:
    """The best variant, or that of a rule where it is about as good.

    A rule has no instant to choose: it wins unless another instant is better by more than a
    parameter must gain; so do summers beside winters.

    Args:
        gains: of all variants, those of rules first [nats]. best: place of the largest.
        rules: season and zone of each. count: variants of each. preference: that gain [nats].
    """
    ruled = len(rules) * count
    if not ruled or gains[:ruled].max() <= gains[best] - preference:
        return best
    # Daylight saving is an hour of summers, unless winters are that much better.
    worse = preference * np.array([season == "winters" for season, _ in rules])
    return int(np.argmax(gains[:ruled] - np.repeat(worse, count)))


def off(names: str, shift: float, unit: str) -> str:
    """By how much a clock is off, in words; the unit with a blank before it."""
    return f"The clock of {names} is {abs(shift):.4g}{unit} {'late' if shift > 0 else 'early'}"


def _rules(r: Residuals, zones: Sequence[str]) -> tuple[list[tuple[str, str]], np.ndarray]:
    """Seasons of zones whose daylight saving changes within the record, each once; their (P, n)."""
    if r.stamps is None or r.stamps.tz is None:
        return [], np.zeros((0, len(r)))
    rules: dict[bytes, tuple[tuple[str, str], np.ndarray]] = {}
    # Zones the caller names come first: of two with the same transitions that is the one meant.
    for zone in dict.fromkeys([*zones, *all_zones(r.stamps, ())]):
        local = in_zone(r.stamps, zone)
        ahead = local.tz_localize(None) - r.stamps.tz_convert("UTC").tz_localize(None)
        summer = np.asarray(ahead > ahead.min(), dtype=float)
        if 0.0 < summer.mean() < 1.0:
            for season, part in (("summers", summer), ("winters", 1.0 - summer)):
                rules.setdefault(part.tobytes(), ((season, zone), part))
    return [rule for rule, _ in rules.values()], np.array([p for _, p in rules.values()]).reshape(
        -1, len(r)
    )


class ClockShift(Effect):
    """An input whose clock is off in part of the record.

    Args:
        zones: IANA zones whose daylight saving may be what shifts it, for records with stamps.
    """

    name = "clock shift"
    family = "time"
    localised = True

    @property
    def mimicked_by_feedback(self) -> bool:
        """It is about inputs, though it is looked for in the held-out residual."""
        return True

    def __init__(self, zones: Sequence[str] = ZONES) -> None:
        self.zones = tuple(zones)

    def detect(
        self, residuals: Residuals, settings: LoopSettings, seed: int = 0
    ) -> Sequence[Evidence]:
        """One for each input."""
        zones = () if residuals.stamps is None else self.zones
        return listed(clock_shift(residuals, settings, zones=zones, seed=seed))

    def extend(self, model: Model, evidence: Evidence, record: Record) -> Sequence[Model]:
        """The input, and all inputs, read at other times from the instant on."""
        channel, shift = str(evidence.where["channel"]), number_of(evidence, "shift")
        times: tuple[float, ...] = (number_of(evidence, "time"),)
        if "rule" in evidence.where:
            times = seasons(record, str(evidence.where["rule"]), str(evidence.where["season"]))
        names = driving_names(model, model.check(record)[0])
        together = with_channels(model, (ShiftedClock(name, shift, times) for name in names))
        alone = with_channel(model, ShiftedClock(channel, shift, times))
        return [alone] if together == alone else [alone, together]

    def sentence(self, evidence: Evidence, model: Model) -> str:
        """The shift and its instant as refits have them."""
        shifted_clocks = set_last(model, ShiftedClock, "times")
        last = shifted_clocks[-1]
        if len(last.times) > 1:
            return evidence.sentence
        (at,), where = last.times, evidence.where
        names = " and ".join(repr(c.channel) for c in shifted_clocks)
        if "stamp" in where:
            stamp = pd.Timestamp(str(where["stamp"])).tz_convert(str(where["zone"]))
            stamp += pd.Timedelta(at - number_of(evidence, "time"), "s")
            when = in_words(stamp)
        else:
            when = f"time {at:.5g}{unit_of(evidence)}"
        return f"{off(names, last.shift, unit_of(evidence))} from {when}."

    def refine(self, model: Model, record: Record, times: int) -> Sequence[Model]:
        """Other instants and shifts nearby, some samples away; what a rule says stays."""
        shifted_clocks = set_last(model, ShiftedClock, "times")
        last = shifted_clocks[-1]
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
        return [
            changed(model, shifted_clocks, shift=shift, times=(time,)) for time, shift in inside
        ]


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
    inside = saving if season == "summers" else ~saving
    changes = np.flatnonzero(np.diff(inside.astype(int))) + 1
    if len(changes) and not inside[changes[0]]:
        changes = changes[1:]
    seconds = np.asarray((halves - record.start).total_seconds())
    return tuple(float(seconds[k]) for k in changes)
