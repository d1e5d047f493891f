"""Every threshold of a test decides something, and is handed down from `close_loop`."""

import dataclasses
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from scipy import stats
from scipy.signal import cont2discrete, lfilter

import pyro_dynogp as dgp
from pyro_dynogp.data.signals import delayed, play
from pyro_dynogp.effects.calendar import _contrasts, calendar
from pyro_dynogp.effects.clock_shift import _preferred, clock_shift
from pyro_dynogp.effects.clock_shift_score import shifts_of
from pyro_dynogp.effects.dead_time import dead_time
from pyro_dynogp.effects.dead_zone import dead_zone
from pyro_dynogp.effects.dynamics import unmodelled_dynamics
from pyro_dynogp.effects.heavy_tails import heavy_tails
from pyro_dynogp.effects.hysteresis import hysteresis
from pyro_dynogp.effects.level_shift import level_shift
from pyro_dynogp.effects.periodic import periodic_disturbance
from pyro_dynogp.effects.saturation import saturation
from pyro_dynogp.statistics import bootstrap
from pyro_dynogp.statistics.autoregression import fitted_filter
from pyro_dynogp.statistics.bootstrap import tail_probability
from pyro_dynogp.statistics.prewhitening import Projection, Variants, prewhitened
from pyro_dynogp.statistics.regression import regress
from pyro_dynogp.statistics.serial import held_out_innovations
from tests.discrepancy.made import FEW, coloured, lag, residuals_of
from tests.discrepancy.series import residuals, share
from tests.effects.scenes import MELBOURNE, first_extra, stamps, step_inputs, two_paths

PACKAGE = Path(dgp.__file__).parent


def other(**values):
    return dataclasses.replace(FEW, **values)


def test_only_the_loop_and_the_command_make_settings():
    """Nothing else has thresholds of its own that a caller would take unawares."""
    makers = {str(path.relative_to(PACKAGE)) for path in PACKAGE.rglob("*.py")
              if "LoopSettings()" in path.read_text()}  # fmt: skip
    assert makers == {"report/loop.py", "cli/close_loop.py"}


def test_every_p_value_has_as_many_replicates(monkeypatch):
    monkeypatch.setattr(bootstrap, "FEWEST", 50)  # all at once, where one exceedance ends them
    x = coloured(np.random.default_rng(0), 200, 0.5)
    column = coloured(np.random.default_rng(1), (200, 1), 0.5)
    none, constant = np.zeros((0, 200)), np.ones((200, 1))
    p = regress(x, [column], None, none, other(replicates=39, exceedances=1)).p_value
    assert (40.0 * p) % 1.0 == pytest.approx(0.0, abs=1e-9)
    assert (20.0 * p) % 1.0 != pytest.approx(0.0, abs=1e-9)

    def tried(width):
        def prepare(under: Projection):
            return lambda x: (np.array([np.nansum(x[:9])]), lambda j: (0.0 * x, 0.0 * x))

        settings = other(replicates=39, fewest_replicates=7, exceedances=1)
        return prewhitened(
            x, Variants(prepare, np.ones(1), width), constant, none, settings
        ).p_value

    assert (8.0 * tried(10**9)) % 1.0 == pytest.approx(0.0, abs=1e-9)
    assert (40.0 * tried(1)) % 1.0 == pytest.approx(0.0, abs=1e-9)


def test_a_count_gives_way_to_a_fitted_tail():
    null = stats.t.rvs(2, size=200, random_state=0)
    largest = float(null.max())
    assert tail_probability(null, largest, other(exceedances=1)) == 2 / 201
    assert tail_probability(null, largest, other(exceedances=2)) < 1e-4


def test_filters_have_an_order_at_most_and_samples_at_least():
    x = coloured(np.random.default_rng(0), 25, 0.5)
    assert fitted_filter(x, other(measured_samples=25)).order <= 2
    with pytest.raises(ValueError, match="at least 26 samples"):
        fitted_filter(x, other(measured_samples=26))
    period = np.sin(0.5 * np.arange(400)) + np.sin(1.3 * np.arange(400))
    noisy = period + 0.1 * np.random.default_rng(0).standard_normal(400)
    assert fitted_filter(noisy, FEW).order > 2
    assert fitted_filter(noisy, other(filter_order=2)).order == 2
    # Each order costs three stretches of twelve samples one each: 30 are left of order two.
    gaps = np.where(np.arange(400) % 24 < 12, noisy, np.nan)[:72]
    assert fitted_filter(gaps, other(measured_samples=20)).order == 3
    assert fitted_filter(gaps, other(measured_samples=30)).order == 2
    r = residuals(0, 60)
    assert np.isfinite(held_out_innovations(r, other(measured_samples=60))).sum() == 60
    with pytest.raises(ValueError, match="at least 61 held-out innovations"):
        held_out_innovations(r, other(measured_samples=61))


def late():
    _, u, parts, e = step_inputs(2, inputs=1)
    time = 0.1 * np.arange(400)
    return residuals_of(lag(delayed(u[:, 0], time, 0.33), 0.5) + e, parts[:, 0], u)


def with_zone():
    u, a, b, e = two_paths(3)
    middle = np.sign(u[:, 1]) * np.maximum(np.abs(u[:, 1]) - 0.5, 0.0)
    return residuals_of(a + lag(middle, 0.8) + e, a + 0.7 * b, u)


def with_play():
    u, a, b, e = two_paths(4)
    return residuals_of(a + lag(play(u[:, 1], 0.7), 0.8) + e, a + b, u)


def with_resonance():
    _, u, parts, e = step_inputs(5, inputs=1)
    system = cont2discrete(([9.0], [1.0, 0.9, 9.0]), 0.1)
    return residuals_of(parts[:, 0] + lfilter(system[0].ravel(), system[1], u[:, 0]) + e,
                        parts[:, 0], u)  # fmt: skip


def with_channel():
    rng, u, parts, e = step_inputs(2)
    w = coloured(rng, 400, 0.7)
    y = parts.sum(1) + e + 0.8 * lag(delayed(w, 0.1 * np.arange(400), 1.25), 0.3)
    return residuals_of(y, parts.sum(1), u, {"w": w})


def with_limit():
    u, a, b, e = two_paths(6)
    return residuals_of(np.minimum(a + b, 0.35) + e, a + b, u)


@pytest.mark.parametrize(
    ("detector", "scene", "key"),
    [
        (dead_time, late, "delay"),
        (dead_zone, with_zone, "low"),
        (hysteresis, with_play, "width"),
        (unmodelled_dynamics, with_resonance, "frequency"),
        (first_extra, with_channel, "delay"),
        (saturation, with_limit, "high"),
    ],
)
def test_what_is_noticed_is_looked_at_more_finely(detector, scene, key):
    r = scene()
    assert detector(r, FEW).p_value < FEW.noticed
    assert detector(r, FEW).where[key] != detector(r, other(noticed=1e-300)).where[key]


def test_a_delay_must_pay_for_itself():
    r = with_channel()
    assert first_extra(r, FEW).where["delay"] > 1.0
    assert first_extra(r, other(preference=1e6)).where["delay"] == 0.0


def test_another_clock_must_pay_for_itself():
    clock = pd.date_range("2024-03-04", periods=1000, freq="30min", tz="Europe/Berlin")
    at_work = np.asarray((clock.hour >= 8) & (clock.hour < 18) & (clock.day_of_week < 5))
    named = {}
    for preference in (FEW.preference, 1e-9):
        found = [
            calendar(
                residuals(s, 1000, step=1.0, stamps=clock, effect=lambda *_: 1.5 * at_work),
                other(preference=preference, replicates=1, fewest_replicates=1),
                zones=("America/Santiago", "UTC"),
            )[0]
            for s in (1, 3, 5)
        ]
        named[preference] = {e.where["zone"] for e in found}
    assert named[FEW.preference] == {"Europe/Berlin"}
    assert named[1e-9] != {"Europe/Berlin"}


def test_a_rule_has_no_instant_to_choose_and_summers_come_first():
    gains = np.array([6.0, 8.5, 10.0])  # summers, winters, an instant
    rules = [("summers", "UTC"), ("winters", "UTC")]
    assert _preferred(gains, 2, rules, 1, 3.0) == 0
    assert _preferred(gains, 2, rules, 1, 2.0) == 1
    assert _preferred(gains, 2, rules, 1, 1.0) == 2

    def late_from_90(t, mean, u):
        share_ = share(u[:, 0], 1.0)
        return np.where(t >= 90.0, np.interp(t + 1.0, t, share_) - share_, 0.0)

    r = residuals(3, 1200, step=0.5, effect=late_from_90)
    r = dataclasses.replace(r, stamps=stamps(1200, "30min"))
    assert "rule" not in clock_shift(r, FEW, zones=(MELBOURNE,)).where
    assert "rule" in clock_shift(r, other(preference=1e6), zones=(MELBOURNE,)).where


def test_ties_and_flat_ends_are_limits():
    u, a, b, e = two_paths(6, noise=0.3)
    y = np.minimum(a + b + e, np.quantile(a + b, 0.8))
    y[np.argsort(y)[:3]] = y.min()
    r = residuals_of(y, a + b, u)
    found, loose = saturation(r, FEW), saturation(r, other(tied=0.5))
    assert np.isfinite(found.where["high"])
    assert not np.isfinite(found.where["low"])
    assert np.isfinite(loose.where["low"])
    bent = residuals_of(a + b - 0.5 * np.maximum(a + b - 0.2, 0.0) + 0.2 * e, a + b, u)
    assert saturation(bent, FEW).p_value == 1.0
    assert saturation(bent, other(flat=0.8)).p_value < 0.01


def test_margins_are_left_out():
    r = residuals(0, 500, effect=lambda t, mean, u: 3.0 * (t >= 25.0))
    assert level_shift(r, FEW).where["time"] == pytest.approx(25.0, abs=2.0)
    assert level_shift(r, other(step_margin=0.2)).where["time"] >= 50.0
    shares, parts = r.mean[:, None], np.zeros((0, 500))
    assert shifts_of(r, shares, parts, FEW).edges.min() == 25
    assert shifts_of(r, shares, parts, other(clock_margin=0.2)).edges.min() == 100


@pytest.mark.parametrize(
    ("days", "values", "whats"),
    [
        (3, {}, {"hour of day"}),
        (13, {}, {"hour of day"}),
        (14, {}, {"hour of day", "hour of day by weekday/weekend", "weekend", "weekday"}),
        (14, {"days_for_hours": 15}, {"hour of day by weekday/weekend", "weekend", "weekday"}),
        (14, {"days_for_week": 15}, {"hour of day"}),
        (14, {"days_for_hours": 15, "days_for_week": 15, "days_for_year": 14},
         {"season", "time of year", "turn of the year"}),
    ],
)  # fmt: skip
def test_contrasts_of_the_calendar_need_days(days, values, whats):
    clock = pd.date_range("2023-02-20", periods=24 * days, freq="h", tz="UTC")
    r = residuals(0, 24 * days, step=1.0, stamps=clock)
    contrasts, _ = _contrasts(r, (), other(**values))
    seasonal = {"season", "turn of the year"}  # which a fortnight may have no two groups of
    assert {c.what for c in contrasts} - seasonal == whats - seasonal


def test_a_year_and_a_half_are_needed_for_the_year():
    assert FEW.days_for_year == 548
    for days, longer in ((547, False), (548, True)):
        clock = pd.date_range("2020-01-01", periods=days, freq="D", tz="UTC")
        contrasts, _ = _contrasts(residuals(0, days, step=1.0, stamps=clock), (), FEW)
        assert ("time of year" in {c.what for c in contrasts}) is longer
    with pytest.raises(ValueError, match="at least 3 days"):
        _contrasts(residuals(0, 48, step=1.0, stamps=stamps(48)), (), FEW)


def test_what_is_periodic_comes_often_and_has_the_harmonics_that_are_certain():
    r = residuals(0, 400, pole=0.5, effect=lambda t, mean, u: 2.0 * np.sin(2.0 * np.pi * t / 90.0))
    assert periodic_disturbance(r, FEW).where["period"] <= 200.0 / 3.0 * 1.1
    found = periodic_disturbance(r, other(cycles=1.5)).where["period"]
    assert found == pytest.approx(90.0, rel=0.1)

    def waves(t, mean, u):
        return np.sin(2.0 * np.pi * t / 13.3) + 0.5 * np.sin(4.0 * np.pi * t / 13.3)

    r = residuals(0, 400, pole=0.5, effect=waves)
    assert "with harmonics 2" in periodic_disturbance(r, FEW).sentence
    assert "harmonics" not in periodic_disturbance(r, other(harmonic=1e-300)).sentence


def test_outliers_are_what_normal_errors_seldom_have():
    v = np.random.default_rng(0).standard_normal(400)
    v[[50, 90]] = 8.0, 3.6
    r = dataclasses.replace(residuals(0, 400), innovations=v)
    assert heavy_tails(r, FEW).where["outliers"] == 1
    assert heavy_tails(r, other(outlier=0.2)).where["outliers"] > 1
