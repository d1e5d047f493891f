"""What is wrong in the block that is searched, because parameters were badly known before it."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.signal import lfilter

import pyro_dynogp as dgp
from pyro_dynogp import effects
from pyro_dynogp.data.channels import Step
from pyro_dynogp.discrepancy import refits as module
from pyro_dynogp.discrepancy.blocks import blocks_of
from pyro_dynogp.discrepancy.context import Left, SearchContext
from pyro_dynogp.discrepancy.judged import SPREAD, Judged
from pyro_dynogp.discrepancy.refits import Refits
from pyro_dynogp.discrepancy.result import Attempt
from pyro_dynogp.discrepancy.state import SearchState
from pyro_dynogp.discrepancy.trials import Tried
from pyro_dynogp.inference.bayes_factor import VERY_STRONG
from pyro_dynogp.inference.refit import refit
from pyro_dynogp.models.variants import with_channel
from tests.discrepancy.made import SETTINGS
from tests.discrepancy.test_decision import spoken_for

N, FITTED = 600, 300
EFFECTS = (effects.ProcessNoise(), effects.Drift(), effects.HeavyTails())
SHIFT = effects.LevelShift()


def late_input(disturbance: float, *, step: float = 0.0) -> dgp.Record:
    """A plant whose second input, of a slow path of its own, hardly moves before sample FITTED.

    Args:
        disturbance: size of coloured noise, in standard deviations of the white one.
        step: of the level, in the middle of what follows, in the same.
    """
    rng = np.random.default_rng(0)
    u = np.repeat(rng.standard_normal((N // 10, 2)), 10, axis=0)
    u[:FITTED, 1] *= 0.003
    y = lfilter([0.0, 0.2], [1.0, -0.8], u[:, 0]) + lfilter([0.0, 0.05], [1.0, -0.95], u[:, 1])
    sd = 0.05 * y.std()
    slow = lfilter([1.0], [1.0, -0.8], rng.standard_normal(N))
    y += sd * (rng.standard_normal(N) + disturbance * slow)
    y += sd * step * (np.arange(N) >= FITTED + 75)
    return dgp.Record(0.5 * np.arange(N), u, y)


def searched(record: dgp.Record) -> tuple[SearchContext, dgp.Fit]:
    """The first round of a loop, and the fit of block A that it begins with."""
    model = dgp.LinearDynamicGP(2, pairs=2, process_noise=False)
    fit = dgp.fit(model, record[:FITTED], method="map", restarts=1, workers=1, progress=False)
    data = blocks_of(fit, record, None, SETTINGS)
    return SearchContext(data, [], 0, 0.05, 8, EFFECTS, 1, False, SETTINGS), fit


@pytest.mark.parametrize(("disturbance", "explained"), [(0.0, True), (0.9, False)])
def test_what_a_fit_to_all_known_data_explains_is_not_left(
    disturbance: float, explained: bool
) -> None:
    """In both cases tests of the block held out reject; where noise is coloured they are right."""
    rounds, fit = searched(late_input(disturbance))
    assert rounds.left(rounds.look(fit, ())).said
    assert rounds.explained(fit, ()) is explained
    assert rounds.held_out.sum() == 150  # that of the rounds is as before


@pytest.mark.parametrize(
    ("reported", "explained", "curved"),
    [([], True, False), ([], False, False), (["feedback"], True, False), ([], True, True)],
)
def test_what_is_explained_is_taken_back_and_said(
    reported: list[str], explained: bool, curved: bool
) -> None:
    """But where feedback is reported, which no fit mends, and of models with functions."""
    rounds: Any = type("Rounds", (), {})()
    rounds.effects, rounds.explained = EFFECTS, lambda fit, known: explained
    watch: Any = type("Watch", (), {"stop": lambda self, stage: None})()
    course: Any = SearchState.__new__(SearchState)
    course.rounds, course.watch, course.added, course.quiet = rounds, watch, [], False
    course.reported, course.notes, course.plain = reported, [], None
    course.current = SimpleNamespace(model=SimpleNamespace(has_function=curved))
    course.rest, course.left_without = Left(("this",), (0.01,)), ("that",)
    course.explain()
    taken = explained and not reported and not curved
    assert course.rest == Left(() if taken else ("this",), (0.01,))
    assert course.left_without == (() if taken else ("that",))
    assert [note.split()[0] for note in course.notes] == (["this", "that"] if taken else [])


def candidate(record: dgp.Record, effect: effects.Effect) -> tuple[Refits, Judged]:
    """A step of the level in block B that helps there, and the refits of its round."""
    rounds, fit = searched(record)
    known, held_out = rounds.data.known, rounds.held_out
    scored = Refits(fit, known, held_out, 1, 0, SETTINGS, 1, False)
    model = with_channel(scored.model, Step(float(known.time[FITTED + 75])))
    extended = refit(fit, known, model=model)
    found = spoken_for(effect, 1e-9, 1e-8)
    attempt = Attempt(1, found.evidence, found.q_value, "rejected", "held-out elpd +50")
    trial = Tried(model, np.ones(len(known)), 0.0, fit=extended)
    return scored, Judged(found, SPREAD, trial, attempt, helps=True)


@pytest.mark.parametrize(("step", "helps"), [(0.0, False), (3.0, True)])
def test_a_step_that_all_known_data_do_not_speak_for_is_not_added(step: float, helps: bool) -> None:
    scored, one = candidate(late_input(0.0, step=step), SHIFT)
    fair = scored.supported(one)
    assert fair.helps is helps
    assert (fair is one) is helps
    assert ("fitted to all known data, the evidence" in fair.attempt.reason) is not helps


@pytest.mark.parametrize(
    ("effect", "gain", "helps"),
    [
        (SHIFT, VERY_STRONG - 0.1, False),
        (SHIFT, VERY_STRONG + 0.1, True),
        (effects.HeavyTails(), VERY_STRONG - 0.1, False),
        (effects.ExtraInput(), VERY_STRONG - 0.1, True),  # found in all known data already
    ],
)
def test_evidence_has_to_be_very_strong(
    monkeypatch: pytest.MonkeyPatch, effect: effects.Effect, gain: float, helps: bool
) -> None:
    scored, one = candidate(late_input(0.0), effect)
    monkeypatch.setattr(module, "log_evidence_of", lambda fit: gain * len(fit.model.channels))
    assert scored.supported(one).helps is helps
    scored.weighed = True  # where no test is certain, evidence has to be very strong for all
    assert scored.supported(one).helps is (gain > VERY_STRONG)
    unfitted = replace(one, tried=replace(one.tried, fit=None))
    assert scored.supported(unfitted) is unfitted
    loser = replace(one, helps=False)
    assert scored.supported(loser) is loser


def test_what_cannot_be_fitted_to_all_known_data_is_not_added(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    scored, one = candidate(late_input(0.0), SHIFT)

    def refused(*_: Any, **__: Any) -> None:
        raise ValueError("no")

    monkeypatch.setattr(module, "refit", refused)
    fair = scored.supported(one)
    assert not fair.helps
    assert fair.attempt.reason == "held-out elpd +50; could not be fitted to all known data"


def test_every_model_is_fitted_to_all_known_data_once(monkeypatch: pytest.MonkeyPatch) -> None:
    scored, one = candidate(late_input(0.0, step=3.0), SHIFT)
    fitted = []

    def counting(*given: Any, **options: Any) -> Any:
        fitted.append(options["model"])
        return refit(*given, **options)

    monkeypatch.setattr(module, "refit", counting)
    assert scored.supported(one).helps
    assert scored.supported(one).helps
    assert fitted == [scored.model, one.tried.model]
