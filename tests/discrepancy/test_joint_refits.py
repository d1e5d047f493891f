"""Two effects of which each hides what the other one gains."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import pytest

import pyro_dynogp as dgp
from pyro_dynogp import effects
from pyro_dynogp.data.channels import DeadZone
from pyro_dynogp.discrepancy import joint_refits
from pyro_dynogp.discrepancy.joint_refits import confirmed_together
from pyro_dynogp.discrepancy.judged import Judged, judge, kind_of
from pyro_dynogp.discrepancy.refits import Refits
from pyro_dynogp.discrepancy.search import Found
from pyro_dynogp.discrepancy.trials import Tried
from pyro_dynogp.models.feedback_variants import with_feedback
from pyro_dynogp.models.variants import with_channel
from pyro_dynogp.statistics.evidence import Evidence
from tests.discrepancy.made import SETTINGS

MODEL = dgp.LinearDynamicGP(inputs=1, pairs=1)
SAMPLES = 100
NOISE = np.random.default_rng(0).normal(0.0, 1.0, SAMPLES)
STEP, INPUT, TAILS = effects.LevelShift(), effects.ExtraInput(), effects.HeavyTails()


def tried(gain: float, error: float = 1.0, failure: str = "") -> Tried:
    """With a gain, and its error for independent samples [nats]."""
    z = (NOISE - NOISE.mean()) / NOISE.std()
    return Tried(MODEL, gain / SAMPLES + error / np.sqrt(SAMPLES) * z, 0.0, failure)


@dataclass
class Trials:
    """Refits that come to what they are told: of effects alone, and of both together."""

    both: Tried
    alone: dict[str, Tried]
    early: bool = False
    asked: list[tuple[str, ...]] = field(default_factory=list)
    number: int = 1
    model: Any = MODEL
    settings: Any = SETTINGS
    record: Any = None

    def __post_init__(self) -> None:
        nothing = Tried(MODEL, np.zeros(SAMPLES), 0.0)
        kinds = [(where, score) for where in ("after", "spread") for score in
                 ("forecast", "one step")]  # fmt: skip
        self.results = {("", kind): nothing for kind in kinds}

    def trial(self, models: Any, kind: Any, found: Found | None, base: Any = None) -> Any:
        del base
        return (models, kind, "" if found is None else found.effect.name)

    def run(self, tasks: dict[Any, Any], label: str) -> dict[Any, Tried]:
        self.asked += [models if models[0] != MODEL else (name,) for models, _, name in
                       tasks.values()]  # fmt: skip
        return {
            key: self.alone[name] if models[0] == MODEL else self.both
            for key, (models, _, name) in tasks.items()
        }

    def _as_kept(self, one: Judged, kind: Any) -> Any:
        return ((one.tried.model,), kind, one.found.effect.name)

    on_spread_blocks, _run_new = Refits.on_spread_blocks, Refits._run_new

    def candidate(self, effect: effects.Effect, q: float) -> Judged:
        found = Found(effect, Evidence(effect.name, 5.0, q / 10.0, 1.0, 0.1), q)
        kind = kind_of(found)
        return judge(found, kind, self.alone[effect.name], self.results["", kind], 1, SETTINGS)


@pytest.fixture
def extensions(monkeypatch: pytest.MonkeyPatch) -> None:
    """The model with both effects goes by the second one's name."""
    monkeypatch.setattr(
        joint_refits, "extended_by", lambda found, model, record: ((found.effect.name,), "")
    )


@pytest.mark.usefixtures("extensions")
@pytest.mark.parametrize(
    ("both", "step", "extra", "first"),
    [
        (tried(60.0), tried(20.0, 15.0), tried(10.0, 9.0), "level shift"),
        (tried(60.0), tried(5.0, 9.0), tried(10.0, 9.0), "extra input"),
        (tried(60.0), tried(-20.0), tried(10.0, 9.0), "extra input"),
        (tried(60.0, 40.0), tried(20.0, 15.0), tried(10.0, 9.0), None),  # the pair is not certain
        (tried(3.0, 0.1), tried(0.0), tried(0.0), None),  # and gains too little
        (tried(20.5), tried(20.0, 15.0), tried(-10.0, 9.0), None),  # no more than one alone
        (tried(60.0, 15.0), tried(58.0, 15.0), tried(-10.0), None),
        (tried(0.0, failure="no"), tried(20.0, 15.0), tried(10.0, 9.0), None),
        (tried(60.0), tried(0.0, failure="no"), tried(10.0, 9.0), None),
    ],
)
def test_a_pair_has_to_gain_and_more_than_either_alone(both, step, extra, first) -> None:
    refits = Trials(both, {"level shift": step, "extra input": extra})
    judged = [refits.candidate(STEP, 1e-4), refits.candidate(INPUT, 1e-3)]
    found = confirmed_together(refits, judged, 0.05)
    assert (None if found is None else found.found.effect.name) == first
    if found is not None:
        assert found.helps
        other = {"level shift": "extra input", "extra input": "level shift"}[first]
        assert f"together with {other} +60.0" in found.attempt.reason


@pytest.mark.usefixtures("extensions")
@pytest.mark.parametrize(("q", "sure"), [(0.0099, True), (0.0101, False)])
def test_both_are_certain_in_the_residual(q: float, sure: bool) -> None:
    alone = {"level shift": tried(20.0, 15.0), "extra input": tried(10.0, 9.0)}
    refits = Trials(tried(60.0), alone)
    judged = [refits.candidate(STEP, 1e-4), refits.candidate(INPUT, q)]
    assert (confirmed_together(refits, judged, 0.05) is not None) is sure
    assert bool(refits.asked) is sure


@pytest.mark.usefixtures("extensions")
def test_noise_is_no_member_of_a_pair() -> None:
    refits = Trials(tried(60.0), {"level shift": tried(20.0, 15.0), "heavy tails": tried(9.0, 9.0)})
    judged = [refits.candidate(STEP, 1e-4), refits.candidate(TAILS, 1e-9)]
    assert confirmed_together(refits, judged, 0.05) is None
    assert not refits.asked


@pytest.mark.usefixtures("extensions")
def test_pairs_are_of_the_three_that_gain_most() -> None:
    gains = {"level shift": 9.0, "extra input": 8.0, "dead time": 7.0, "integrator": 6.0}
    refits = Trials(tried(60.0), {name: tried(g, 9.0) for name, g in gains.items()})
    four = [STEP, INPUT, effects.DeadTime(), effects.Integrator()]
    confirmed_together(refits, [refits.candidate(one, 1e-4) for one in four], 0.05)
    pairs = [names for names in refits.asked if names[0] != "level shift"]
    assert ("integrator",) not in pairs
    # A step is scored on blocks spread over the record, and what it is paired with, too.
    assert sorted(refits.asked[:3]) == [("dead time",), ("dead time",), ("extra input",)]


@pytest.mark.usefixtures("extensions")
def test_a_round_that_the_time_limit_cuts_short_confirms_no_pair() -> None:
    alone = {"level shift": tried(20.0, 15.0), "extra input": tried(10.0, 9.0)}
    refits = Trials(tried(60.0), alone, early=True)
    judged = [refits.candidate(STEP, 1e-4), refits.candidate(INPUT, 1e-3)]
    assert confirmed_together(refits, judged, 0.05) is None


ZONE = with_channel(MODEL, DeadZone("u0", -0.5, 0.5))
SPRING = with_feedback(MODEL)


def kept(effect: Any, model: Any) -> Judged:
    """An effect of which this model was kept."""
    found = Found(effect, Evidence(effect.name, 5.0, 1e-5, 1.0, 0.1), 1e-4)
    return judge(found, kind_of(found), replace(tried(5.0, 9.0), model=model, fit=model),
                 Tried(MODEL, np.zeros(SAMPLES), 0.0), 1, SETTINGS)  # fmt: skip


@dataclass
class Noted(Trials):
    """With what trials of both effects are asked for."""

    both_of: list[Any] = field(default_factory=list)

    def trial(self, models: Any, kind: Any, found: Found | None, base: Any = None) -> Any:
        self.both_of.append((models, found, base))
        return super().trial(models, kind, found)


def test_numbers_that_were_found_are_not_looked_for_once_more() -> None:
    """A dead zone goes to the spring as it was kept, and the fit with the spring goes on."""
    zone = kept(effects.DeadZoneOfInput(), ZONE)
    spring = kept(effects.NonlinearFeedbackOfOutput(), SPRING)
    for order in ([zone, spring], [spring, zone]):
        refits = Noted(tried(60.0), {})
        assert confirmed_together(refits, order, 0.05) is not None
        ((models, effect, base),) = refits.both_of
        assert models == (with_channel(SPRING, ZONE.channels[0]),)
        assert effect is None
        assert base is SPRING  # what stands for its fit


def masked(seed: int) -> dgp.Record:
    """A step that hides what an undeclared input does, and that the input hides."""
    rng = np.random.default_rng(seed)
    n = 480
    t = 0.1 * np.arange(n)
    u, w = (np.repeat(rng.standard_normal(n // 8), 8) for _ in range(2))
    y = np.zeros(n)
    for k in range(1, n):
        y[k] = 0.9 * y[k - 1] + 0.1 * u[k - 1] + 0.25 * w[k - 1]
    y = y + 1.2 * (np.arange(n) >= 270) + 0.05 * rng.standard_normal(n)
    return dgp.Record(t, u[:, None], y[:, None], extra={"w": w})


def test_effects_that_mask_each_other_are_found_one_after_the_other() -> None:
    record = masked(0)
    model = dgp.LinearDynamicGP(1, pairs=1)
    fit = dgp.fit(model, record[:240], method="map", workers=1, progress=False)
    report = dgp.close_loop(fit, record, effects=(STEP, INPUT), workers=1, progress=False)
    assert sorted(one.name for one in report.effects) == ["extra input", "level shift"]
    assert report.after["rmse"] < 0.06 < 0.3 < report.before["rmse"]
