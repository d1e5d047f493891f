"""Which effects a round believes in: false discovery rates, payments, relatives, special cases."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy import stats

import pyro_dynogp as dgp
from pyro_dynogp import effects
from pyro_dynogp.data.channels import DeadZone
from pyro_dynogp.discrepancy.context import Left, SearchContext
from pyro_dynogp.discrepancy.held_out import certain, without
from pyro_dynogp.discrepancy.search import Found, candidates_of, extended_by, look, rated
from pyro_dynogp.discrepancy.state import SET_POINT, SearchState
from pyro_dynogp.effects import Effect
from pyro_dynogp.models.variants import with_channel
from pyro_dynogp.statistics import omnibus
from pyro_dynogp.statistics.evidence import Evidence
from pyro_dynogp.statistics.settings import LoopSettings
from tests.discrepancy.made import SETTINGS
from tests.discrepancy.test_loop import machine


def speaking(effect: Effect, p: float, gain: float = 10.0) -> tuple[Effect, Evidence]:
    return effect, Evidence(effect.name, 5.0, p, gain, 0.1)


class Certain(Effect):
    """An effect whose test gives the p-values that it is made with, one for each output."""

    family = "time"

    def __init__(self, name: str, p: float) -> None:
        self.name, self.p = name, p

    def detect(self, residuals, settings, seed=0):
        return [Evidence(self.name, 5.0, self.p, 10.0, 0.1)]

    def extend(self, model, evidence, record):
        return [model]


def test_false_discovery_rates_hold_however_tests_depend():
    """Those of Benjamini and Yekutieli: m * (1 + 1/2 + ... + 1/m) / rank, never falling."""
    p = np.array([0.001, 0.2, 0.01, 0.04, 0.9])
    found = rated([speaking(Certain(f"effect {k}", x), x) for k, x in enumerate(p)])
    harmonic = 1 + 1 / 2 + 1 / 3 + 1 / 4 + 1 / 5
    expected = np.minimum(np.sort(p) * 5 * harmonic / np.arange(1, 6), 1.0)
    expected = np.minimum.accumulate(expected[::-1])[::-1]
    np.testing.assert_allclose([one.q_value for one in found], expected, rtol=1e-12)
    # Benjamini and Hochberg's, which ask for independence, are smaller by the harmonic number.
    hochberg = stats.false_discovery_control(np.sort(p), method="bh")
    assert found[0].q_value == pytest.approx(harmonic * hochberg[0])
    assert rated([]) == []


def test_every_output_is_paid_for():
    """Of two outputs there are twice as many tests: the same p-value is worth half as much."""
    residuals = SimpleNamespace(output_name="y")
    one, _ = look([residuals], [Certain("a", 0.02)], SETTINGS, seed=0, workers=1)
    two, _ = look([residuals, residuals], [Certain("a", 0.02)], SETTINGS, seed=0, workers=1)
    assert [f.evidence.p_value for f in one] == [0.02]
    assert [f.evidence.p_value for f in two] == [0.04, 0.04]
    assert [f.evidence.output for f in two] == ["y", "y"]
    certainly, _ = look([residuals] * 3, [Certain("a", 0.5)], SETTINGS, seed=0, workers=1)
    assert max(f.evidence.p_value for f in certainly) == 1.0


def test_relatives_of_a_certain_effect_are_tried_up_to_a_p_value():
    record = machine()
    model = dgp.LinearDynamicGP(1, pairs=1)

    class Other(Certain):
        family = "paths"

        def extend(self, model, evidence, record):
            return [replace(model, layers=(replace(model.layers[0], pairs=3),))]

    def tried(p: float, family: str, settings: LoopSettings = SETTINGS) -> list[str]:
        other = Other("other", p)
        other.family = family  # type: ignore[misc]
        found = [Found(*speaking(Certain("first", 1e-6), 1e-6), 1e-6),
                 Found(*speaking(other, p), 0.9)]  # fmt: skip
        chosen = candidates_of(found, model, record, 0.05, 8, settings)
        return [one.effect.name for one, _ in chosen]

    assert tried(0.29, "time") == ["first", "other"]
    assert tried(0.31, "time") == ["first"]
    assert tried(0.29, "paths") == ["first"]  # no relative
    assert tried(0.31, "time", LoopSettings(relative=0.4)) == ["first", "other"]


def test_what_is_imitated_is_tried_whatever_its_test_says_and_takes_no_place():
    class Imitated(Certain):
        imitated = True

    record = machine(seed=1)
    model = dgp.LinearDynamicGP(1, pairs=1)
    found = [
        Found(*speaking(Certain("first", 0.01), 0.01), 0.01),
        Found(*speaking(Certain("second", 0.02), 0.02), 0.02),
        Found(*speaking(Imitated("third", 0.9), 0.9), 1.0),
        Found(*speaking(Certain("fourth", 0.9), 0.9), 1.0),
    ]
    chosen = candidates_of(found, model, record, 0.05, 1, SETTINGS)
    assert [one.effect.name for one, _ in chosen] == ["first", "third"]
    assert [e.name for e in effects.CATALOGUE if e.imitated] == ["integrator"]


@pytest.fixture(scope="module")
def state():
    """A search on a small record in which nothing lacks."""
    record = machine(seed=2)
    model = dgp.LinearDynamicGP(1, pairs=1, process_noise=False)
    fit = dgp.fit(model, record[:240], restarts=1, workers=1, progress=False, method="map")
    from pyro_dynogp.discrepancy.blocks import blocks_of
    from pyro_dynogp.discrepancy.context import Stopwatch
    from pyro_dynogp.inference.refit import refit

    data = blocks_of(fit, record, None, SETTINGS)
    looked_for = (effects.OutputNonlinearity(), effects.Saturation(), effects.LevelShift())
    context = SearchContext(data, [], 0, 0.05, 8, looked_for, 1, False, SETTINGS)
    first = refit(fit, without(data.known, data.held_out), model=model)
    return SearchState(context, Stopwatch(), first)


def added(found: Found) -> SimpleNamespace:
    return SimpleNamespace(found=found, confirmed=SimpleNamespace(ties=()))


def test_a_function_of_the_output_has_its_limits_too(state, monkeypatch):
    """A special case is not looked for again in a model that has the general effect."""
    seen = {}

    def look_(self, fit, known, plain=None):
        seen["known"] = set(known)
        return SimpleNamespace(found=[], residuals=[], whole=[], notes=[])

    monkeypatch.setattr(SearchContext, "look", look_)
    monkeypatch.setattr(SearchContext, "left", lambda self, looked: Left())
    general = Found(*speaking(effects.OutputNonlinearity(), 1e-9), 1e-8)
    state.added = [added(general)]
    state.look()
    assert seen["known"] == {"output nonlinearity", "saturation"}
    state.added = [added(Found(*speaking(effects.LevelShift(), 1e-9), 1e-8))]
    state.look()
    assert seen["known"] == {"level shift"}
    state.added = []


def test_what_inputs_under_feedback_may_imitate_is_not_tried_where_feedback_is_more_certain(state):
    fed_back = Found(*speaking(effects.Feedback(), 1e-6), 1e-6)
    state.reported = [fed_back]
    weaker = Found(*speaking(effects.DeadTime(), 1e-4), 1e-4)
    stronger = Found(*speaking(effects.DeadTime(), 1e-8), 1e-8)
    assert state._is_fed_back(weaker)
    assert not state._is_fed_back(stronger)
    assert not state._is_fed_back(Found(*speaking(effects.LevelShift(), 1e-4), 1e-4))
    assert state._is_fed_back(Found(*speaking(effects.ClockShift(), 1e-4), 1e-4))
    state.reported = []
    assert not state._is_fed_back(weaker)


def test_a_set_point_is_not_tried_and_other_effects_are(state):
    """An exact relation says nothing of how certain what follows the noise is."""

    def found(effect, p, **where):
        one, evidence = speaking(effect, p)
        return Found(one, replace(evidence, where={**evidence.where, **where}), p)

    state.reported = [found(effects.Feedback(), 1e-300, channel="u", **{"set point": "r"})]
    way = {"form": "linear", "delay": 0.0}
    own = found(effects.ExtraInput(), 1e-300, channel="r", **way)
    other = found(effects.ExtraInput(), 1e-5, channel="w", **way)
    assert [state._is_set_point(one) for one in (own, other, *state.reported)] == [
        True,
        False,
        False,
    ]
    assert not any(state._is_fed_back(one) for one in (own, other))
    state.rest = Left(("something",))
    attempts = {one.channel: one.reason for one in state._untried([own, other], [], "others")}
    assert attempts == {"r": SET_POINT, "w": "others"}
    state.reported, state.rest = [], Left()
    assert not state._is_set_point(own)


def test_two_answers_to_whether_anything_is_left_share_the_level(state):
    context = state.rounds
    assert context.gate == pytest.approx(0.025)
    half = replace(context, settings=LoopSettings(gate=0.2))
    assert half.gate == pytest.approx(0.01)
    found = Found(*speaking(effects.LevelShift(), 0.02), 0.03)
    looked = SimpleNamespace(found=[found], residuals=[], whole=[])
    assert context.left(looked).said == ()  # 0.03 is more than half of 0.05
    sure = SimpleNamespace(found=[replace(found, q_value=0.02)], residuals=[], whole=[])
    assert "level shift (0.02)" in context.left(sure).said[0]


def test_the_omnibus_test_pays_for_its_five_ways(monkeypatch):
    """Sidak's formula: one p-value of 0.01 among five is 1 - 0.99^5."""
    monkeypatch.setattr(omnibus, "held_out_innovations", lambda r, settings: np.zeros(50))
    monkeypatch.setattr(omnibus, "portmanteau", lambda *a, **k: (0.0, 0.5))
    monkeypatch.setattr(omnibus, "_not_normal", lambda v, settings, seed: 0.01)
    monkeypatch.setattr(omnibus, "_follows", lambda r, settings, seed: 0.7)
    monkeypatch.setattr(
        omnibus, "beyond_catalogue", lambda r, settings, seed=0: SimpleNamespace(p_value=0.9)
    )
    p, sentence = omnibus.structure_left(SimpleNamespace(output_name="y"), SETTINGS, 0.05)
    assert p == pytest.approx(1.0 - 0.99**5)
    assert "one-step errors are not normal" in sentence


@pytest.mark.parametrize(
    ("gains", "settings", "counts"),
    [
        (np.full(100, 0.05), SETTINGS, True),  # 5 nats, no error
        (np.full(100, 0.035), SETTINGS, False),  # 3.5 nats are less than 4
        (np.full(100, 0.035), LoopSettings(gain=3.0), True),
    ],
)
def test_a_gain_has_to_be_more_than_some_nats(gains, settings, counts):
    assert certain(gains, settings) is counts


def test_a_gain_has_to_be_more_than_two_standard_errors():
    rng = np.random.default_rng(0)
    gains = 0.1 + rng.standard_normal(100)
    gains += 0.12 - gains.mean()  # 12 nats; the error is about 10
    assert not certain(gains, SETTINGS)
    assert certain(gains, LoopSettings(standard_errors=0.5))


def test_settings_say_what_is_wrong():
    with pytest.raises(ValueError, match="cap: expected a finite number > 0, got 0"):
        LoopSettings(cap=0.0)
    with pytest.raises(ValueError, match="fit_share and search_share: expected a sum below 1"):
        LoopSettings(fit_share=0.8)


def test_two_outputs_go_through_the_loop():
    """A step in the second output is found there, added, and pays; the first one has none."""
    rng = np.random.default_rng(4)
    n = 480
    time = 0.5 * np.arange(n)
    u = np.repeat(rng.standard_normal(n // 6), 6)
    x = np.zeros(n)
    for k in range(1, n):
        x[k] = 0.7 * x[k - 1] + 0.3 * u[k - 1]
    y = np.column_stack([x, 0.5 * x]) + 0.05 * rng.standard_normal((n, 2))
    y[:, 1] += 0.4 * (time >= time[300])
    record = dgp.Record(time, u, y, output_names=("speed", "torque"))
    model = dgp.LinearDynamicGP(1, outputs=2, pairs=1, process_noise=False)
    fit = dgp.fit(model, record[:240], restarts=1, workers=1, progress=False, method="map")
    report = dgp.close_loop(
        fit, record, effects=(effects.LevelShift(), effects.Drift()), max_rounds=1, workers=1,
        progress=False,
    )  # fmt: skip
    assert [effect.name for effect in report.effects] == ["level shift"]
    assert "'torque'" in report.effects[0].sentence
    assert report.after["rmse"] < 0.6 * report.before["rmse"]
    assert report.fit.model.outputs == 2


@pytest.mark.parametrize("method", ["importance", "svi", "nuts"])
def test_the_last_fits_have_the_kind_of_posterior_that_was_given(method):
    record = machine(seed=3, weight=0.3)
    model = dgp.LinearDynamicGP(1, pairs=1, process_noise=False)
    options = {
        "importance": {"draws": 30},
        "svi": {"draws": 40, "steps": 60},
        "nuts": {"draws": 6, "chains": 2, "warmup": 5},
    }
    fit = dgp.fit(
        model, record[:240], method=method, restarts=1, workers=1, progress=False,
        **options[method],
    )  # fmt: skip
    report = dgp.close_loop(
        fit, record, effects=(effects.ExtraInput(),), max_rounds=1, workers=1, progress=False
    )
    assert [effect.name for effect in report.effects] == ["extra input"]
    for last in (report.base, report.fit):
        assert last.method == method
        assert len(last.draws["noise_sd"]) == len(fit.draws["noise_sd"])


def test_an_effect_that_the_model_cannot_have_is_no_candidate_and_says_why():
    record = machine()
    model = dgp.LinearDynamicGP(1, pairs=1, channels=(dgp.Delayed("u"),))

    class Made(Certain):
        def extend(self, model, evidence, record):
            return [with_channel(model, DeadZone("u delayed", -0.1, 0.1))]

    refused = Found(*speaking(Made("dead zone", 1e-6), 1e-6), 1e-6)
    fine = Found(*speaking(Certain("drift", 1e-3), 1e-3), 1e-3)
    chosen = candidates_of([refused, fine], model, record, 0.05, 8, SETTINGS)
    assert [one.effect.name for one, _ in chosen] == ["drift"]
    variants, why = extended_by(refused, model, record)
    assert len(variants) == 0
    assert why.startswith("the model cannot have it: channels: expected no channel that is made")
    assert extended_by(fine, model, record) == ([model], "")
    data = SimpleNamespace(known=record)
    course = SimpleNamespace(
        _is_set_point=lambda found: False,
        number=2, model=model, rounds=SimpleNamespace(level=0.05, data=data),
        _is_fed_back=lambda found: False,
    )  # fmt: skip

    class WithoutBlock(Certain):
        def extend(self, model, evidence, record):
            return []

    found = [refused, fine, Found(*speaking(WithoutBlock("hysteresis", 1e-3), 1e-3), 1e-3)]
    attempts = SearchState._untried(course, found, [], "others come first")
    none = "no block of the model stands for it"
    assert [one.reason for one in attempts] == [why, "others come first", none]
    assert [one.decision for one in attempts] == ["not tried"] * 3
