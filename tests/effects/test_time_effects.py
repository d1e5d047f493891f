import dataclasses

import numpy as np
import pandas as pd
import pytest

from pyro_dynogp.effects.calendar import calendar, clock_shift
from pyro_dynogp.effects.time_effects import drift, level_shift, periodic_disturbance
from pyro_dynogp.statistics import bootstrap as sieve

from .series import check_rate, in_other_units, residuals, share

MELBOURNE = "Australia/Melbourne"


def stamps(n, freq="h"):
    return pd.date_range("2023-03-18", periods=n, freq=freq, tz="UTC")


@pytest.fixture
def few(monkeypatch):
    """Fewer replicates, for many series."""
    monkeypatch.setattr(sieve, "REPLICATES", 19)
    monkeypatch.setattr(sieve, "FEWEST", 19)


def of_the_week(residuals, **options):
    """The calendar's first piece of evidence, in place of a detector of one."""
    return calendar(residuals, **options)[0]


def trend(t, mean, u):
    return 1.5 * (2.0 * t / t[-1] - 1.0)


def step_at_150(t, mean, u):
    return 2.0 * (t >= 150.0)


def sine(t, mean, u):
    return 0.9 * np.sin(2.0 * np.pi * t / 13.3 + 1.0)


def gain_drift(t, mean, u):
    return 0.5 * np.cos(np.pi * t / t[-1]) * mean


@pytest.mark.usefixtures("few")
class TestWithoutEffect:
    @pytest.mark.parametrize("detector", [drift, level_shift, periodic_disturbance, clock_shift])
    def test_level_is_kept(self, detector):
        check_rate(
            [detector(residuals(s, 150, deviation=0.02), seed=s).p_value for s in range(100)]
        )

    def test_level_is_kept_for_the_calendar(self):
        clock = stamps(160, "3h")
        series = (residuals(s, 160, step=1.0, stamps=clock) for s in range(100))
        check_rate([of_the_week(r, seed=s).p_value for s, r in enumerate(series)])

    def test_level_is_kept_for_the_year(self):
        clock = pd.date_range("2020-01-01", periods=600, freq="D", tz="UTC")
        series = (residuals(s, 600, step=1.0, stamps=clock) for s in range(60))
        check_rate([calendar(r, seed=s)[1].p_value for s, r in enumerate(series)])


class TestDrift:
    def test_trend_is_found(self):
        found = [drift(residuals(s, 500, effect=trend), seed=s) for s in range(4)]
        assert np.median([e.p_value for e in found]) < 1e-4
        assert all(e.where["form"] == "additive" for e in found)
        assert 150.0 <= np.median([e.where["time_scale"] for e in found]) <= 250.0
        assert 0.6 < np.median([e.size for e in found]) < 1.2  # 0.87

    def test_drift_of_gain_is_found(self):
        found = [drift(residuals(s, 500, pole=0.5, effect=gain_drift)) for s in range(4)]
        assert np.median([e.p_value for e in found]) < 1e-4
        assert all(e.where["form"] == "gain" for e in found)

    def test_input_whose_gain_drifts_is_named(self):
        def effect(t, mean, u):
            return 0.5 * np.cos(np.pi * t / t[-1]) * share(u[:, 1], 2.0)

        found = drift(residuals(0, 500, pole=0.5, inputs=2, effect=effect))
        assert found.p_value < 1e-4
        assert found.where["channel"] == "u2"

    def test_step_is_rather_a_level_shift(self):
        for s in range(3):
            r = residuals(s, 500, pole=0.5, effect=step_at_150)
            assert level_shift(r, seed=s).gain > drift(r, seed=s).gain + 1.0


class TestLevelShift:
    def test_step_is_found(self):
        found = [level_shift(residuals(s, 500, effect=step_at_150), seed=s) for s in range(5)]
        assert max(e.p_value for e in found) < 1e-3
        assert np.median([abs(e.where["time"] - 150.0) for e in found]) <= 1.0
        assert np.median([e.where["size"] for e in found]) == pytest.approx(2.0, abs=0.4)

    def test_trend_is_rather_a_drift(self):
        gains = [
            drift(r, seed=s).gain - level_shift(r, seed=s).gain
            for s in range(3)
            for r in [residuals(s, 500, pole=0.5, effect=trend)]
        ]
        assert min(gains) > 3.0

    def test_missing_samples(self):
        r = residuals(1, 500, effect=step_at_150)
        output = r.output.copy()
        output[100:180] = np.nan
        output[::17] = np.nan
        found = level_shift(dataclasses.replace(r, output=output))
        assert found.p_value < 0.01
        assert found.where["time"] == pytest.approx(150.0, abs=5.0)
        assert np.isfinite(found.curve.y).all()


class TestPeriodicDisturbance:
    @pytest.mark.parametrize("size", [0.5, 2.0, 8.0])
    def test_strong_lines_are_found_as_well_as_weak_ones(self, size):
        """A filter of high order makes white what is left of a line between two frequencies."""

        def line(t, mean, u):
            angle = 2.0 * np.pi * t / 11.83
            return size * (np.sin(angle) + 0.4 * np.sin(2.0 * angle + 1.0))

        found = periodic_disturbance(residuals(7, 750, pole=0.0, effect=line))
        assert found.p_value < 1e-9
        assert found.gain > 0.3 * 375 * np.log(1.0 + 0.58 * size**2)
        assert found.where["period"] == pytest.approx(11.83, rel=2e-3)

    def test_period_is_found(self):
        found = [periodic_disturbance(residuals(s, 500, effect=sine), seed=s) for s in range(2, 6)]
        assert np.median([e.p_value for e in found]) < 0.01
        # Half of 1 / duration at this period is 0.35 s.
        assert np.median([abs(e.where["period"] - 13.3) for e in found]) < 0.15
        assert np.median([e.size for e in found]) == pytest.approx(0.9 / np.sqrt(2.0), abs=0.2)

    def test_harmonics_are_named(self):
        def saw(t, mean, u):
            return 3.0 * ((t / 16.7) % 1.0)

        found = periodic_disturbance(residuals(0, 600, pole=0.0, effect=saw))
        assert found.p_value < 1e-6
        assert found.where["period"] == pytest.approx(16.7, rel=0.005)
        assert "harmonics 2" in found.sentence

    def test_only_what_is_held_out_is_looked_at(self):
        def early(t, mean, u):
            return 3.0 * np.sin(t) * (t < 100.0)

        held = np.arange(500) >= 200
        found = periodic_disturbance(residuals(0, 500, effect=early, held_out=held))
        assert found.p_value > 0.01

    def test_rows_that_are_not_there(self):
        r = residuals(2, 500, effect=sine)
        kept = np.arange(500) % 11 != 3
        fewer = dataclasses.replace(
            r,
            **{
                k: getattr(r, k)[kept]
                for k in ("time", "output", "mean", "innovations", "inputs", "held_out")
            },
            deviations=r.deviations[:, kept],
        )
        assert periodic_disturbance(fewer).where["period"] == pytest.approx(13.3, abs=0.2)
        crooked = dataclasses.replace(fewer, time=fewer.time**1.01)
        with pytest.raises(ValueError, match="equal steps"):
            periodic_disturbance(crooked)


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
        (found,) = calendar(r, zones=(MELBOURNE,))
        assert found.p_value < 1e-4
        assert found.where == {"what": "hour of day", "zone": MELBOURNE}
        assert found.size == pytest.approx(0.74, abs=0.2)

    def test_weekend_is_found(self):
        clock = stamps(700)
        weekend = np.asarray(clock.day_of_week >= 5)
        r = residuals(1, 700, step=1.0, stamps=clock, effect=lambda *_: 1.5 * weekend)
        (found,) = calendar(r)
        assert found.p_value < 1e-3
        assert found.where == {"what": "weekend", "zone": "UTC"}

    def test_time_of_year_is_found(self):
        clock = pd.date_range("2020-01-01", periods=1100, freq="D", tz="UTC")
        angle = 2.0 * np.pi * np.arange(1100) / 365.25
        r = residuals(0, 1100, step=1.0, stamps=clock, effect=lambda *_: np.cos(angle))
        _, found = calendar(r)
        assert found.p_value < 1e-3
        assert found.where["what"] in ("time of year", "season")

    def test_a_shutdown_over_the_holidays_is_found(self):
        clock = pd.date_range("2020-01-01", periods=1100, freq="D", tz="UTC")
        day = np.asarray(clock.month * 100 + clock.day)
        shut = (day >= 1222) | (day <= 110)
        r = residuals(0, 1100, step=1.0, stamps=clock, effect=lambda *_: -2.5 * shut)
        _, found = calendar(r)
        assert found.p_value < 1e-3
        assert found.where["what"] == "turn of the year"
        assert "least at" in found.sentence

    def test_the_clock_of_the_stamps_is_named_where_others_tell_no_better(self):
        """Where the weekend begins says the zone, but at night nobody works."""
        clock = pd.date_range("2024-03-04", periods=1000, freq="30min", tz="Europe/Berlin")
        at_work = np.asarray((clock.hour >= 8) & (clock.hour < 18) & (clock.day_of_week < 5))
        for seed in (1, 3, 5):
            r = residuals(seed, 1000, step=1.0, stamps=clock, effect=lambda *_: 1.5 * at_work)
            (found,) = calendar(r, zones=("America/Santiago", "UTC"))
            assert found.where["zone"] == "Europe/Berlin"

    def test_what_repeats_every_week_does_not_hide_the_turn_of_the_year(self):
        clock = pd.date_range("2020-01-01", periods=1100, freq="D", tz="UTC")
        day = np.asarray(clock.month * 100 + clock.day)
        shut, weekend = (day >= 1222) | (day <= 110), np.asarray(clock.day_of_week >= 5)
        r = residuals(0, 1100, step=1.0, stamps=clock, effect=lambda *_: 4.0 * weekend - 2.0 * shut)
        week, year = calendar(r)
        assert week.where["what"] == "weekend"
        assert year.where["what"] == "turn of the year"
        assert max(week.p_value, year.p_value) < 1e-3
        assert week.statistic > year.statistic

    def test_stamps_and_zones_must_be_there(self):
        with pytest.raises(ValueError, match="time stamps"):
            calendar(residuals(0))
        with pytest.raises(ValueError, match="zones"):
            calendar(residuals(0, step=1.0, stamps=stamps(300)), zones=("Mars/Base",))


def daylight_saving(seed, n=600):
    """Demand by local time; the model's clock is standard time. Summer ends in sample 352."""
    clock = stamps(n)
    standard = (np.asarray(clock.hour) + 10) % 24
    local = np.asarray(clock.tz_convert(MELBOURNE).hour)
    profile = 2.0 * np.exp(-0.5 * ((np.arange(24) - 18) / 3.0) ** 2)
    r = residuals(seed, n, step=1.0, stamps=clock)
    return dataclasses.replace(
        r,
        mean=r.mean + profile[standard],
        output=r.mean + profile[local] + 0.5 * r.residual,
        inputs=np.column_stack([r.inputs, standard]),
        input_names=("temperature", "hour"),
    )


class TestClockShift:
    @pytest.mark.parametrize(("channel", "shift"), [(0, 1.5), (1, 1.5), (1, -1.0)])
    def test_shift_is_found(self, channel, shift):
        def effect(t, mean, u):
            own = share(u[:, channel], channel + 1.0)
            return np.where(t >= 90.0, np.interp(t + shift, t, own) - own, 0.0)

        found = clock_shift(residuals(3, 400, inputs=2, effect=effect))
        assert found.p_value < 1e-4
        assert found.where["channel"] == f"u{channel + 1}"
        assert found.where["shift"] == pytest.approx(shift, abs=0.2)
        assert found.where["time"] == pytest.approx(90.0, abs=4.0)

    def test_daylight_saving_is_found(self):
        found = clock_shift(daylight_saving(1), zones=("Europe/Berlin", MELBOURNE))
        assert found.p_value < 1e-4
        assert found.where == {
            "channel": "hour", "rule": MELBOURNE, "season": "summers", "shift": 1.0, "time": 352.0,
            "time_unit": "s", "stamp": "2023-04-01T16:00:00+00:00", "zone": "UTC",
        }  # fmt: skip

    @pytest.mark.parametrize("shift", [2.0, -2.0])
    def test_what_a_summer_takes_for_right_is_off_in_winters(self, shift):
        # Steps of half an hour: an hour is two.
        def effect(t, mean, u):
            own = share(u[:, 0], 1.0)
            return np.where(t >= 352.0, np.interp(t + 0.5 * shift, t, own) - own, 0.0)

        r = residuals(3, 1200, step=0.5, effect=effect)
        r = dataclasses.replace(r, stamps=stamps(1200, "30min"))
        found = clock_shift(r, zones=(MELBOURNE,))
        assert found.p_value < 1e-4
        assert (found.where["rule"], found.where["season"]) == (MELBOURNE, "winters")
        assert found.where["shift"] == pytest.approx(0.5 * shift)
        assert "in the winters of Australia/Melbourne" in found.sentence

    def test_shift_of_the_whole_record_is_a_dead_time(self):
        def late(t, mean, u):
            return np.interp(t - STEP, t, mean) - mean

        STEP = 0.5
        found = clock_shift(residuals(0, 400, effect=late))
        assert found.p_value > 0.01

    def test_there_must_be_an_input(self):
        r = residuals(0)
        with pytest.raises(ValueError, match="an input"):
            clock_shift(dataclasses.replace(r, inputs=r.inputs[:, :0], input_names=()))


@pytest.mark.usefixtures("few")
@pytest.mark.parametrize(
    "detector", [drift, level_shift, periodic_disturbance, of_the_week, clock_shift]
)
def test_units_and_order_do_not_matter(detector):
    r = residuals(0, 400, inputs=2, step=1.0, stamps=stamps(400), deviation=0.02, effect=gain_drift)
    one, other = detector(r), detector(in_other_units(r))
    assert other.p_value == pytest.approx(one.p_value, rel=1e-6)
    assert other.size == pytest.approx(1e-3 * one.size, rel=1e-6)
    for key, value in one.where.items():
        if key in ("time", "shift", "period", "time_scale"):
            assert other.where[key] == pytest.approx(60.0 * value, rel=1e-6)
        elif key == "size":
            assert other.where[key] == pytest.approx(1e-3 * value, rel=1e-6)
        elif key == "time_unit":
            assert (value, other.where[key]) == ("s", "min")
        else:
            assert other.where[key] == value


@pytest.mark.usefixtures("few")
@pytest.mark.parametrize("detector", [drift, level_shift, of_the_week, clock_shift])
def test_irregular_steps_and_gaps(detector):
    generator = np.random.default_rng(0)
    r = residuals(0, 400, step=1.0, stamps=stamps(400))
    output = np.where(generator.random(400) < 0.1, np.nan, r.output)
    time = r.time + 0.3 * generator.random(400)
    found = detector(dataclasses.replace(r, output=output, time=time))
    assert 0.0 < found.p_value <= 1.0
    assert np.isfinite(found.gain)


@pytest.mark.usefixtures("few")
@pytest.mark.parametrize("detector", [drift, level_shift, periodic_disturbance, of_the_week])
def test_records_without_inputs_and_without_noise(detector):
    r = residuals(0, 400, step=1.0, stamps=stamps(400))
    free = dataclasses.replace(r, inputs=r.inputs[:, :0], input_names=(), mean=np.zeros(400))
    assert detector(free).p_value > 0.0
    assert detector(dataclasses.replace(r, output=r.mean.copy())).p_value > 0.05
