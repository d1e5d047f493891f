"""Channels made from a record, and models that carry them."""

from __future__ import annotations

import itertools
import json

import numpy as np
import pandas as pd
import pytest
from hypothesis import given
from hypothesis import strategies as st

import pyro_dynogp as dgp
from pyro_dynogp.data import channels
from pyro_dynogp.data.signals import dead_zone, delayed, play


def record(n: int = 60, **options: object) -> dgp.Record:
    rng = np.random.default_rng(0)
    return dgp.Record(
        np.arange(n) * 0.5,
        rng.standard_normal((n, 2)),
        rng.standard_normal(n),
        input_names=("valve", "load"),
        input_units=("%", "kN"),
        extra={"ambient": rng.standard_normal(n)},
        extra_units={"ambient": "K"},
        **options,  # type: ignore[arg-type]
    )


ALL = [
    channels.Recorded("ambient"),
    channels.Delayed("valve", 0.7),
    channels.DeadZone("load", -0.2, 0.3),
    channels.Play("valve delayed", 0.4),
    channels.Transformed("ambient", "square", 0.1),
    channels.Product("ambient", "load", 0.1, 0.2),
    channels.Step(12.0),
    channels.StepInput(12.0),
    channels.Trend(0.0, 10.0),
    channels.TrendOfGain("load", 0.0, 0.0, 10.0),
    channels.Sinusoid(4.0, 2),
    channels.ShiftedClock("load", 1.0, (10.0, 20.0)),
    channels.Ramp(5.0, 12.0),
    channels.RampOfGain("load", 0.1, 5.0, 12.0),
    channels.StepOfGain("load", 0.1, 8.0),
]


@pytest.mark.parametrize("channel", ALL, ids=lambda c: type(c).__name__)
def test_a_channel_survives_json(channel: channels.Channel) -> None:
    plain = json.loads(json.dumps(channels.to_plain(channel)))
    assert channels.from_plain(plain) == channel


def test_an_unknown_channel_is_refused() -> None:
    with pytest.raises(ValueError, match="unknown channel 'Script'"):
        channels.from_plain({"kind": "Script"})


def test_columns_come_in_their_places_with_units() -> None:
    own = record()
    made = channels.prepared(
        own,
        [
            channels.Step(12.0),
            channels.Delayed("valve", 0.5),
            channels.Recorded("ambient"),
            channels.Play("valve delayed", 0.4),
        ],
    )
    assert made.input_names == ("valve delayed behind play", "load", "ambient", "step at 12")
    assert made.input_units == ("%", "kN", "K", "")
    np.testing.assert_allclose(made.extra["valve"], own.inputs[:, 0])
    late = np.concatenate([own.inputs[:1, 0], own.inputs[:-1, 0]])
    np.testing.assert_allclose(made.inputs[:, 0], play(late, 0.4), atol=1e-12)
    assert (made.inputs[:, 3] == (own.time >= 12.0)).all()


def test_a_prepared_record_stays_as_it_is() -> None:
    chain = [channels.Delayed("valve", 0.5), channels.Play("valve delayed", 0.4), ALL[6]]
    once = channels.prepared(record(), chain)
    assert channels.prepared(once, chain) is once


def test_what_a_channel_needs_must_be_there() -> None:
    with pytest.raises(ValueError, match="a channel 'wind'"):
        channels.prepared(record(), [channels.Recorded("wind")])
    with pytest.raises(ValueError, match="time stamps"):
        channels.prepared(record(), [channels.Calendar("weekday")])
    with pytest.raises(ValueError, match="IANA"):
        channels.Calendar("weekday", "Mars/Olympus")
    with pytest.raises(ValueError, match="hour of day"):
        channels.Calendar("minute")
    with pytest.raises(ValueError, match="'square' or 'absolute'"):
        channels.Transformed("load", "cube", 0.0)


@given(st.integers(0, 5), st.integers(0, 1000))
def test_a_delay_of_whole_steps_moves_the_samples(steps: int, seed: int) -> None:
    u = np.random.default_rng(seed).standard_normal(20)
    late = delayed(u, np.arange(20) * 0.1, 0.1 * steps)
    np.testing.assert_allclose(late, u[np.maximum(np.arange(20) - steps, 0)], atol=1e-12)


def test_a_delay_of_part_of_a_step_is_the_mean_over_the_step() -> None:
    rng = np.random.default_rng(1)
    time = np.cumsum(rng.uniform(0.5, 1.5, 30))
    u, delay = rng.standard_normal(30), 0.83
    late = delayed(u, time, delay)
    for k in range(5, 29):  # a fine sum of the held signal
        fine = np.linspace(time[k], time[k + 1], 20001)[:-1] + 0.5 * (time[k + 1] - time[k]) / 20000
        held = u[np.searchsorted(time, fine - delay, side="right") - 1]
        assert late[k] == pytest.approx(held.mean(), abs=2e-4)


@given(st.floats(0.0, 3.0), st.integers(0, 100))
def test_play_stays_within_its_width_and_moves_only_at_its_edges(width: float, seed: int) -> None:
    u = np.random.default_rng(seed).standard_normal(50).cumsum()
    y = play(u, width)
    assert (np.abs(u - y) <= 0.5 * width + 1e-12).all()
    moved = np.flatnonzero(np.diff(y) != 0) + 1
    np.testing.assert_allclose(np.abs(u - y)[moved], 0.5 * width, atol=1e-9)
    np.testing.assert_allclose(play(u, 0.0), u)


def test_ramps_make_a_path_that_is_held() -> None:
    """With their gains they go through the knots, and stay where the last one ends."""
    own, knots, levels = record(), [0.0, 8.0, 16.0, 24.0], np.array([0.0, -1.0, 0.5, 2.0])
    pairs = list(itertools.pairwise(knots))
    level = np.interp(own.time, knots, levels)
    ramps = np.column_stack([channels.Ramp(*ends).columns(own)[:, 0] for ends in pairs])
    # Up to rounding.
    np.testing.assert_allclose(ramps @ np.diff(levels), level, atol=1e-12)
    gains = [channels.RampOfGain("load", 0.1, *ends).columns(own)[:, 0] for ends in pairs]
    expected = (own.inputs[:, 1] - 0.1) * level
    np.testing.assert_allclose(np.column_stack(gains) @ np.diff(levels), expected, atol=1e-12)


def test_a_gain_steps_with_the_level_of_its_centre() -> None:
    own = record()
    at = float(own.time[7])
    gain, level = channels.StepOfGain("load", 0.1, at), channels.Step(at)
    before, after = np.zeros(7), own.inputs[7:, 1] - 0.1
    np.testing.assert_array_equal(gain.columns(own)[:, 0], np.concatenate([before, after]))
    assert gain.columns(own).shape == level.columns(own).shape
    assert gain.names == (f"load from {at:.9g}",)
    assert not gain.direct
    assert level.direct


def test_a_dead_zone_leaves_what_lies_beyond() -> None:
    np.testing.assert_allclose(dead_zone(np.array([-2.0, 0.1, 3.0]), -0.5, 1.0), [-1.5, 0.0, 2.0])
    with pytest.raises(ValueError, match="no more than high"):
        dead_zone(np.zeros(3), 1.0, 0.0)
    with pytest.raises(ValueError, match="width"):
        play(np.zeros(3), -1.0)


def test_a_calendar_knows_local_time() -> None:
    stamps = pd.date_range("2021-03-27", periods=96, freq="h", tz="UTC")
    own = dgp.Record(stamps, np.zeros((96, 0)), np.arange(96.0))
    hours = channels.Calendar("hour of day", "Europe/Berlin", 1).columns(own)
    local = stamps.tz_convert("Europe/Berlin")
    np.testing.assert_allclose(hours[:, 0], np.cos(2 * np.pi * np.asarray(local.hour) / 24))
    weekend = channels.Calendar("weekend", "Europe/Berlin").columns(own)[:, 0]
    assert (weekend == (np.asarray(local.day_of_week) >= 5)).all()
    for what, count in (
        ("weekday", 6),
        ("time of year", 12),
        ("hour of day by weekend", 25),
        ("turn of the year", 7),
    ):
        assert channels.Calendar(what).columns(own).shape == (96, count)


def test_a_shifted_clock_reads_the_input_elsewhere_between_its_instants() -> None:
    own = record()
    made = channels.ShiftedClock("load", 1.0, (10.0, 20.0)).columns(own)[:, 0]
    inside = (own.time >= 10.0) & (own.time < 20.0)
    np.testing.assert_allclose(made[~inside], own.inputs[~inside, 1])
    np.testing.assert_allclose(made[inside], own.inputs[np.flatnonzero(inside) + 2, 1], atol=1e-12)


def test_a_step_acts_at_once_or_through_the_dynamics() -> None:
    """The same column; the one that acts through dynamics comes among the inputs, before others."""
    made = channels.prepared(record(), [channels.Step(9.0), channels.StepInput(12.0)])
    assert made.input_names[-2:] == ("disturbance from 12", "step at 9")
    assert (made.inputs[:, -2] == (made.time >= 12.0)).all()
    assert channels.count_direct([channels.Step(9.0), channels.StepInput(12.0)]) == 1
