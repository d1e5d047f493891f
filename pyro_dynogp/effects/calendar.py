"""Effects of the calendar: hour of day, weekday, weekend, season, in a given time zone."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import pandas as pd

from pyro_dynogp.data.channels import Calendar
from pyro_dynogp.data.channels.clock import DAY, DAYS_A_YEAR, turn_of_the_year
from pyro_dynogp.data.record import Record
from pyro_dynogp.effects.base import Effect
from pyro_dynogp.effects.clocks import ZONES, all_zones, in_zone, stamps_of
from pyro_dynogp.models.variants import Model, with_channel, without_channel
from pyro_dynogp.statistics.evidence import Curve, Evidence, Residuals
from pyro_dynogp.statistics.pictures import about, averages, evidence, residual_axis
from pyro_dynogp.statistics.prewhitening import free_columns, prewhitened, spanning
from pyro_dynogp.statistics.settings import LoopSettings
from pyro_dynogp.statistics.shares_of_inputs import input_columns
from pyro_dynogp.support.errors import invalid

WEEKDAYS = ("Mon", "Tue", "Wed", "Thu", "Fri", "Sat", "Sun")
TURN = ("20 Dec", "24 Dec", "28 Dec", "1 Jan", "5 Jan", "9 Jan", "13 Jan")
SEASONS = ("Dec-Feb", "Mar-May", "Jun-Aug", "Sep-Nov")
# Contrasts of the year; the others are of the day and the week.
YEARLY = ("season", "time of year", "turn of the year")
# Parts of the calendar under the names of the channel that stands for them.
CALENDAR_PARTS = {
    "hour of day by weekday/weekend": "hour of day by weekend",
    "season": "time of year",
}


@dataclass(frozen=True, eq=False)
class Contrast:
    """One way to read the calendar.

    Attributes:
        what, zone: its name, and where the clock hangs.
        columns: of the zone's that span it. degrees: K.
        groups: (n,) number of each sample's group, for the picture. labels: of the groups.
    """

    what: str
    zone: str
    columns: tuple[int, ...]
    degrees: int
    groups: np.ndarray
    labels: tuple[str, ...]


def calendar(
    residuals: Residuals, settings: LoopSettings, *, zones: Sequence[str] = (), seed: int = 0
) -> list[Evidence]:
    """A level that depends on the calendar, beside what the inputs explain; all samples.

    Weeks and years are long: what was fitted to is looked at, too. A fit can take part of a
    calendar up, not make one.

    Group averages are free for hour of day (24), weekday (7), weekend (2), hour by weekend (48),
    season (4); time of year is two harmonics of a year, the turn of the year seven hats four days
    apart around the first of January. One statistic for all of the day and the week and for all
    zones, and one for all of the year: what repeats every day must not hide what does once a year.

    Args:
        residuals: of one output (n,), with stamps. settings: thresholds.
        zones: IANA names of time zones whose clocks are tried beside that of the stamps.
        seed: of the replicates.

    Returns:
        One piece of evidence of the day and the week; another one of the year where the record is
        long enough. where: what ("hour of day", "weekday", "weekend", "hour of day by
        weekday/weekend"; "season", "time of year", "turn of the year"), zone (that of the stamps
        where clocks cannot be told apart).

    Raises:
        ValueError: where there are no stamps, a zone is unknown, the record is shorter than
            `days_for_hours`, or too few samples are measured.

    Source: F test of group contrasts in the whitened residual; its null by `prewhitened`.
    """
    contrasts, columns = _contrasts(residuals, zones, settings)
    of_year = [c for c in contrasts if c.what in YEARLY]
    others = [c for c in contrasts if c.what not in YEARLY]
    # One clock is enough to take the calendar's lines out of the noise's filter.
    lines = sorted({k for c in contrasts if c.zone == contrasts[0].zone for k in c.columns})
    return [
        _best_of(residuals, tried, columns, lines, settings, seed)
        for tried in (others, of_year)
        if tried
    ]


def _best_of(
    r: Residuals,
    contrasts: Sequence[Contrast],
    columns: np.ndarray,
    lines: list[int],
    settings: LoopSettings,
    seed: int,
) -> Evidence:
    """Evidence of the contrast that explains most.

    Args:
        contrasts: that are tried. columns: (n, M) of all clocks.
        lines: those that are taken out of the noise's filter.
    """
    x = r.residual
    places = [np.array(c.columns) for c in contrasts]
    scan = prewhitened(
        x,
        free_columns(columns, places, [c.degrees for c in contrasts]),
        spanning(input_columns(r)),
        r.deviations,
        settings,
        first=columns[:, lines] if len(lines) < np.isfinite(x).sum() // 5 else None,
        seed=seed,
    )
    # The record's own clock, where others tell no better.
    same = (contrasts[scan.best].what, str(stamps_of(r).tz))
    likely = [
        k for k, contrast in enumerate(contrasts)
        if (contrast.what, contrast.zone) == same
        and scan.gain - scan.gains[k] < settings.preference
    ]  # fmt: skip
    best = contrasts[likely[0] if likely else scan.best]
    curve = _averages(r, best, x, scan.fitted)
    high, low = int(np.argmax(curve.fitted)), int(np.argmin(curve.fitted))
    labels = [best.labels[int(i)] for i in curve.x]
    return evidence(
        "calendar",
        scan,
        {"what": best.what, "zone": best.zone},
        f"{r.output_name!r} depends on the {best.what} ({best.zone}) beyond what the "
        f"model explains: {about(r, scan.size)}, most at {labels[high]}, least at {labels[low]}.",
        curve,
    )


def _contrasts(
    r: Residuals, zones: Sequence[str], settings: LoopSettings
) -> tuple[list[Contrast], np.ndarray]:
    """All contrasts that what is measured repeats, each once; and the columns of all (n, M)."""
    stamps, measured = stamps_of(r), np.isfinite(r.residual)
    every, blocks, seen = list[Contrast](), list[np.ndarray](), set[tuple[str, bytes]]()
    for zone in all_zones(stamps, zones):
        local = in_zone(stamps, zone)
        days = len(np.unique(local[measured].date)) if measured.any() else 0
        contrasts, columns = _in_zone(local, zone, days, settings)
        first, kept = sum(b.shape[1] for b in blocks), list[Contrast]()
        for c in contrasts:
            # Clocks a constant number of hours apart make the same groups: the first is kept.
            key = (c.what, pd.factorize(c.groups)[0].tobytes())
            if len(np.unique(c.groups[measured])) > 1 and key not in seen:
                seen.add(key)
                kept.append(replace(c, columns=tuple(first + k for k in c.columns)))
        if kept:
            every += kept
            blocks.append(columns)
    if not every:
        least = f"at least {settings.days_for_hours} days"
        raise invalid("residuals", expected=least, got="fewer, or none that repeats")
    return every, np.concatenate(blocks, axis=1)


def _in_zone(
    local: pd.DatetimeIndex, zone: str, days: int, settings: LoopSettings
) -> tuple[list[Contrast], np.ndarray]:
    """Contrasts of one clock, and their columns (n, M): hours, hours at weekends, weekdays, ..."""
    hour, weekday = np.asarray(local.hour), np.asarray(local.day_of_week)
    weekend = (weekday >= 5).astype(int)
    hours, hours_named = np.eye(24)[hour], tuple(f"{h} h" for h in range(24))
    K = max(len(np.unique(hour)) - 1, 1)
    contrasts, blocks = list[Contrast](), list[np.ndarray]()

    def add(
        what: str,
        degrees: int,
        new: np.ndarray,
        groups: np.ndarray,
        labels: Sequence[str],
        also: Sequence[int] = (),
    ) -> None:
        first = sum(b.shape[1] for b in blocks)
        blocks.append(new)
        columns = (*also, *range(first, first + new.shape[1]))
        contrasts.append(Contrast(what, zone, columns, degrees, groups, tuple(labels)))

    if days >= settings.days_for_hours:
        add("hour of day", K, hours, hour, hours_named)
    if days >= settings.days_for_week:
        named = hours_named + tuple(f"{h} at weekends" for h in hours_named)
        cells, at_weekends = hour + 24 * weekend, hours * weekend[:, None]
        what = "hour of day by weekday/weekend"
        add(what, 2 * K + 1, at_weekends, cells, named, also=range(24))
        add("weekend", 1, weekend[:, None].astype(float), weekend, ("working days", "weekends"))
        add("weekday", 6, np.eye(7)[weekday], weekday, WEEKDAYS)
    if days >= settings.days_for_year:
        season, month = np.asarray(local.month % 12) // 3, np.asarray(local.month) - 1
        add("season", 3, np.eye(4)[season], season, SEASONS)
        angle = 2.0 * np.pi * np.asarray(local.day_of_year + local.hour / 24.0) / 365.2425
        year = np.column_stack([f(k * angle) for k in (1, 2) for f in (np.cos, np.sin)])
        months = [pd.Timestamp(2000, m, 1).strftime("%B") for m in range(1, 13)]
        add("time of year", 4, year, month, months)
        gone = (np.asarray(local.day_of_year) - 1.0 + np.asarray(local.hour) / 24.0) / DAYS_A_YEAR
        hats = turn_of_the_year(gone)
        near = np.where(hats.any(1), hats.argmax(1), len(TURN))
        add("turn of the year", len(TURN), hats, near, (*TURN, "the rest of the year"))
    return contrasts, np.concatenate(blocks, axis=1) if blocks else np.zeros((len(hour), 0))


def _averages(r: Residuals, best: Contrast, x: np.ndarray, fitted: np.ndarray) -> Curve:
    """Averages of residual and effect in each group, the residual's own average removed."""
    rows = np.isfinite(x)
    groups, at = np.unique(best.groups[rows], return_inverse=True)
    y, effect = averages(at, len(groups), x[rows] - x[rows].mean(), fitted[rows])
    label = f"{best.what}, {best.zone}"
    return Curve(groups.astype(float), y, effect, label, residual_axis(r))


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

    def detect(
        self, residuals: Residuals, settings: LoopSettings, seed: int = 0
    ) -> Sequence[Evidence]:
        """One of the day and the week, and one of the year where the record is long enough."""
        if residuals.stamps is None:
            return []
        return calendar(residuals, settings, zones=self.zones, seed=seed)

    def extend(self, model: Model, evidence: Evidence, record: Record) -> Sequence[Model]:
        """The part of the calendar as direct inputs; or all that the model has, on that clock.

        In place of the same part, if the model has it: with twice the harmonics if on that clock,
        as far as the steps of the record tell harmonics of a day apart.
        """
        what, zone = str(evidence.where["what"]), str(evidence.where["zone"])
        part = CALENDAR_PARTS.get(what, what)
        calendars = [c for c in model.channels if isinstance(c, Calendar)]
        harmonics, plain = 3 if part == "time of year" else 6, model
        for channel in calendars:
            if channel.what == part:
                plain = without_channel(plain, channel)
                harmonics = max(harmonics, channel.harmonics * (2 if channel.zone == zone else 1))
        if part != "time of year":
            harmonics = max(1, min(harmonics, int(0.5 * DAY / record.sampling_time)))
        variants = [with_channel(plain, Calendar(part, zone, harmonics))]
        if any(channel.zone != zone for channel in calendars):
            channels = tuple(
                replace(c, zone=zone) if isinstance(c, Calendar) else c for c in model.channels
            )
            variants.append(replace(model, channels=channels))
        return variants
