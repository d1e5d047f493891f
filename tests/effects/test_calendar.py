"""Hours, weekdays, seasons, on whichever clock."""

import numpy as np
import pandas as pd
import pytest

from pyro_dynogp.effects.calendar import calendar
from tests.discrepancy.made import SETTINGS
from tests.discrepancy.series import residuals
from tests.effects.scenes import MELBOURNE, stamps


class TestCalendar:
    def test_hours_of_the_zone_are_found(self):
        clock = stamps(700)
        hour = np.asarray(clock.tz_convert(MELBOURNE).hour)
        r = residuals(
            0,
            700,
            step=1.0,
            stamps=clock,
            effect=lambda *_: np.where((hour > 8) & (hour < 19), 1.5, 0.0),
        )
        (found,) = calendar(r, SETTINGS, zones=(MELBOURNE,))
        assert found.p_value < 1e-4
        assert found.where == {"what": "hour of day", "zone": MELBOURNE}
        assert found.size == pytest.approx(0.74, abs=0.2)

    def test_weekend_is_found(self):
        clock = stamps(700)
        weekend = np.asarray(clock.day_of_week >= 5)
        r = residuals(1, 700, step=1.0, stamps=clock, effect=lambda *_: 1.5 * weekend)
        (found,) = calendar(r, SETTINGS)
        assert found.p_value < 1e-3
        assert found.where == {"what": "weekend", "zone": "UTC"}

    def test_time_of_year_is_found(self):
        clock = pd.date_range("2020-01-01", periods=1100, freq="D", tz="UTC")
        angle = 2.0 * np.pi * np.arange(1100) / 365.25
        r = residuals(0, 1100, step=1.0, stamps=clock, effect=lambda *_: np.cos(angle))
        _, found = calendar(r, SETTINGS)
        assert found.p_value < 1e-3
        assert found.where["what"] in ("time of year", "season")

    def test_a_shutdown_over_the_holidays_is_found(self):
        clock = pd.date_range("2020-01-01", periods=1100, freq="D", tz="UTC")
        day = np.asarray(clock.month * 100 + clock.day)
        shut = (day >= 1222) | (day <= 110)
        r = residuals(0, 1100, step=1.0, stamps=clock, effect=lambda *_: -2.5 * shut)
        _, found = calendar(r, SETTINGS)
        assert found.p_value < 1e-3
        assert found.where["what"] == "turn of the year"
        assert "least at" in found.sentence

    def test_the_clock_of_the_stamps_is_named_where_others_tell_no_better(self):
        """Where the weekend begins says the zone, but at night nobody works."""
        clock = pd.date_range("2024-03-04", periods=1000, freq="30min", tz="Europe/Berlin")
        at_work = np.asarray((clock.hour >= 8) & (clock.hour < 18) & (clock.day_of_week < 5))
        for seed in (1, 3, 5):
            r = residuals(seed, 1000, step=1.0, stamps=clock, effect=lambda *_: 1.5 * at_work)
            (found,) = calendar(r, SETTINGS, zones=("America/Santiago", "UTC"))
            assert found.where["zone"] == "Europe/Berlin"

    def test_what_repeats_every_week_does_not_hide_the_turn_of_the_year(self):
        clock = pd.date_range("2020-01-01", periods=1100, freq="D", tz="UTC")
        day = np.asarray(clock.month * 100 + clock.day)
        shut, weekend = (day >= 1222) | (day <= 110), np.asarray(clock.day_of_week >= 5)
        r = residuals(0, 1100, step=1.0, stamps=clock, effect=lambda *_: 4.0 * weekend - 2.0 * shut)
        week, year = calendar(r, SETTINGS)
        assert week.where["what"] == "weekend"
        assert year.where["what"] == "turn of the year"
        assert max(week.p_value, year.p_value) < 1e-3
        assert week.statistic > year.statistic

    def test_stamps_and_zones_must_be_there(self):
        with pytest.raises(ValueError, match="time stamps"):
            calendar(residuals(0), SETTINGS)
        with pytest.raises(ValueError, match="zones"):
            calendar(residuals(0, step=1.0, stamps=stamps(300)), SETTINGS, zones=("Mars/Base",))
