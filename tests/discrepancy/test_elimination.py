"""Effects that later ones make superfluous are taken out again, and no others."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.signal import lfilter

import pyro_dynogp as dgp
from pyro_dynogp import effects
from pyro_dynogp.data.channels import Delayed, Product, Recorded, Step
from pyro_dynogp.discrepancy import elimination
from pyro_dynogp.discrepancy.blocks import blocks_of
from pyro_dynogp.discrepancy.context import SearchContext, Stopwatch
from pyro_dynogp.discrepancy.decision import Confirmed
from pyro_dynogp.discrepancy.elimination import Added, is_superfluous, withdrawn, without
from pyro_dynogp.discrepancy.held_out import without as without_block
from pyro_dynogp.discrepancy.result import Attempt, EffectTest
from pyro_dynogp.discrepancy.search import Found
from pyro_dynogp.discrepancy.state import SearchState
from pyro_dynogp.inference.refit import refit
from pyro_dynogp.models.feedback_variants import with_feedback
from pyro_dynogp.models.variants import (
    with_channel,
    with_integrator,
    with_pairs,
    without_change_of,
)
from pyro_dynogp.statistics.evidence import Evidence

from .made import SETTINGS, lag

N, JUMP = 480, 12.0
MODEL = dgp.LinearDynamicGP(1, pairs=1, process_noise=False)
SHIFT, FLOW, WIND = Step(JUMP), Recorded("flow"), Recorded("wind")
SHIFTED = with_channel(MODEL, SHIFT)


def found(effect: effects.Effect) -> Found:
    return Found(effect, Evidence(effect.name, 5.0, 1e-6, 30.0, 0.1), 1e-5)


def confirmed(before: dgp.Model, model: dgp.Model, one: Found) -> Confirmed:
    attempt = Attempt(1, one.evidence, one.q_value, "accepted", "held-out elpd +9", 9.0, 2.0)
    return Confirmed((attempt,), one, before, model, attempt, None, ())


def searched(jump: float) -> SearchState:
    """A level shift was added; then two channels, of which one jumps when the level does."""
    rng = np.random.default_rng(4)
    time = 0.1 * np.arange(N)
    u, flow, wind = lfilter([0.3], [1.0, -0.7], rng.standard_normal((N, 3)), axis=0).T
    flow = flow + 1.5 * (time >= JUMP)
    late = jump * (time >= JUMP)
    y = lag(u, 0.5) + lag(flow, 0.5) + lag(wind, 0.5) + late + 0.05 * rng.standard_normal(N)
    record = dgp.Record(time, u, y, extra={"flow": flow, "wind": wind})
    given = dgp.fit(MODEL, record[:240], restarts=1, workers=1, progress=False, method="map")
    data = blocks_of(given, record, None, SETTINGS)
    rounds = SearchContext(data, ["flow", "wind"], 0, 0.05, 8, (), 1, False, SETTINGS)
    training = without_block(data.known, data.held_out)
    fit = refit(given, training, model=MODEL)
    state = SearchState(rounds, Stopwatch(), fit)
    model = MODEL
    for effect, channel in (
        (effects.LevelShift(), SHIFT), (effects.ExtraInput(), FLOW), (effects.ExtraInput(), WIND)
    ):  # fmt: skip
        one, larger = found(effect), with_channel(model, channel)
        base, fit = fit, rounds.refit(fit, larger)
        state.added.append(Added(one, confirmed(model, larger, one), (), base, fit))
        state.attempts += state.added[-1].confirmed.attempts
        state.tests.append(EffectTest(1, effect.name, "", "", 1e-6, 1e-5, "accepted"))
        model = larger
    return state


@pytest.mark.filterwarnings("ignore:fit. layer g. the pole:UserWarning")  # the jump, as it is given
@pytest.mark.parametrize(("jump", "superfluous"), [(0.0, True), (0.6, False)])
def test_a_shift_that_an_input_explains_is_taken_out_again(jump: float, superfluous: bool) -> None:
    state = searched(jump)
    before = state.added
    state._eliminate()
    names = [one.name for one in state.attempts if one.decision == "accepted"]
    if not superfluous:
        assert state.added == before
        assert names == ["level shift", "extra input", "extra input"]
        assert not state.notes
        return
    (note,) = state.notes
    assert note == "level shift is superfluous next to extra input, and was taken out again."
    assert names == ["extra input", "extra input"]
    assert [one.decision for one in state.tests] == ["rejected", "accepted", "accepted"]
    assert state.attempts[0].reason == "held-out elpd +9; superfluous next to extra input"
    flow, wind = state.added
    assert flow.fit.model.channels == (FLOW,) == wind.confirmed.before.channels
    assert wind.fit.model.channels == (FLOW, WIND) == wind.confirmed.model.channels
    assert flow.base is before[0].base
    assert wind.base is flow.fit
    assert state.eliminated == ["level shift"]
    state.added.insert(0, before[0])  # found once more, by what came later: it stays
    state._eliminate()
    assert len(state.added) == 3


def test_what_later_effects_build_on_stays() -> None:
    other = with_channel(SHIFTED, FLOW)
    assert without_change_of(other, SHIFTED, MODEL) == with_channel(MODEL, FLOW)
    assert without_change_of(MODEL, SHIFTED, MODEL) is None  # there is none
    assert without_change_of(SHIFTED, MODEL, MODEL) is None  # it added none
    wider = with_pairs(SHIFTED, 1)
    assert without_change_of(wider, wider, MODEL) == MODEL  # and another pair
    assert without_change_of(SHIFTED, wider, MODEL) is None  # which that has not
    integrating = with_integrator(MODEL)
    assert integrating is not None
    shifted = with_channel(integrating, SHIFT)
    assert without_change_of(shifted, integrating, MODEL) == SHIFTED
    assert without_change_of(with_pairs(shifted, 2), integrating, MODEL) == with_pairs(SHIFTED, 2)
    assert without_change_of(with_pairs(shifted, 2), with_pairs(MODEL, 1), MODEL) == (
        with_pairs(shifted, 1)
    )
    acting = with_feedback(SHIFTED)
    assert acting is not None
    assert without_change_of(acting, SHIFTED, MODEL) == with_feedback(MODEL)
    assert without_change_of(acting, with_feedback(MODEL), MODEL) is None  # a layer more
    assert without_change_of(SHIFTED, replace(SHIFTED, initial_state="zero"), MODEL) is None
    (name,) = FLOW.names
    flow = with_channel(MODEL, FLOW)
    late = with_channel(flow, Delayed(name, 0.3))
    assert without_change_of(late, flow, MODEL) is None
    product = with_channel(flow, Product("u", name, 0.0, 0.0))
    assert without_change_of(product, flow, MODEL) is None
    one, later = found(effects.ExtraInput()), found(effects.DeadTime())
    fits = [SimpleNamespace(model=model) for model in (MODEL, flow, late)]
    added = [
        Added(one, confirmed(MODEL, flow, one), (), fits[0], fits[1]),
        Added(later, confirmed(flow, late, later), (), fits[1], fits[2]),
    ]
    assert without(added, 0, lambda fit, model: pytest.fail("fitted")) is None


@pytest.mark.parametrize(
    ("evidence", "gain", "superfluous"),
    [(-1.0, 3.0, True), (1.0, 3.0, False), (-1.0, 9.0, False), (-1.0, -9.0, True)],
)
def test_neither_training_nor_held_out_data_speak_for_what_is_superfluous(
    monkeypatch: pytest.MonkeyPatch, evidence: float, gain: float, superfluous: bool
) -> None:
    """A gain counts from 4 nats and two standard errors on."""
    monkeypatch.setattr(elimination, "log_bayes_factor", lambda one, other: evidence)
    monkeypatch.setattr(
        elimination, "held_out_density",
        lambda fit, *_: np.full(100, fit / 100.0) + 1e-3 * np.cos(np.arange(100.0) * fit),
    )  # fmt: skip
    one = Added(found(effects.LevelShift()), None, (), None, None)
    assert is_superfluous(one, gain, 0.0, None, None, SETTINGS) is superfluous


def test_only_the_attempt_and_the_test_that_added_it_are_rejected() -> None:
    one = found(effects.LevelShift())
    other = replace(one, evidence=replace(one.evidence, output="z"))
    own, tie = confirmed(MODEL, SHIFTED, one).attempt, confirmed(MODEL, SHIFTED, other).attempt
    tests = [EffectTest(number, one.effect.name, output, "", 1e-6, 1e-5, "accepted")
             for number, output in ((1, ""), (2, ""), (1, "z"))]  # fmt: skip
    added = Added(one, confirmed(MODEL, SHIFTED, one), (), None, None)
    attempts, tests = withdrawn([tie, own], tests, added, "drift")
    assert [a.decision for a in attempts] == ["accepted", "rejected"]
    assert [t.decision for t in tests] == ["rejected", "accepted", "accepted"]
