"""A search with a time limit: what is begun, what is kept, and what is said. The clock is made."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from pyro_dynogp import effects
from pyro_dynogp.discrepancy import context, decision, refits
from pyro_dynogp.discrepancy.context import Stopwatch
from tests.discrepancy.test_decision import spoken_for, tried
from tests.discrepancy.test_loop import FEW, close, fitted, machine


class Clock:
    """Seconds that pass when they are told to."""

    def __init__(self) -> None:
        self.now = 0.0

    def perf_counter(self) -> float:
        return self.now


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    made = Clock()
    monkeypatch.setattr(context, "time", made)
    return made


@pytest.fixture(scope="module")
def planted() -> Any:
    record = machine(weight=0.3)
    return fitted(record), record


def passing(monkeypatch: Any, clock: Clock, owner: Any, name: str, seconds: float) -> None:
    """Let the clock go on whenever a function is called."""
    function = getattr(owner, name)

    def call(*given: Any, **options: Any) -> Any:
        clock.now += seconds
        return function(*given, **options)

    monkeypatch.setattr(owner, name, call)


def test_the_limit_has_passed_once_more_time_has(clock: Clock) -> None:
    free, watch = Stopwatch(), Stopwatch(10.0)
    clock.now = 10.0
    assert not watch.late()
    clock.now = 10.1
    assert watch.late()
    assert not free.late()


def test_a_search_that_ends_before_its_first_round_claims_nothing(
    clock: Clock, monkeypatch: pytest.MonkeyPatch, planted: Any
) -> None:
    passing(monkeypatch, clock, context, "refit", 100.0)
    report = close(*planted, time_limit=60.0)
    assert report.outcome == "search ended early"
    assert report.effects == ()
    assert report.tests == ()
    (said,) = (one for one in report.warnings if "ended early" in one)
    assert "the time limit of 60 s was passed before the first round" in said
    assert report.before["rmse"] > 0.0  # the report is whole


def test_a_round_that_is_cut_short_adds_nothing(
    clock: Clock, monkeypatch: pytest.MonkeyPatch, planted: Any
) -> None:
    """Of what the residual is certain of, the first candidate alone is refitted in time."""
    passing(monkeypatch, clock, refits, "run", 40.0)
    fit, record = planted
    report = close(fit, record, effects=(*FEW, effects.Drift()), time_limit=70.0, level=0.9)
    assert report.effects == ()
    assert report.outcome == "search ended early"
    assert report.fit is report.base
    heat = next(one for one in report.attempts if one.channel == "heat")
    assert heat.decision == "undecided"
    assert heat.gain > 0.0
    assert heat.reason.endswith("the time limit was passed")
    late = [one.name for one in report.attempts if one.reason == "the time limit was passed"]
    assert late
    (said,) = (one for one in report.warnings if "ended early" in one)
    assert "in round 1, which added nothing" in said
    assert all(name in said.partition("Not refitted: ")[2] for name in late)
    assert "Not decided: extra input." in said
    assert [one.decision for one in report.tests if one.place == "heat"] == ["undecided"]


def test_what_was_accepted_in_time_is_in_the_report(
    clock: Clock, monkeypatch: pytest.MonkeyPatch, planted: Any
) -> None:
    passing(monkeypatch, clock, context.SearchContext, "hold_out_less", 100.0)  # once it is named
    report = close(*planted, time_limit=60.0, max_rounds=4)
    assert [one.name for one in report.effects] == ["extra input"]
    assert report.outcome == "effects added, search ended early"
    assert report.fit.model.inputs == 2
    assert report.left == ()
    (said,) = (one for one in report.warnings if "ended early" in one)
    assert "after round 1. What the model leaves since then was not tested." in said


def test_a_limit_that_is_not_reached_changes_nothing(planted: Any) -> None:
    free, limited = close(*planted), close(*planted, time_limit=1e6)
    plain, other = free.to_dict(), limited.to_dict()
    for one in (plain, other):
        one.pop("seconds")
        for attempt in one["attempts"]:
            attempt.pop("seconds")
    np.testing.assert_equal(other, plain)


def test_with_a_limit_refits_begin_as_many_at_a_time_as_there_are_workers(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Long ones come last, and have all of them to themselves."""
    batches: list[tuple[str, ...]] = []

    def several(function: Any, items: Any, **options: Any) -> list[Any]:
        batches.append(tuple(item.name for item in items))
        return [item.name if options["workers"] == 2 else function(item) for item in items]

    monkeypatch.setattr(refits, "parallel_map", several)
    monkeypatch.setattr(
        refits, "run", lambda trial, ahead: f"{trial.name}, {ahead.workers} at a time"
    )
    tasks: dict[str, Any] = {
        name: SimpleNamespace(name=name, is_long=name in "bf") for name in "abcdefg"
    }

    def run(answers: list[bool] | None) -> tuple[Any, Any]:
        late = None if answers is None else iter(answers).__next__
        one = SimpleNamespace(number=1, workers=2, progress=False, late=late, early=False)
        # A stand-in has all that the method asks for, and is no `Refits`.
        return one, refits.Refits.run(one, tasks, "refits")  # type: ignore[arg-type]

    one, done = run([False, False, True])
    assert batches == [("a", "c"), ("d", "e")]
    assert list(done) == ["a", "c", "d", "e"]
    assert one.early
    one, done = run([False, False, False, False, True])
    assert batches[2:] == [("a", "c"), ("d", "e"), ("g",), ("b",)]
    assert list(done) == ["a", "b", "c", "d", "e", "g"]
    assert done["b"] == "b, 2 at a time"
    assert one.early
    one, done = run(None)
    assert batches[6:] == [("a", "c", "d", "e", "g"), ("b",), ("f",)]
    assert list(done) == list(tasks)
    assert not one.early


def test_a_comparison_on_one_scale_that_is_cut_short_decides_nothing() -> None:
    """A step and a channel both help, but on different samples."""
    gains = np.full(100, 0.5)
    judged = [
        refits.judge(found, refits.kind_of(found), tried(gains), tried(0.0 * gains), 1,
                     context.LoopSettings())
        for found in (spoken_for(effects.LevelShift(), 1e-9, 1e-8),
                      spoken_for(effects.ExtraInput(), 1e-9, 1e-8))
    ]  # fmt: skip
    assert all(one.helps for one in judged)
    candidates: Any = [(one.found, ()) for one in judged]
    found = decision._cut_short(candidates, judged, SimpleNamespace(number=1, model=None))  # type: ignore[arg-type]
    assert found.early
    assert found.winner is None
    assert [one.decision for one in found.attempts] == ["undecided", "undecided"]


def test_a_trial_that_the_limit_ends_has_no_result(monkeypatch: pytest.MonkeyPatch) -> None:
    """It is passed on to what compares variants, which asks before each."""
    asked: list[str] = []

    def ended(trial: Any, ahead: Any) -> Any:
        asked.append(trial.name)
        if trial.name == "b":
            raise refits.TimeLimitError
        assert not ahead.late()
        return trial.name

    monkeypatch.setattr(refits, "run", ended)
    tasks: dict[str, Any] = {name: SimpleNamespace(name=name, is_long=True) for name in "abc"}
    one = SimpleNamespace(number=1, workers=1, progress=False, late=lambda: False, early=False)
    # A stand-in has all that the method asks for, and is no `Refits`.
    assert refits.Refits.run(one, tasks, "refits") == {"a": "a"}  # type: ignore[arg-type]
    assert asked == ["a", "b"]
    assert one.early
