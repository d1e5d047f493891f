"""A clock that is off: its instant and shift, its rule, forecasts across it."""

import dataclasses

import numpy as np
import pandas as pd
import pytest

import pyro_dynogp as dgp
from pyro_dynogp import effects
from pyro_dynogp.data.channels import ShiftedClock
from pyro_dynogp.discrepancy.trials import Trial, run
from pyro_dynogp.effects.clock_shift import clock_shift, seasons
from pyro_dynogp.models.variants import with_channel
from tests.discrepancy.made import SETTINGS, coloured, fitted_mode
from tests.discrepancy.plant_dynamics import System, response
from tests.discrepancy.series import residuals, share
from tests.discrepancy.test_decision import spoken_for
from tests.effects.scenes import MELBOURNE, daylight_saving, stamps

N, STEP, FIRST, LATE, NOISE = 500, 1200.0, 180, 3, 0.05
MODEL = dgp.LinearDynamicGP(1, pairs=1)


class TestClockShift:
    @pytest.mark.parametrize(("channel", "shift"), [(0, 1.5), (1, 1.5), (1, -1.0)])
    def test_shift_is_found(self, channel, shift):
        def effect(t, mean, u):
            own = share(u[:, channel], channel + 1.0)
            return np.where(t >= 90.0, np.interp(t + shift, t, own) - own, 0.0)

        found = clock_shift(residuals(3, 400, inputs=2, effect=effect), SETTINGS)
        assert found.p_value < 1e-4
        assert found.where["channel"] == f"u{channel + 1}"
        assert found.where["shift"] == pytest.approx(shift, abs=0.2)
        assert found.where["time"] == pytest.approx(90.0, abs=4.0)

    def test_daylight_saving_is_found(self):
        found = clock_shift(daylight_saving(1), SETTINGS, zones=("Europe/Berlin", MELBOURNE))
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
        found = clock_shift(r, SETTINGS, zones=(MELBOURNE,))
        assert found.p_value < 1e-4
        assert (found.where["rule"], found.where["season"]) == (MELBOURNE, "winters")
        assert found.where["shift"] == pytest.approx(0.5 * shift)
        assert "in the winters of Australia/Melbourne" in found.sentence

    def test_shift_of_the_whole_record_is_a_dead_time(self):
        def late(t, mean, u):
            return np.interp(t - STEP, t, mean) - mean

        STEP = 0.5
        found = clock_shift(residuals(0, 400, effect=late), SETTINGS)
        assert found.p_value > 0.01

    def test_there_must_be_an_input(self):
        r = residuals(0)
        with pytest.raises(ValueError, match="an input"):
            clock_shift(dataclasses.replace(r, inputs=r.inputs[:, :0], input_names=()), SETTINGS)


@pytest.fixture(scope="module")
def record() -> dgp.Record:
    """From sample 180 on the input is recorded with stamps that are an hour late."""
    rng = np.random.default_rng(2)
    u = coloured(rng, N, 0.8)
    y = response(System(np.array([-0.25 + 0.3j]), np.array([[0.3 - 0.2j]])), u[:, None])
    y = y / y.std() + NOISE * rng.standard_normal(N)
    wrong = u.copy()
    wrong[FIRST:] = np.concatenate([np.full(LATE, u[0]), u])[FIRST:N]
    return dgp.Record(
        STEP * np.arange(N), wrong[:, None], y[:, None], input_names=("u",),
        start="2023-10-25T00:20:00+02:00",
    )  # fmt: skip


@pytest.mark.parametrize("zone", ["Europe/Berlin", "America/New_York", "Australia/Lord_Howe"])
@pytest.mark.parametrize("season", ["summers", "winters"])
def test_seasons_begin_when_clocks_change(record, zone, season):
    times = seasons(record, zone, season)
    assert len(times) >= 3
    stamps = pd.DatetimeIndex([record.start + pd.Timedelta(t, "s") for t in times])
    minute = pd.Timedelta(1, "min")
    before, after = (
        [bool(one.dst()) for one in (stamps + shift).tz_convert(zone).to_pydatetime()]
        for shift in (-minute, 0 * minute)
    )
    begins = season == "summers"
    assert after == [begins if k % 2 == 0 else not begins for k in range(len(times))]
    assert all(a is not b for a, b in zip(before, after, strict=True))


@pytest.mark.parametrize(("instant", "shift"), [(FIRST + 24, LATE - 1), (FIRST - 9, LATE + 2)])
def test_instant_and_shift_are_refined(record, instant, shift):
    base = fitted_mode(MODEL, record[:400])
    effect = effects.ClockShift()
    where = {"channel": "u", "shift": shift * STEP, "time": instant * STEP, "time_unit": "s"}
    where |= {"stamp": record.timestamps[instant].isoformat(), "zone": "Europe/Berlin"}
    found = spoken_for(effect, 0.001, 0.01, **where)
    variants = tuple(effect.extend(MODEL, found.evidence, record))
    held_out = np.arange(N) >= 400
    trial = Trial(variants, record, (held_out,), base, 0, SETTINGS, "forecast", effect.refine)
    tried = run(trial)
    (channel,) = tried.model.channels
    assert channel.shift == LATE * STEP
    # A slow input says little about a sample more or less.
    assert abs(channel.times[0] / STEP - FIRST) <= 3
    sentence = effect.sentence(found.evidence, tried.model)
    stamp = record.timestamps[round(channel.times[0] / STEP)].tz_convert("Europe/Berlin")
    assert sentence == f"The clock of 'u' is 3600 s late from {stamp:%Y-%m-%d %H:%M:%S %Z}."


def test_what_a_rule_says_is_not_refined(record):
    where = {"channel": "u", "shift": 3600.0, "time": 0.0}
    where |= {"rule": "Europe/Berlin", "season": "winters"}
    found = spoken_for(effects.ClockShift(), 0.001, 0.01, **where)
    (model,) = effects.ClockShift().extend(MODEL, found.evidence, record)
    assert effects.ClockShift().refine(model, record, 0) == []
    assert effects.ClockShift().sentence(found.evidence, model) == found.evidence.sentence


def test_forecasts_read_a_late_clock_ahead(record):
    """The state at the end of the past needs inputs whose stamps are in the future."""
    late = with_channel(MODEL, ShiftedClock("u", LATE * STEP, (FIRST * STEP,)))
    fit = fitted_mode(late, record[:400])
    whole = fit.model.check(record)[0]
    for cut in (300, 350, 400):
        found = fit.forecast(record[:cut], record[cut:])
        expected = fit.forecast(whole[:cut], whole[cut:])
        np.testing.assert_allclose(found.mean, expected.mean, rtol=1e-12, atol=1e-12)
    # The last inputs would have to be read beyond the record's end.
    error = (fit.forecast(record[:400], record[400:]).mean - record.outputs[400:])[:-LATE]
    assert np.sqrt(np.mean(error**2)) < 1.2 * NOISE
