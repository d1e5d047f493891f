"""Forecasts that miss by far more than the noise open a search that tests would not."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import pyro_dynogp as dgp
from pyro_dynogp import effects
from pyro_dynogp.data.channels import Step
from pyro_dynogp.discrepancy import forecast_misses as module
from pyro_dynogp.discrepancy import state
from pyro_dynogp.discrepancy.context import Left, Tested
from pyro_dynogp.discrepancy.forecast_misses import forecast_misses
from pyro_dynogp.discrepancy.held_out import LITTLE_ELSE
from pyro_dynogp.discrepancy.search_notes import said_of_misses
from pyro_dynogp.discrepancy.state import SearchState
from pyro_dynogp.models.variants import without_process_noise
from tests.discrepancy.made import SETTINGS
from tests.discrepancy.test_decision import spoken_for

MODEL = dgp.LinearDynamicGP(1, pairs=1)


def missed(
    monkeypatch: pytest.MonkeyPatch,
    times: float,
    varies: bool = False,
    held_out: bool = True,
    inputs: int = 1,
    channels: tuple[Any, ...] = (),
) -> str:
    """Of two outputs with noise 0.5; errors of the second are so many times as large."""
    errors = 0.5 * np.column_stack([np.ones(20), times * np.ones(20)])
    errors[15, 1] = np.nan
    monkeypatch.setattr(module, "forecast_errors", lambda *given: (errors, errors))
    sd = None if varies else np.full(2, 0.5)
    noise = SimpleNamespace(constant_sd=sd)
    seen = SimpleNamespace(n_inputs=inputs)
    model = SimpleNamespace(check=lambda record: (seen,), channels=channels)
    fit: Any = SimpleNamespace(noise_sd=sd, system=SimpleNamespace(noise=noise), model=model)
    record: Any = SimpleNamespace(output_names=("a", "b"))
    there = np.zeros(20, dtype=bool)
    there[10:] = held_out
    return forecast_misses(fit, record, there)


def test_errors_far_beyond_the_noise_are_said(monkeypatch: pytest.MonkeyPatch) -> None:
    assert missed(monkeypatch, LITTLE_ELSE - 0.01) == ""
    said = missed(monkeypatch, LITTLE_ELSE + 0.1)
    assert said == (
        "Forecasts of the block that was searched miss by far more than the noise ('b' 0.8 for "
        "0.5)."
    )
    assert "('b' inf for 0.5)" in missed(monkeypatch, np.inf)
    assert "('b' inf for 0.5)" in missed(monkeypatch, 1e200)


@pytest.mark.parametrize(
    "where", [{"varies": True}, {"held_out": False}, {"channels": (Step(3.0),)}]
)
def test_nothing_is_said_where_forecasts_are_not_measured_by_noise(
    monkeypatch: pytest.MonkeyPatch, where: dict[str, Any]
) -> None:
    assert missed(monkeypatch, 3.0) != ""
    assert missed(monkeypatch, 3.0, **where) == ""


@pytest.mark.parametrize(
    ("said", "miss", "asked", "weighed"),
    [
        ((), "", False, False),
        ((), "Forecasts miss.", True, True),
        (("Structure is left.",), "Forecasts miss.", True, False),
    ],
)
def test_what_tests_are_not_certain_of_is_refitted_where_forecasts_miss(
    monkeypatch: pytest.MonkeyPatch, said: tuple[str, ...], miss: str, asked: bool, weighed: bool
) -> None:
    """And there must be evidence for it in all known data."""
    found = spoken_for(effects.LevelShift(), 0.02, 0.4)
    given: list[Any] = []
    record = SimpleNamespace(output_names=("y",))

    def confirm(chosen: Any, current: Any, number: int, weighed: bool) -> None:
        given.append(([one.effect.name for one, _ in chosen], weighed))

    rounds: Any = SimpleNamespace(
        look=lambda *_: Tested([], [], [found], []), left=lambda looked: Left(said),
        data=SimpleNamespace(known=record), held_out=np.ones(3, dtype=bool), level=0.05, gate=0.025,
        effects=(), tries=8, settings=SETTINGS, confirm=confirm, plain=lambda fit: fit,
        hiding=lambda *_: "",
    )  # fmt: skip
    model: Any = MODEL
    monkeypatch.setattr(state, "spikes_of", lambda *_: [])
    monkeypatch.setattr(state, "forecast_misses", lambda *_: miss)
    monkeypatch.setattr(state, "candidates_of", lambda some, *_: [(one, (model,)) for one in some])
    watch: Any = SimpleNamespace(stop=lambda stage: None)
    fit: Any = SimpleNamespace(model=MODEL)
    course = SearchState(rounds, watch, fit)
    assert not course.go_round()
    assert given == ([(["level shift"], weighed)] if asked else [])
    assert course.tests[0].decision == ("not tried" if asked else "not significant")
    assert course.misses == ("" if said else miss)


def test_forecasts_that_miss_are_a_note() -> None:
    course: Any = SimpleNamespace(misses="", current=SimpleNamespace(model=MODEL))
    assert said_of_misses(course) == []
    course.misses = "Forecasts miss."
    (noisy,) = said_of_misses(course)
    assert noisy == (
        "Forecasts miss. One step ahead the model takes it for process noise. No residual test is "
        "certain of an effect there, and none that was refitted helps for certain."
    )
    course.current.model = without_process_noise(MODEL)
    assert "process noise" not in said_of_misses(course)[0]
