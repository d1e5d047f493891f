"""Which of the effects that help comes first, what they are scored on, which variants there are."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pandas as pd
import pytest
from scipy.stats import binom

import pyro_dynogp as dgp
from pyro_dynogp import effects
from pyro_dynogp.criticism.comparison import block_standard_error
from pyro_dynogp.data.channels import Calendar, Delayed, ShiftedClock
from pyro_dynogp.discrepancy import refits
from pyro_dynogp.discrepancy.decision import (
    _first_in_line,
    _is_needless,
    _judged,
    _specific,
    _too_special,
    confirm,
)
from pyro_dynogp.discrepancy.judged import Judged, enough_samples, judge
from pyro_dynogp.discrepancy.search import Found
from pyro_dynogp.discrepancy.trials import Tried
from pyro_dynogp.statistics.evidence import Evidence
from pyro_dynogp.statistics.settings import LoopSettings
from tests.discrepancy.made import SETTINGS
from tests.discrepancy.test_loop import fitted, machine

MODEL = dgp.LinearDynamicGP(inputs=1, pairs=1)


def spoken_for(effect: effects.Effect, p: float, q: float, **where: Any) -> Found:
    evidence = Evidence(effect.name, 1.0, p, 1.0, 1.0, where, "It is so.", None)
    return Found(effect, evidence, q)


def tried(gains: np.ndarray, **options: Any) -> Tried:
    return Tried(MODEL, gains, 0.0, **options)


def helping(effect: effects.Effect, p: float, q: float, gain: float = 50.0) -> Judged:
    n = 100
    kind = ("after", effect.score)
    noise = np.random.default_rng(0).normal(0.0, 0.1, n)
    found = spoken_for(effect, p, q)
    return judge(found, kind, tried(noise + gain / n), tried(np.zeros(n)), 1, SETTINGS)


def names(judged: list[Judged]) -> list[str]:
    return [one.found.effect.name for one in judged]


def test_structure_comes_before_noise() -> None:
    both = [helping(effects.HeavyTails(), 1e-9, 1e-8), helping(effects.Drift(), 1e-3, 1e-2)]
    assert names(_first_in_line(both, 0.05)) == ["drift"]


def test_only_relatives_stand_beside_a_certain_cause() -> None:
    step, lucky = helping(effects.LevelShift(), 1e-9, 1e-8), helping(effects.ExtraInput(), 0.2, 1.0)
    assert names(_first_in_line([lucky, step], 0.05)) == ["level shift"]
    relative = helping(effects.Drift(), 0.2, 1.0)  # of the same family
    assert names(_first_in_line([relative, step], 0.05)) == ["drift", "level shift"]
    other = helping(effects.ExtraInput(), 1e-4, 1e-3)
    assert names(_first_in_line([other, step], 0.05)) == ["extra input", "level shift"]
    assert names(_first_in_line([lucky], 0.05)) == ["extra input"]


def test_where_noise_alone_is_certain_it_comes_before_structure() -> None:
    lucky, own = (helping(effects.ExtraInput(), p, 0.5) for p in (0.2, 0.01))
    for q, first in ((1e-8, "heavy tails"), (0.2, "extra input")):
        tails = helping(effects.HeavyTails(), 1e-9, q)
        assert names(_first_in_line([lucky, tails], 0.05)) == [first]
        assert names(_first_in_line([own, tails], 0.05)) == [first]


def test_of_effects_that_are_one_block_the_specific_one_gives_the_name_if_it_is_certain() -> None:
    """Limits of a sensor and a curve at the output are the same function of the model."""

    def leading(q: float) -> str:
        limits = spoken_for(effects.Saturation(), 1e-3, q)
        curve = spoken_for(effects.OutputNonlinearity(), 1e-20, 1e-19)
        return min([curve, limits], key=lambda one: _specific(one, 0.05)).effect.name

    assert leading(0.01) == "saturation"
    assert leading(0.3) == "output nonlinearity"


@pytest.mark.parametrize(
    ("q", "others", "too_special"),
    [
        (0.01, {"saturation", "output nonlinearity"}, False),
        (0.3, {"saturation", "output nonlinearity"}, True),
        (0.3, {"saturation", "dead zone"}, False),
    ],
)
def test_a_special_case_gives_its_name_where_it_is_certain_or_alone(q, others, too_special) -> None:
    found = spoken_for(effects.Saturation(), 1e-3, q)
    assert _too_special(found, others, 0.05) == too_special


NOISE = SimpleNamespace(
    system=SimpleNamespace(noise=SimpleNamespace(constant_sd=1.0)), noise_sd=np.ones(1)
)


@pytest.mark.parametrize(
    ("effect", "q", "gain", "error", "needed"),
    [
        (effects.ExtraInput(), 1e-5, 50.0, 1.4, False),
        (effects.LevelShift(), 1e-5, 50.0, 1.4, True),  # which evidence does not support, below
        (effects.ExtraInput(), 1e-1, 50.0, 1.4, True),  # the residual speaks less for it
        (effects.ExtraInput(), 1e-5, 0.0, 1.4, True),  # it does not help
        (effects.ExtraInput(), 1e-5, 50.0, 1.6, True),  # it leaves more than noise
        (effects.InputNonlinearity(), 1e-5, 50.0, 1.05, False),  # a relative
        (effects.InputNonlinearity(), 1e-5, 50.0, 1.2, True),
    ],
)
def test_functions_in_feedback_are_not_tried_beside_what_leaves_little_else_than_noise(
    effect, q, gain, error, needed
) -> None:
    """They are judged last: of what takes less time any may be that."""
    curve = spoken_for(effects.OutputNonlinearity(), 0.2, 0.3), (dgp.Wiener(1, pairs=1),)
    back = spoken_for(effects.NonlinearFeedbackOfOutput(), 1e-3, 1e-2), (dgp.NonlinearFeedback(1),)
    added = spoken_for(effect, q, q), (MODEL,)
    judged = helping(effect, q, q, gain)
    fitted = replace(judged.tried, errors=np.full((100, 1), error), fit=NOISE)
    calls = []

    def judge_all(candidates: list[Any]) -> list[Judged]:
        calls.append([found.effect.name for found, _ in candidates])
        return [replace(judged, found=f, tried=fitted) for f, _ in candidates if f is added[0]]

    refitting: Any = SimpleNamespace(
        model=MODEL,
        judge=judge_all,
        against_refit=lambda one: one,
        supported=lambda one: replace(one, helps=one.found.effect.name != "level shift"),
    )
    found = _judged(refitting, [back, added, curve], ())
    assert [one.found for one in found] == [added[0]]
    last = ["nonlinear feedback"] if needed else []
    assert calls == [[effect.name, "output nonlinearity"], last]
    # So it is with what was judged before, and all others are tried, whatever is there.
    calls.clear()
    _judged(refitting, [back, curve], found)
    assert calls == [["output nonlinearity"], last]
    assert _is_needless(refitting, back, found) is not needed


def judged_noise(gains: np.ndarray, errors: np.ndarray, before: np.ndarray) -> Judged:
    """A candidate for the noise with gains (N,), and errors of forecasts before and after."""
    found = spoken_for(effects.HeavyTails(), 1e-9, 1e-8)
    base = tried(0.0 * gains, errors=before[:, None])
    return judge(
        found, ("after", "one step"), tried(gains, errors=errors[:, None]), base, 1, SETTINGS
    )


def test_noise_that_costs_the_forecasts_does_not_help() -> None:
    before, gains = 3.0 * np.resize([1.0, -1.0], 100), np.ones(100)
    assert judged_noise(gains, before, before).helps
    bad = judged_noise(gains, 1.5 * before, before)
    assert not bad.helps
    assert "forecasts worse by 50.0 +- 0.0" in bad.attempt.reason
    assert judged_noise(gains, 1.04 * before, before).helps  # certain, and of no matter
    assert not judged_noise(gains, 1.06 * before, before).helps
    wild = before.copy()
    wild[17] = 1e3  # of the noise, before and after
    assert judged_noise(gains, wild, wild).helps
    missing = np.where(np.arange(100) % 3 == 0, np.nan, 1.5 * before)
    assert not judged_noise(gains, missing, missing / 1.5).helps


def test_structure_that_costs_the_forecasts_does_not_help() -> None:
    """Densities of forecasts may rise, as where their sds grow, and errors all the same."""
    found = spoken_for(effects.Drift(), 1e-9, 1e-8)
    before = 3.0 * np.resize([1.0, -1.0], 100)[:, None]
    base = tried(np.zeros(100), errors=before)
    for ratio, helps in ((0.5, True), (1.04, True), (1.06, False), (3.0, False)):
        more = tried(np.ones(100), errors=ratio * before)
        judged = judge(found, ("after", "forecast"), more, base, 1, SETTINGS)
        assert judged.helps is helps
        assert ("forecasts worse by" in judged.attempt.reason) is not helps


@pytest.mark.parametrize(
    ("gain", "error", "wanted"),
    [
        (14.9, 10.0, 0),
        (15.1, 10.0, 180),  # 100 (20 / 15.1)^2 = 175.4
        (19.9, 10.0, 110),  # 101.01
        (20.1, 10.0, 0),  # enough
        (1.6, 1.0, 250),  # by the least gain: 100 * 4 / 1.6, and by its error 156
        (-15.1, 10.0, 0),
        (0.0, 0.0, 0),
        (0.41, 0.25, 980),
        (0.39, 0.25, 0),  # more than ten times as many: 100 * 4 / 0.39
    ],
)
def test_how_many_samples_would_settle_a_gain_that_is_nearly_enough(gain, error, wanted) -> None:
    assert enough_samples(gain, error, 100, SETTINGS) == wanted


def test_what_nearly_helps_is_called_so_and_not_added() -> None:
    gains = np.random.default_rng(0).standard_normal(400)
    error = block_standard_error(gains)[0]
    same = np.ones(400)
    for share, decision in ((1.4, "rejected"), (1.7, "nearly"), (2.3, "rejected")):
        shifted = gains - gains.mean() + share * error / 400
        found = judged_noise(shifted, same, same)
        assert found.helps is (share > 2.0)
        assert found.attempt.decision == decision  # what helps is decided among all that does
        # 400 (2 / 1.7)^2 = 553.6
        assert ("about 560 samples like these 400" in found.attempt.reason) is (share == 1.7)
    worse = judged_noise(gains - gains.mean() + 1.7 * error / 400, 1.5 * same, same)
    assert worse.attempt.decision == "rejected"


@pytest.mark.parametrize(
    ("p", "share", "helps"),
    [(0.009, 2.3, True), (0.011, 2.3, False), (0.011, 3.1, True), (0.011, 2.9, False)],
)
def test_what_the_residual_hardly_speaks_for_has_to_gain_more(p, share, helps) -> None:
    gains = np.random.default_rng(0).standard_normal(400)
    shifted = gains - gains.mean() + share * block_standard_error(gains)[0] / 400
    found = spoken_for(effects.Drift(), p, 1.0)
    judged = judge(found, ("after", "forecast"), tried(shifted), tried(0.0 * gains), 1, SETTINGS)
    assert judged.helps is helps
    assert (judged.attempt.decision == "nearly") is not helps
    strict = replace(SETTINGS, standard_errors=4.0)  # never fewer than of any other effect
    again = judge(found, ("after", "forecast"), tried(shifted), tried(0.0 * gains), 1, strict)
    assert not again.helps


def test_one_outlier_does_not_hide_what_all_samples_gain() -> None:
    same = np.ones(300)
    gains = 0.3 + np.resize([0.4, -0.4], 300)
    gains[100] = 400.0
    found = judged_noise(gains, same, same)
    assert found.helps
    assert found.attempt.gain < 2.0 * found.attempt.gain_error
    assert "+99.3 with no sample counted for more than 10" in found.attempt.reason
    assert not judged_noise(gains - 0.4, same, same).helps


@pytest.mark.parametrize("freedom", [2.5, 5.0, 1e3])
def test_gains_of_nothing_seldom_count(freedom: float) -> None:
    draws, same = np.random.default_rng(1).standard_t(freedom, (1000, 300)), np.ones(300)
    count = sum(judged_noise(gains, same, same).helps for gains in draws)
    # Two standard errors are 2.3 % of normal sums; more where they are estimated from 300 samples.
    assert binom.sf(count - 1, 1000, 0.04) > 1e-3


def test_a_line_of_a_day_is_named_after_the_calendar() -> None:
    """Where there are time stamps, and both explain the same."""
    plain = machine(seed=3)
    stamps = pd.date_range("2021-01-04", periods=len(plain), freq="h", tz="UTC")
    y = plain.outputs[:, 0] + 0.3 * np.cos(2.0 * np.pi * np.arange(len(plain)) / 24.0)
    record = dgp.Record(stamps, plain.inputs, y)
    looked_for = (effects.PeriodicDisturbance(), effects.CalendarEffect())
    report = dgp.close_loop(
        fitted(record), record, effects=looked_for, max_rounds=1, workers=1, progress=False
    )
    (effect,) = report.effects
    assert effect.name == "calendar"
    assert effect.ties in ((), ("periodic disturbance",))
    assert report.after["rmse"] < 0.06


@pytest.mark.parametrize("instant", [150, 300])
def test_a_step_is_added_wherever_it_is(instant: int) -> None:
    """Beside a drift, which is scored on other samples, and is worse on the same."""
    record = machine(seed=3)
    y = record.outputs[:, 0] + 0.3 * (np.arange(len(record)) >= instant)
    record = record.with_outputs(y)
    looked_for = (effects.LevelShift(), effects.Drift())
    report = dgp.close_loop(
        fitted(record), record, effects=looked_for, max_rounds=1, workers=1, progress=False
    )
    assert [one.name for one in report.effects] == ["level shift"]
    assert report.after["rmse"] < 0.06
    mean, sd = next(iter(report.effects[0].parameters.values()))
    assert mean == pytest.approx(0.3, abs=4.0 * sd + 0.01)


@pytest.mark.parametrize("bends", [False, True])
def test_a_drift_goes_on_as_held_out_data_say(bends: bool) -> None:
    record = machine()
    t = np.linspace(0.0, 1.0, len(record))
    shape = 1.0 - np.exp(-t / 0.3) if bends else t
    record = record.with_outputs(record.outputs + shape[:, None])
    report = dgp.close_loop(
        fitted(record), record, effects=(effects.Drift(),), max_rounds=1, workers=1, progress=False
    )
    assert [one.name for one in report.effects] == ["drift"]
    model = report.fit.model
    assert (model.layers[0].pairs == 2) is bends  # a random path
    assert bool(model.channels) is not bends  # a line
    # The noise's own is 0.05. What is left of the bend is small; a line would go on to 0.26.
    assert report.after["rmse"] < (0.1 if bends else 0.06)
    assert report.before["rmse"] > 3.0 * report.after["rmse"]


def test_the_fit_of_the_winner_is_handed_on() -> None:
    record = machine(weight=0.3)
    fit = fitted(record)
    held_out = np.arange(360) >= 240
    where = {"channel": "heat", "form": "linear", "delay": 0.0}
    found = spoken_for(effects.ExtraInput(), 1e-9, 1e-8, **where)
    model = replace(fit.model, scaling=None)
    variants = tuple(found.effect.extend(model, found.evidence, record))
    done = confirm(
        [(found, variants)], fit, record[:360], held_out,
        number=1, seed=0, level=0.05, settings=SETTINGS, workers=1,
    )  # fmt: skip
    assert done.winner is found
    assert done.fit is not None
    assert done.fit.model.inputs == 2
    assert len(done.fit.records[0]) == 240  # to what is not held out


@pytest.mark.parametrize(
    ("q", "helps", "pairs", "accepted"),
    [
        (1e-8, False, True, "extra input"),  # before noise is tried
        (1e-8, True, False, "extra input"),
        (0.5, True, True, "heavy tails"),  # what helps by luck does not keep pairs from it
    ],
)
def test_pairs_are_tried_where_no_structure_is_certain(
    monkeypatch: pytest.MonkeyPatch, q: float, helps: bool, pairs: bool, accepted: str
) -> None:
    one = helping(effects.ExtraInput(), 1e-4, q)
    noise = helping(effects.HeavyTails(), 1e-4, 1e-4)
    judged = [replace(one, helps=helps)]
    asked: list[Any] = []

    class Refits:
        early, model = False, MODEL

        def __init__(self, *given: Any) -> None:
            del given

        def judge(self, candidates: Any) -> Any:
            tried = [found for found, _ in candidates]
            return [
                *(judged if one.found in tried else []),
                *([noise] if noise.found in tried else []),
            ]

        def settled(self, judged: Any, level: float) -> Any:
            return judged

        by_evidence = settled

        def on_one_scale(self, better: Any) -> Any:
            return better

        def against_refit(self, winner: Any) -> Any:
            return winner

        supported = against_refit

        def with_substeps(self, winner: Any) -> Any:
            return winner.tried

    def together(refits: Any, judged: Any, level: float) -> Any:
        asked.append(judged)
        return replace(judged[0], helps=True)

    monkeypatch.setattr("pyro_dynogp.discrepancy.decision.Refits", Refits)
    monkeypatch.setattr("pyro_dynogp.discrepancy.decision.confirmed_together", together)
    given: Any = (None, None, np.zeros(0))
    done = confirm(
        [(one.found, ()), (noise.found, ())], *given, number=1, seed=0, level=0.05,
        settings=SETTINGS,
    )  # fmt: skip
    assert bool(asked) is pairs
    assert done.attempt is not None
    assert done.attempt.name == accepted
    tried = {attempt.name: attempt.decision for attempt in done.attempts}
    assert (tried["heavy tails"] == "not tried") is (q <= 0.05)


@pytest.mark.parametrize(("q", "decision"), [(1e-8, "not tried"), (0.5, "rejected")])
def test_noise_is_tried_where_no_structure_is_certain(q: float, decision: str) -> None:
    record = machine(weight=0.3)
    fit = fitted(record)
    where = {"channel": "heat", "form": "linear", "delay": 0.0}
    both = [
        spoken_for(effects.HeavyTails(), 0.01, 0.5, degrees_of_freedom=6.0),
        spoken_for(effects.ExtraInput(), 1e-9, q, **where),
    ]
    model = replace(fit.model, scaling=None)
    tasks = [(one, tuple(one.effect.extend(model, one.evidence, record))) for one in both]
    held_out = np.arange(360) >= 240
    done = confirm(
        tasks,
        fit,
        record[:360],
        held_out,
        number=1,
        seed=0,
        level=0.05,
        settings=SETTINGS,
        workers=1,
    )
    assert done.winner is both[1]
    decisions = {one.evidence.effect: one.decision for one in done.attempts}
    assert decisions == {"extra input": "accepted", "heavy tails": decision}


def two_inputs() -> dgp.Record:
    rng = np.random.default_rng(0)
    u = rng.standard_normal((300, 2))
    return dgp.Record(np.arange(300) * 3600.0, u, u[:, :1], start="2023-03-01T00:00:00+01:00",
                      time_unit="s", input_names=("a", "b"))  # fmt: skip


def test_inputs_are_delayed_alone_and_together() -> None:
    record, model = two_inputs(), dgp.LinearDynamicGP(inputs=2, pairs=1)
    found = spoken_for(effects.DeadTime(), 0.01, 0.1, channel="a", delay=7200.0)
    variants = effects.DeadTime().extend(model, found.evidence, record)
    sets = {tuple(c.channel for c in one.channels) for one in variants}
    assert sets == {("a",), ("b",), ("a", "b")}
    together = [one for one in variants if len(one.channels) == 2]
    assert all(a.delay == b.delay for a, b in (one.channels for one in together))
    finer = effects.DeadTime().refine(together[0], record, 0)
    assert {len({c.delay for c in one.channels}) for one in finer} == {1}
    assert "Channels 'a' and 'b' act" in effects.DeadTime().sentence(found.evidence, together[0])
    again = effects.DeadTime().extend(together[0], found.evidence, record)
    assert all(isinstance(c, Delayed) for one in again for c in one.channels)
    assert all(len({c.channel for c in one.channels}) == len(one.channels) for one in again)


def test_a_clock_may_be_wrong_for_all_inputs() -> None:
    record, model = two_inputs(), dgp.LinearDynamicGP(inputs=2, pairs=1)
    found = spoken_for(effects.ClockShift(), 0.01, 0.1, channel="a", shift=3600.0, time=360000.0)
    alone, together = effects.ClockShift().extend(model, found.evidence, record)
    assert [c.channel for c in alone.channels] == ["a"]
    assert [c.channel for c in together.channels] == ["a", "b"]
    assert all(isinstance(c, ShiftedClock) for c in together.channels)


@pytest.mark.parametrize(("season", "off"), [("summers", [1, 0, 1, 0]), ("winters", [0, 1, 0, 1])])
def test_a_clock_is_corrected_season_by_season(season: str, off: list[int]) -> None:
    days = 700
    start = pd.Timestamp("2023-06-01", tz="UTC")  # Berlin's summers end in October, begin in March
    value = np.arange(float(days))
    record = dgp.Record(
        86400.0 * value, value, value, start=start, input_names=("a",), time_unit="s"
    )
    model = dgp.LinearDynamicGP(inputs=1, pairs=1)
    where = {"channel": "a", "shift": 86400.0, "time": 0.0, "rule": "Europe/Berlin"}
    found = spoken_for(effects.ClockShift(), 0.01, 0.1, season=season, **where)
    (one,) = effects.ClockShift().extend(model, found.evidence, record)
    read = one.check(record)[0].inputs[:, 0] - value
    middles = [30, 200, 400, 570]  # July, December, July, December
    assert read[middles].tolist() == off


def test_a_calendar_moves_to_another_clock_instead_of_being_there_twice() -> None:
    record = two_inputs()
    there = Calendar("hour of day by weekend", "UTC", 4)
    count = len(there.names)
    model = dgp.LinearDynamicGP(inputs=2 + count, direct=count, channels=(there,), pairs=1)
    what = "hour of day by weekday/weekend"
    found = spoken_for(effects.CalendarEffect(), 0.01, 0.1, what=what, zone="Australia/Melbourne")
    variants = effects.CalendarEffect().extend(model, found.evidence, record)
    assert [[(c.what, c.zone, c.harmonics) for c in one.channels] for one in variants] == [
        [("hour of day by weekend", "Australia/Melbourne", 6)],
        [("hour of day by weekend", "Australia/Melbourne", 4)],
    ]
    assert all(one.inputs - one.direct == 2 for one in variants)
    assert [one.check(record)[0].n_inputs for one in variants] == [v.inputs for v in variants]
    same = spoken_for(effects.CalendarEffect(), 0.01, 0.1, what=what, zone="UTC")
    (finer,) = effects.CalendarEffect().extend(model, same.evidence, record)
    assert [c.harmonics for c in finer.channels] == [8]
    (every_three_hours,) = effects.CalendarEffect().extend(model, same.evidence, record[::3])
    assert [c.harmonics for c in every_three_hours.channels] == [4]


def test_feedback_is_among_the_effects_and_changes_nothing() -> None:
    class Certain(effects.Feedback):
        def detect(self, residuals: Any, settings: LoopSettings, seed: int = 0) -> list[Evidence]:
            return [spoken_for(self, 1e-9, 1e-9, channel="u").evidence]

    record = machine(seed=5)
    report = dgp.close_loop(
        fitted(record), record, effects=(Certain(),), max_rounds=1, workers=1, progress=False
    )
    assert [one.name for one in report.effects] == ["feedback"]
    assert report.before == report.after
    assert "feedback" in str(report)


@pytest.mark.parametrize("over", [False, True])
def test_substeps_are_tried_of_the_winner_alone(
    monkeypatch: pytest.MonkeyPatch, over: bool
) -> None:
    """The rounds to come have what that comes to. Where time is over it is not tried."""
    record = machine(weight=0.3)
    fit = fitted(record)
    both = [
        spoken_for(effects.ExtraInput(), p, 10.0 * p, channel=name, form="linear", delay=0.0)
        for name, p in (("wind", 0.01), ("heat", 1e-9))
    ]
    plain = replace(fit.model, scaling=None)
    tasks = [(one, tuple(one.effect.extend(plain, one.evidence, record))) for one in both]
    divided = Tried(replace(plain), np.zeros(1), 1.0, fit=fit)
    asked: list[Any] = []

    def with_substeps(trial: Any, one: Tried) -> Tried:
        assert trial.models == (one.model,)
        assert trial.folds[0].sum() == 120
        asked.append(one.model)
        return divided

    monkeypatch.setattr(refits, "with_substeps", with_substeps)
    looks = iter([False, False, True])  # what is certain, its relative, and substeps
    done = confirm(
        tasks, fit, record[:360], np.arange(360) >= 240, number=1, seed=0, level=0.05,
        settings=SETTINGS, workers=4, late=(lambda: next(looks)) if over else None,
    )  # fmt: skip
    assert done.winner is both[1]
    assert len(asked) == (0 if over else 1)
    assert (done.model is divided.model) is not over
    assert (done.fit is fit) is not over
