"""Gains that the last block leaves open are settled on blocks of the whole record."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, cast

import numpy as np
import pytest

import pyro_dynogp as dgp
from pyro_dynogp import effects
from pyro_dynogp.discrepancy import decision
from pyro_dynogp.discrepancy import refits as refits_of_a_round
from pyro_dynogp.discrepancy.decision import confirm
from pyro_dynogp.discrepancy.judged import SPREAD, Judged, judge, kind_of
from pyro_dynogp.discrepancy.refits import Refits
from pyro_dynogp.discrepancy.trials import Tried
from pyro_dynogp.inference.bayes_factor import VERY_STRONG
from tests.discrepancy.made import SETTINGS
from tests.discrepancy.test_decision import spoken_for
from tests.discrepancy.test_joint_refits import SAMPLES, tried

MODEL = dgp.LinearDynamicGP(inputs=1, pairs=1)
INPUT, DELAY, STEP = effects.ExtraInput(), effects.DeadTime(), effects.LevelShift()
# A gain of 3 standard errors on blocks of the whole record, one of 1, and none.
WELL, HARDLY, NOTHING = tried(60.0, 20.0), tried(20.0, 20.0), tried(0.0, failure="no")


class Scored(Refits):
    """Refits that come to what they are told on blocks of the whole record."""

    spread: Tried
    asked: list[str]
    late_then: bool = False

    def run(self, tasks: dict[Any, Any], label: str) -> dict[Any, Tried]:
        self.asked += [name for name, _ in tasks if name]
        self.early = self.late_then
        return {key: self.spread if key[0] else tried(0.0, 1e-9) for key in tasks}


def refits(spread: Tried) -> Scored:
    current: Any = type("Current", (), {"model": MODEL})
    record: Any = range(480)
    one = Scored(current, record, np.arange(480) >= 240, 1, 0, SETTINGS, 1, False)
    one.spread, one.asked = spread, []
    return one


def candidate(
    effect: effects.Effect, gain: float, error: float, *, q: float = 1e-4, worse: float = 1.0
) -> Judged:
    """With a gain on the last block, its error, and how much larger errors of forecasts are."""
    found = spoken_for(effect, q / 10.0, q)
    before = np.resize([1.0, -1.0], SAMPLES)[:, None]
    base = Tried(MODEL, np.zeros(SAMPLES), 0.0, errors=before)
    result = tried(gain, error)
    one = Tried(MODEL, result.densities, 0.0, errors=worse * before)
    return judge(found, kind_of(found), one, base, 1, SETTINGS)


@pytest.mark.parametrize(
    ("gain", "error", "q", "asked"),
    [
        (19.0, 10.0, 1e-4, True),  # nearly
        (1.0, 10.0, 1e-4, True),
        (-19.0, 10.0, 1e-4, True),
        (-30.0, 10.0, 1e-4, False),  # loses for certain
        (-19.0, 10.0, 0.0101, False),
        (30.0, 10.0, 1e-4, False),  # helps as it is
        (19.0, 10.0, 0.0099, True),
        (19.0, 10.0, 0.0101, False),  # the residual has its doubts
    ],
)
def test_what_the_last_block_leaves_open_is_scored_on_the_whole_record(
    gain: float, error: float, q: float, asked: bool
) -> None:
    one, scored = candidate(INPUT, gain, error, q=q), refits(WELL)
    (settled,) = scored.settled([one], 0.05)
    assert bool(scored.asked) is asked
    assert settled.helps is (asked or gain > 20.0)
    if asked:
        assert settled.kind == SPREAD
        assert one.attempt.reason in settled.attempt.reason
        assert "on blocks of the whole record held-out elpd +60.0" in settled.attempt.reason
    else:
        assert settled is one


def test_what_does_not_gain_there_either_stays_as_it_was() -> None:
    for spread in (HARDLY, NOTHING):
        one = candidate(INPUT, 19.0, 10.0)
        (settled,) = refits(spread).settled([one], 0.05)
        assert not settled.helps
        assert settled.kind == one.kind
        assert settled.attempt.decision == "nearly"
        assert settled.attempt.gain == one.attempt.gain
        assert "on blocks of the whole record" in settled.attempt.reason


@pytest.mark.parametrize(("worse", "harms"), [(1.0, False), (2.0, True)])
def test_forecasts_of_the_whole_record_that_are_worse_count_against(
    monkeypatch: pytest.MonkeyPatch, worse: float, harms: bool
) -> None:
    """Then no evidence of training data is a match for them."""
    one, errors = candidate(INPUT, 19.0, 10.0), np.resize([1.0, -1.0], SAMPLES)[:, None]
    scored = refits(replace(HARDLY, errors=worse * errors))
    base = replace(tried(0.0, 1e-9), errors=errors)
    run = scored.run
    monkeypatch.setattr(
        scored, "run", lambda tasks, label: run(tasks, label) | {("", SPREAD): base}
    )
    (settled,) = scored.settled([one], 0.05)
    assert settled.harms is harms
    assert not settled.helps
    assert settled.attempt.decision == "nearly"
    monkeypatch.setattr(scored, "evidence", lambda one: VERY_STRONG + 1.0)
    settled = replace(settled, tried=replace(settled.tried, fit=cast(Any, object())))
    monkeypatch.setattr(scored, "_adds_forms", lambda one: True)
    gaining = replace(settled, attempt=replace(settled.attempt, decision="rejected"))
    assert scored.by_evidence([gaining], 0.05)[0].helps is not harms
    assert scored.by_evidence([settled], 0.05)[0].helps is not harms


def test_what_costs_forecasts_is_not_settled() -> None:
    scored = refits(WELL)
    one = candidate(INPUT, 19.0, 10.0, worse=2.0)
    assert one.harms
    assert scored.settled([one], 0.05) == [one]
    assert not scored.asked


@pytest.mark.parametrize(
    ("effect", "model", "asked"),
    [
        (INPUT, MODEL, True),
        (effects.Drift(), MODEL, False),
        (effects.OutputNonlinearity(), dgp.Wiener(1, pairs=1), False),
    ],
)
def test_a_loss_settles_what_goes_with_time_or_has_functions(
    effect: effects.Effect, model: dgp.Model, asked: bool
) -> None:
    one, scored = candidate(effect, -5.0, 10.0), refits(WELL)
    one = replace(one, tried=replace(one.tried, model=model))
    scored.settled([one], 0.05)
    assert bool(scored.asked) is asked


def test_a_loss_is_no_candidate_beside_what_helps() -> None:
    helps, other = candidate(DELAY, 30.0, 10.0), candidate(INPUT, -5.0, 10.0)
    scored = refits(WELL)
    assert scored.settled([helps, other], 0.05) == [helps, other]
    assert not scored.asked


@pytest.mark.parametrize(("gain", "asked"), [(31.0, True), (29.0, False)])
def test_what_gains_less_than_what_helps_need_not_be_settled(gain: float, asked: bool) -> None:
    helps, other = candidate(DELAY, 30.0, 10.0), candidate(INPUT, gain, 20.0)
    scored = refits(WELL)
    found = scored.settled([helps, other], 0.05)
    assert found[0] is helps
    assert found[1].helps is asked
    assert bool(scored.asked) is asked


def test_what_is_on_blocks_of_the_whole_record_already_is_not_scored_again() -> None:
    scored = refits(WELL)
    assert not scored.settled([candidate(STEP, 19.0, 10.0)], 0.05)[0].helps
    assert not scored.asked


def test_a_round_that_the_time_limit_cuts_short_settles_nothing() -> None:
    one, scored = candidate(INPUT, 19.0, 10.0), refits(WELL)
    scored.late_then = True
    assert scored.settled([one], 0.05) == [one]


@pytest.mark.parametrize("settles", [False, True])
def test_a_round_settles_before_it_decides(monkeypatch: pytest.MonkeyPatch, settles: bool) -> None:
    nearly = candidate(INPUT, 19.0, 10.0)
    after = [replace(nearly, helps=settles)]
    monkeypatch.setattr(Refits, "judge", lambda self, some: [nearly] if some else [])
    monkeypatch.setattr(Refits, "settled", lambda self, judged, level: after)
    monkeypatch.setattr(Refits, "with_substeps", lambda self, one: one.tried)
    current: Any = type("Current", (), {"model": MODEL})
    given: Any = ([(nearly.found, (MODEL,))], current, range(480), np.arange(480) >= 240)
    done = confirm(*given, number=1, seed=0, level=0.05, settings=SETTINGS, workers=1)
    assert (done.winner is nearly.found) is settles


@pytest.mark.parametrize(
    ("q", "helps", "tried"),
    [
        (1e-8, True, ["extra input", "dead time"]),  # relatives beside it
        (1e-8, False, ["extra input", "dead time", "input nonlinearity", "heavy tails"]),
        (0.06, True, ["extra input", "dead time", "input nonlinearity", "heavy tails"]),  # by luck
    ],
)
def test_beside_what_is_certain_and_helps_only_relatives_are_tried(
    monkeypatch: pytest.MonkeyPatch, q: float, helps: bool, tried: list[str]
) -> None:
    one = replace(candidate(INPUT, 50.0, 1.0, q=q), helps=helps)
    others = [candidate(effect, -5.0, 1.0, q=0.5)
              for effect in (DELAY, effects.InputNonlinearity(), effects.HeavyTails())]  # fmt: skip
    by_found = {id(each.found): each for each in (one, *others)}
    asked: list[list[str]] = []

    def judge(self: Any, some: Any) -> list[Judged]:
        asked.append([found.effect.name for found, _ in some])
        return [by_found[id(found)] for found, _ in some]

    monkeypatch.setattr(Refits, "judge", judge)
    monkeypatch.setattr(Refits, "with_substeps", lambda self, one: one.tried)
    monkeypatch.setattr(Refits, "settled", lambda self, judged, level: judged)
    monkeypatch.setattr(decision, "confirmed_together", lambda *given: None)
    current: Any = type("Current", (), {"model": MODEL})
    candidates = [(each.found, (MODEL,)) for each in (*others, one)]
    given: Any = (candidates, current, range(480), np.arange(480) >= 240)
    done = confirm(*given, number=1, seed=0, level=0.05, settings=SETTINGS, workers=1)
    assert sorted(name for some in asked for name in some) == sorted(tried)
    assert asked[0] == (["extra input"] if q < 0.05 else [])
    names = [attempt.name for attempt in done.attempts if attempt.decision != "not tried"]
    assert names == [each.found.effect.name for each in (*others, one)
                     if each.found.effect.name in tried]  # fmt: skip
    left = [attempt.name for attempt in done.attempts if attempt.decision == "not tried"]
    assert left == [each.found.effect.name for each in others
                    if each.found.effect.name not in tried]  # fmt: skip


def test_what_was_scored_on_the_whole_record_is_not_refitted_again() -> None:
    one, scored = candidate(INPUT, 19.0, 10.0), refits(HARDLY)
    scored.settled([one], 0.05)
    assert scored.on_spread_blocks([one]) == {repr(MODEL): HARDLY}
    assert len(scored.asked) == 1


def test_a_lower_level_asks_for_more() -> None:
    one, scored = candidate(INPUT, 19.0, 10.0, q=0.009), refits(WELL)
    assert scored.settled([one], 0.008) == [one]
    assert scored.settled([one], 0.0095)[0].helps


@pytest.mark.parametrize(
    ("gain", "q", "evidence", "other", "helps"),
    [
        (17.0, 1e-4, VERY_STRONG + 0.1, False, True),
        (17.0, 1e-4, VERY_STRONG - 0.1, False, False),
        (14.0, 1e-4, VERY_STRONG + 0.1, False, False),  # not nearly
        (17.0, 0.0099, VERY_STRONG + 0.1, False, True),
        (17.0, 0.0101, VERY_STRONG + 0.1, False, False),  # the residual has its doubts
        (17.0, 1e-4, VERY_STRONG + 0.1, True, False),  # another one helps for certain
    ],
)
def test_what_nearly_helps_is_settled_by_the_evidence_of_all_known_data(
    monkeypatch: pytest.MonkeyPatch,
    gain: float,
    q: float,
    evidence: float,
    other: bool,
    helps: bool,
) -> None:
    monkeypatch.setattr(Refits, "evidence", lambda self, one: evidence)
    fit: Any = object()
    one = candidate(INPUT, gain, 10.0, q=q)
    one = replace(one, tried=replace(one.tried, fit=fit))
    later = f"{one.attempt.reason}; on blocks of the whole record"
    one = replace(one, attempt=replace(one.attempt, reason=later))
    judged = [one, *([candidate(DELAY, 30.0, 10.0)] if other else [])]
    first, *_ = refits(NOTHING).by_evidence(judged, 0.05)
    assert first.helps is helps
    if helps:
        assert first.attempt.reason.endswith("the evidence for it is +5.1 nats")
        assert "would settle it" not in first.attempt.reason
        assert "nats; on blocks of the whole record; fitted to" in first.attempt.reason
    else:
        assert first is one
    unfitted = candidate(INPUT, 17.0, 10.0)
    assert refits(NOTHING).by_evidence([unfitted], 0.05) == [unfitted]


@pytest.mark.parametrize(
    ("effect", "gain", "evidence", "helps"),
    [
        (INPUT, 17.0, 2.0 * VERY_STRONG + 0.1, True),
        (INPUT, 17.0, 2.0 * VERY_STRONG - 0.1, False),
        (INPUT, 14.0, 2.0 * VERY_STRONG + 0.1, False),  # not nearly
        (effects.HeavyTails(), 17.0, 2.0 * VERY_STRONG + 0.1, False),  # no structure
    ],
)
def test_where_no_test_is_certain_twice_the_evidence_is_asked_for(
    monkeypatch: pytest.MonkeyPatch,
    effect: effects.Effect,
    gain: float,
    evidence: float,
    helps: bool,
) -> None:
    """Of structure, whatever its own test says: forecasts miss by far more than the noise."""
    monkeypatch.setattr(Refits, "evidence", lambda self, one: evidence)
    fit: Any = object()
    one = candidate(effect, gain, 10.0, q=0.7)
    one = replace(one, tried=replace(one.tried, fit=fit))
    scored = refits(NOTHING)
    assert scored.by_evidence([one], 0.05) == [one]
    scored.weighed = True
    assert scored.by_evidence([one], 0.05)[0].helps is helps
    forms = replace(one, tried=replace(one.tried, model=dgp.Compartments(1)))
    little = replace(forms, attempt=replace(forms.attempt, gain=0.1, decision="rejected"))
    assert scored.by_evidence([little], 0.05) == [little]


@pytest.mark.parametrize(
    ("model", "gain", "helps"),
    [
        (dgp.Compartments(1), 0.1, True),
        (dgp.NonlinearFeedback(1, parametric=True), 0.1, True),
        (dgp.Compartments(1), -0.1, False),  # held-out data speak against it
        (dgp.NonlinearFeedback(1), 0.1, False),  # a Gaussian process has many numbers
        (dgp.LinearDynamicGP(1), 0.1, False),
    ],
)
def test_parametric_functions_in_feedback_are_settled_by_evidence_where_they_gain(
    monkeypatch: pytest.MonkeyPatch, model: dgp.Model, gain: float, helps: bool
) -> None:
    monkeypatch.setattr(Refits, "evidence", lambda self, one: VERY_STRONG + 0.1)
    fit: Any = object()
    one = candidate(INPUT, gain, 10.0, q=1e-4)
    one = replace(one, tried=replace(one.tried, fit=fit, model=model))
    (found,) = refits(NOTHING).by_evidence([one], 0.05)
    assert found.helps is helps
    worse = replace(one, harms=True)  # its forecasts are certainly worse
    assert refits(NOTHING).by_evidence([worse], 0.05) == [worse]
    there = refits(NOTHING)  # what is added is another effect
    there.current = cast("Any", type("Current", (), {"model": dgp.Compartments(1)}))
    assert there.by_evidence([one], 0.05) == [one]


@pytest.mark.parametrize(
    ("effect", "gain", "q", "helps"),
    [
        (effects.LevelShift(), 0.1, 1e-4, True),
        (effects.LevelShift(), -0.1, 1e-4, False),  # held-out data speak against it
        (effects.LevelShift(), 0.1, 0.0101, False),  # the residual has its doubts
        (effects.ProcessNoise(), 0.1, 1e-4, True),
        (effects.HeavyTails(), 0.1, 1e-4, False),
        (effects.GainShift(), 0.1, 1e-4, False),
    ],
)
def test_what_one_block_or_a_mode_may_hide_is_settled_by_evidence_where_it_gains(
    monkeypatch: pytest.MonkeyPatch, effect: effects.Effect, gain: float, q: float, helps: bool
) -> None:
    """A response to a step may lie in a block that one fold holds out; modes may be poor."""
    monkeypatch.setattr(Refits, "evidence", lambda self, one: VERY_STRONG + 0.1)
    fit: Any = object()
    one = candidate(effect, gain, 10.0, q=q)
    one = replace(one, tried=replace(one.tried, fit=fit))
    assert refits(NOTHING).by_evidence([one], 0.05)[0].helps is helps
    worse = replace(one, harms=True)
    assert refits(NOTHING).by_evidence([worse], 0.05) == [worse]


@pytest.mark.parametrize(
    ("model", "noise"),
    [(dgp.Compartments(1), False), (dgp.NonlinearFeedback(1), True), (dgp.Wiener(1), True)],
)
def test_evidence_of_parametric_functions_is_that_of_free_runs(
    monkeypatch: pytest.MonkeyPatch, model: dgp.Model, noise: bool
) -> None:
    """Process noise explains one step ahead what either model lacks: neither has any then."""
    asked: list[dgp.Model] = []

    def refit(fit: Any, record: Any, *, model: dgp.Model, run: Any) -> dgp.Model:
        asked.append(model)
        return model

    monkeypatch.setattr(refits_of_a_round, "refit", refit)
    monkeypatch.setattr(refits_of_a_round, "comparable", lambda record, models, reach: record)
    monkeypatch.setattr(refits_of_a_round, "log_evidence_of", lambda m: float(len(m.layers)))
    one, fit = candidate(INPUT, 17.0, 10.0), cast("Any", object())
    one = replace(one, tried=replace(one.tried, fit=fit, model=model))
    assert refits(NOTHING).evidence(one) == len(model.layers) - 1.0
    assert [m.layers[0].name for m in asked] == [MODEL.layers[0].name, model.layers[0].name]
    assert [layer.process_noise for m in asked for _, layer in m.dynamic] == [noise] * (
        1 + len(model.dynamic)
    )


@pytest.mark.parametrize(
    ("weighed", "q", "expected"),
    [
        (False, 1e-8, [["dead time"], ["heavy tails"]]),
        (False, 0.5, [[], ["heavy tails"]]),
        (True, 0.5, [[], ["dead time"], ["heavy tails"]]),  # what no test is certain of as well
    ],
)
def test_noise_that_nearly_helps_is_settled_so_as_well(
    monkeypatch: pytest.MonkeyPatch, weighed: bool, q: float, expected: list[list[str]]
) -> None:
    """Of the candidates of a round those of the noise come after the structure."""
    asked: list[list[str]] = []

    def by_evidence(self: Any, judged: list[Judged], level: float) -> list[Judged]:
        asked.append([one.found.effect.name for one in judged])
        return judged

    monkeypatch.setattr(Refits, "by_evidence", by_evidence)
    monkeypatch.setattr(Refits, "judge", lambda self, some: [
        replace(candidate(found.effect, 17.0, 10.0), found=found) for found, _ in some
    ])  # fmt: skip
    monkeypatch.setattr(Refits, "settled", lambda self, judged, level: list(judged))
    current: Any = type("Current", (), {"model": MODEL})
    record: Any = range(480)
    tails = spoken_for(effects.HeavyTails(), 1e-9, 1e-8)
    delay = spoken_for(DELAY, 1e-9, q)
    confirm(
        [(delay, (MODEL,)), (tails, (MODEL,))], current, record, np.arange(480) >= 240,
        number=1, seed=0, level=0.05, settings=SETTINGS, workers=1, weighed=weighed,
    )  # fmt: skip
    assert asked == expected
