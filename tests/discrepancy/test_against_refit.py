"""Next to functions an effect has to gain over the model without it, refitted from where it ended.

Refits climb along ridges, whatever is added.
"""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import pyro_dynogp as dgp
from pyro_dynogp import effects
from pyro_dynogp.discrepancy.decision import confirm
from pyro_dynogp.discrepancy.judged import Judged, kind_of
from pyro_dynogp.discrepancy.refits import Refits
from pyro_dynogp.discrepancy.trials import Tried
from tests.discrepancy.made import SETTINGS
from tests.discrepancy.test_decision import spoken_for
from tests.discrepancy.test_joint_refits import tried

LINEAR, CURVED = dgp.LinearDynamicGP(inputs=1, pairs=1), dgp.NonlinearFeedback(1, pairs=1)
INPUT, SHIFT = effects.ExtraInput(), effects.LevelShift()
WITH: Any = SimpleNamespace(model=CURVED, name="with the effect")


def refits(model: Any, without: Tried | None, kind: Any) -> Any:
    """Whose refit without the effect comes to what it is told; None for no time."""
    current: Any = SimpleNamespace(model=model)
    record: Any = range(480)
    one: Any = Refits(current, record, np.arange(480) >= 240, 1, 0, SETTINGS, 1, False)
    one.results["", kind] = tried(0.0, 1e-9)
    one.trials = []

    def run(tasks: dict[Any, Any], label: str) -> dict[Any, Tried]:
        one.trials += tasks.values()
        one.early = without is None
        return {} if without is None else dict.fromkeys(tasks, without)

    one.run = run
    return one


def candidate(scored: Any, effect: effects.Effect, gain: float) -> Judged:
    result = replace(tried(gain, 10.0), fit=WITH)
    judged: Judged = scored.judged(spoken_for(effect, 1e-5, 1e-4), scored_as(effect), result)
    return judged


def scored_as(effect: effects.Effect) -> Any:
    return kind_of(spoken_for(effect, 1e-5, 1e-4))


@pytest.mark.parametrize("effect", [INPUT, SHIFT])
@pytest.mark.parametrize(
    ("without", "helps", "gain"),
    [
        (85.0, False, 15.0),  # 100 +- 10 nats over the model as it was, of which 85 are the refit's
        (70.0, True, 30.0),
        (-50.0, True, 100.0),  # which ended lower: the model as it was is what has to be beaten
    ],
)
def test_what_a_refit_gains_without_the_effect_is_no_gain_of_it(
    effect: effects.Effect, without: float, helps: bool, gain: float
) -> None:
    scored = refits(CURVED, tried(without, 1e-9), scored_as(effect))
    one = candidate(scored, effect, 100.0)
    assert one.helps
    fair = scored.against_refit(one)
    assert fair.helps is helps
    assert fair.attempt.gain == pytest.approx(gain)
    assert ("over the model without it, refitted" in fair.attempt.reason) is (without > 0.0)
    assert "held-out elpd +100.0" in fair.attempt.reason
    (trial,) = scored.trials
    assert trial.models == (CURVED,)
    assert trial.base is WITH
    assert trial.refine is None
    assert len(trial.folds) == (2 if effect is SHIFT else 1)


def test_linear_models_have_no_ridges() -> None:
    scored = refits(LINEAR, tried(100.0, 1e-9), scored_as(INPUT))
    one = candidate(scored, INPUT, 100.0)
    assert scored.against_refit(one) is one
    assert not scored.trials


def test_what_is_confirmed_together_with_another_is_not_judged_alone() -> None:
    scored = refits(CURVED, tried(0.0, 1e-9), scored_as(INPUT))
    one = replace(candidate(scored, INPUT, -20.0), helps=True)
    assert scored.against_refit(one) is one
    assert not scored.trials


@pytest.mark.parametrize("without", [None, tried(0.0, failure="no")])
def test_without_that_refit_the_candidate_stays_as_it_was(without: Tried | None) -> None:
    scored = refits(CURVED, without, scored_as(INPUT))
    one = candidate(scored, INPUT, 100.0)
    assert scored.against_refit(one) is one


def test_numbers_that_were_kept_are_not_looked_for_again_on_other_blocks() -> None:
    scored = refits(CURVED, tried(5.0), scored_as(INPUT))
    one = candidate(scored, effects.DeadTime(), 100.0)
    scored.on_spread_blocks([one])
    assert [trial.models for trial in scored.trials] == [(one.tried.model,), (CURVED,)]
    assert all(trial.refine is None for trial in scored.trials)
    assert len(scored.trials[0].folds) == 2


@pytest.mark.parametrize(("own", "winner"), [(10.0, "extra input"), (40.0, "dead time")])
def test_the_next_in_line_is_added_where_the_first_gains_nothing(
    monkeypatch: pytest.MonkeyPatch, own: float, winner: str
) -> None:
    """`own`: nats that the dead time gains over the refitted model."""
    scored = refits(CURVED, None, scored_as(INPUT))
    first, second = candidate(scored, effects.DeadTime(), 100.0), candidate(scored, INPUT, 60.0)
    both = [first, second]

    def against(self: Any, one: Judged) -> Judged:
        gain = own if one is first else 50.0
        return replace(one, helps=gain > 20.0, attempt=replace(one.attempt, gain=gain))

    monkeypatch.setattr(Refits, "judge", lambda self, some: both if len(some) > 1 else [])
    monkeypatch.setattr(Refits, "settled", lambda self, judged, level: judged)
    monkeypatch.setattr(Refits, "against_refit", against)
    monkeypatch.setattr(Refits, "with_substeps", lambda self, one: one.tried)
    current: Any = SimpleNamespace(model=CURVED)
    given: Any = ([(one.found, (CURVED,)) for one in both], current, range(480),
                  np.arange(480) >= 240)  # fmt: skip
    done = confirm(*given, number=1, seed=0, level=0.05, settings=SETTINGS, workers=1)
    assert done.winner is not None
    assert done.winner.effect.name == winner
    decided = {one.name: one.decision for one in done.attempts}
    assert decided[winner] == "accepted"
    assert done.attempt is not None
    assert done.attempt.gain == (own if winner == "dead time" else 50.0)
