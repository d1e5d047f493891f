"""What rounds say: of process noise that hides what is missing, and of what is left."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.signal import lfilter

import pyro_dynogp as dgp
from pyro_dynogp import effects
from pyro_dynogp.discrepancy.blocks import blocks_of
from pyro_dynogp.discrepancy.context import SearchContext, Tested
from pyro_dynogp.discrepancy.held_out import without
from pyro_dynogp.discrepancy.search import Found
from pyro_dynogp.discrepancy.search_notes import said_of_hiding
from pyro_dynogp.discrepancy.state import SearchState
from pyro_dynogp.inference.refit import refit
from pyro_dynogp.models.variants import has_process_noise, without_process_noise
from pyro_dynogp.statistics.evidence import Evidence
from tests.discrepancy.made import SETTINGS

from .series import residuals, share

N = 480
MODEL = dgp.LinearDynamicGP(1, pairs=1)


def oscillator(late: int, noise: float, seed: int) -> dgp.Record:
    """A lightly damped oscillator; its input acts some samples late, and noise acts with it."""
    rng = np.random.default_rng(seed)
    u = lfilter([0.6], [1.0, -0.4], rng.standard_normal(N + late))
    pole = 0.96 * np.exp(0.5j)
    a = [1.0, -2.0 * pole.real, abs(pole) ** 2]
    x = lfilter([0.0, 0.3, 0.1], a, u[:N] + noise * rng.standard_normal(N))
    y = x / x.std() + 0.02 * rng.standard_normal(N)
    return dgp.Record(0.1 * np.arange(N), u[late:], y)


@pytest.mark.parametrize(("late", "noise", "hides"), [(12, 0.0, True), (0, 0.5, False)])
def test_process_noise_that_costs_forecasts_is_pointed_out(late, noise, hides):
    record = oscillator(late, noise, seed=1)
    fit = dgp.fit(MODEL, record[:240], restarts=2, workers=1, progress=False, method="map")
    data = blocks_of(fit, record, None, SETTINGS)
    training = without(data.known, data.held_out)
    rounds = SearchContext(data, [], 0, 0.05, 8, (effects.LevelShift(),), 1, False, SETTINGS)
    given = refit(fit, training, model=MODEL)
    said = rounds.hiding(given, rounds.plain(given))
    assert bool(said) == hides, said
    assert not hides or "better without its process noise (elpd +" in said


def test_a_fit_without_process_noise_hides_nothing(rounds):
    model = without_process_noise(MODEL)
    fit = dgp.fit(
        model, rounds.data.known[:240], restarts=1, workers=1, progress=False, method="map"
    )
    assert rounds.plain(fit) is fit
    assert rounds.hiding(fit, rounds.plain(fit)) == ""


@pytest.fixture(scope="module")
def rounds():
    record = oscillator(0, 0.0, seed=2)
    fit = dgp.fit(MODEL, record[:240], restarts=1, workers=1, progress=False, method="map")
    return SearchContext(
        blocks_of(fit, record, None, SETTINGS), [], 0, 0.05, 8, (), 1, False, SETTINGS
    )


def test_what_is_left_is_said(rounds):
    """By single effects where one is certain, else by the omnibus test; nothing where none is."""
    quiet = residuals(3, 400)
    product = residuals(3, 400, effect=lambda t, mean, u: share(u[:, 0] * np.roll(u[:, 0], 6), 0.3))
    found = [
        Found(effects.LevelShift(), Evidence("level shift", 1.0, q / 4, 3.0, 0.1), q)
        for q in (0.03, 0.02)
    ]
    nothing = rounds.left(Tested([quiet], [quiet], [], []))
    assert nothing.said == nothing.untested == ()
    assert nothing.p_values[0] > rounds.gate
    # Half of the level is 0.025.
    assert rounds.left(Tested([quiet], [quiet], found[:1], [])).said == ()
    both = rounds.left(Tested([quiet], [quiet], found, []))
    assert "level shift (0.02)" in both.said[0]
    assert both.p_values == ()
    better = Found(effects.LevelShift(), Evidence("level shift", 1.0, 1e-3, 3.0, 0.1), 4e-3)
    (said,) = rounds.left(Tested([quiet], [quiet], [better, *found], [])).said
    assert "level shift (0.004)" in said
    other = rounds.left(Tested([quiet], [product], [], []))
    assert other.p_values[0] <= rounds.gate
    assert "products of inputs" in other.said[0]


def test_what_cannot_be_tested_is_said_and_ends_nothing(rounds):
    """One of two outputs has too few samples where no fit has seen it: the other one is tested."""
    product = residuals(3, 400, effect=lambda t, mean, u: share(u[:, 0] * np.roll(u[:, 0], 6), 0.3))
    few = replace(
        product, output_name="few", held_out=np.arange(400) < SETTINGS.measured_samples - 1
    )
    left = rounds.left(Tested([few, product], [product, product], [], []))
    assert np.isnan(left.p_values[0])
    assert left.p_values[1] <= rounds.gate
    assert len(left.said) == len(left.untested) == 1
    assert "'few' was not tested" in left.untested[0]
    assert "expected at least 30" in left.untested[0]
    nothing, certain = rounds.beyond([few, product])
    assert (nothing.p_value, nothing.gain) == (1.0, 0.0)
    assert not nothing.fitted.any()
    assert certain.gain > 0.0
    state = SimpleNamespace(
        rounds=SimpleNamespace(
            level=0.05, gate=rounds.gate,
            data=SimpleNamespace(known=SimpleNamespace(output_names=("few", "y"))),
        ),
        rest=left, misses="", attempts=[], tests=[], number=1,
    )  # fmt: skip
    SearchState._list(state, [], [])
    assert [test.output for test in state.tests] == ["y"]  # no p-value where there was no test


def test_a_short_record_with_a_step_is_searched_to_its_end():
    """Half of the block that is searched goes to the fit: 30 samples in three stretches are left.

    A filter of a higher order than such stretches allow ended the loop with an error.
    """
    rng, n = np.random.default_rng(4), 240
    u = np.repeat(rng.standard_normal(n // 4), 4)
    y = lfilter([0.0, 0.2], [1.0, -0.8], u)
    y = y / y.std() + 0.05 * rng.standard_normal(n)
    y[135:] += 0.5
    record = dgp.Record(np.arange(float(n)), u, y)
    fit = dgp.fit(MODEL, record[:120], restarts=1, workers=1, progress=False, method="map")
    report = dgp.close_loop(fit, record, effects=(effects.LevelShift(),), workers=1, progress=False)
    assert [effect.name for effect in report.effects] == ["level shift"]
    assert report.outcome == "effects added"


def level_shift(gain: float) -> Found:
    return Found(effects.LevelShift(), Evidence("level shift", 5.0, 1e-6, gain, 0.1), 1e-5)


@pytest.mark.parametrize(
    ("gain", "product", "step", "doubtful"),
    [
        (8.0, 0.3, 0.0, True),  # products explain far more, and all of it
        (300.0, 0.3, 0.0, False),  # they explain less
        (8.0, 0.0, 0.0, False),  # they explain nothing
        (8.0, 0.3, 2.0, False),  # the step is there beside them
    ],
)
def test_an_effect_is_doubtful_where_a_cause_outside_the_catalogue_explains_it(
    rounds, gain, product, step, doubtful
):
    r = residuals(
        3, 400,
        effect=lambda t, mean, u: share(u[:, 0] * np.roll(u[:, 0], 6), product)
        + step * (t > t[200]),
    )  # fmt: skip
    beyond = rounds.beyond([r])
    assert (beyond[0].gain > 0.0) == (product > 0.0)
    assert rounds.doubtful(level_shift(gain), [r], beyond) == doubtful


@pytest.mark.parametrize(("gain", "doubtful"), [(8.0, True), (300.0, False)])
def test_noise_is_doubtful_where_a_cause_outside_the_catalogue_explains_far_more(
    rounds, gain, doubtful
):
    r = residuals(3, 400, effect=lambda t, mean, u: share(u[:, 0] * np.roll(u[:, 0], 6), 0.3))
    evidence = Evidence("heavy tails", 1.0, 1e-4, gain, 0.1)
    found = Found(effects.HeavyTails(), evidence, 1e-4)
    assert rounds.doubtful(found, [r], rounds.beyond([r])) == doubtful


def test_the_omnibus_test_looks_at_all_that_is_known_without_process_noise(rounds):
    fit = dgp.fit(
        MODEL, rounds.data.known[:240], restarts=1, workers=1, progress=False, method="map"
    )
    looked = rounds.look(fit, {"heavy tails"})
    (whole,), (searched,) = looked.whole, looked.residuals
    assert whole.held_out.all()
    assert not searched.held_out.all()
    assert (whole.mean != searched.mean).any()


def test_the_search_goes_on_without_process_noise_that_hides_what_is_missing():
    """The input acts five samples late; the fit with process noise explains that by noise."""
    record = oscillator(5, 0.0, seed=1)
    fit = dgp.fit(MODEL, record[:240], restarts=2, workers=1, progress=False, method="map")
    report = dgp.close_loop(
        fit, record, effects=(effects.DeadTime(), effects.ProcessNoise()), max_rounds=1,
        workers=1, progress=False,
    )  # fmt: skip
    assert [one.name for one in report.effects] == ["dead time"]
    assert sum("the extended model has it again" in one for one in report.warnings) == 1
    assert report.after["rmse"] < 0.05 < report.before["rmse"]  # the noise is 0.02
    assert has_process_noise(report.base.model)
    assert has_process_noise(report.fit.model)  # which is back where it does no harm


class OnlyBesideNoise(effects.LevelShift):
    """A step that cannot be added to a model without process noise."""

    def extend(self, model, evidence, record):
        return super().extend(model, evidence, record) if has_process_noise(model) else []


@pytest.mark.parametrize(
    ("effect", "said"),
    [
        (effects.LevelShift, "The search began without it"),
        (OnlyBesideNoise, "found nothing to add, and began again with it"),
    ],
)
def test_where_nothing_can_be_added_without_process_noise_the_search_begins_again_with_it(
    monkeypatch, effect, said
):
    monkeypatch.setattr(
        SearchContext, "hiding", lambda self, fit, plain: "" if fit is plain else "hides"
    )
    record = oscillator(0, 0.3, seed=3)
    y = record.outputs[:, 0] + 2.0 * (np.arange(N) >= 270)
    record = record.with_outputs(y)
    fit = dgp.fit(MODEL, record[:240], restarts=1, workers=1, progress=False, method="map")
    report = dgp.close_loop(
        fit, record, effects=(effect(),), max_rounds=1, workers=1, progress=False
    )
    assert [one.name for one in report.effects] == ["level shift"]
    assert report.after["rmse"] < 0.7 * report.before["rmse"]
    assert sum(said in one for one in report.warnings) == 1
    again = effect is OnlyBesideNoise
    assert has_process_noise(report.extended.model) == again
    assert {one.round for one in report.attempts if one.decision == "accepted"} == {1 + again}


@pytest.mark.parametrize(
    ("effect", "p", "certain", "fed_back"),
    [
        (effects.DeadTime(), 1e-4, [1e-9], True),
        (effects.ClockShift(), 1e-4, [1e-9], True),
        (effects.DeadTime(), 1e-12, [1e-9], False),  # what looks like feedback is this
        (effects.DeadTime(), 1e-4, [], False),
        (effects.LevelShift(), 1e-4, [1e-9], False),  # inputs have nothing to do with it
        (effects.ProcessNoise(), 1e-4, [1e-9], False),
    ],
)
def test_what_goes_with_inputs_under_feedback_is_not_tried(effect, p, certain, fed_back):
    def found(effect, p):
        return Found(effect, Evidence(effect.name, 5.0, p, 1.0, 0.1), 10.0 * p)

    course = SimpleNamespace(reported=[found(effects.Feedback(), one) for one in certain])
    assert SearchState._is_fed_back(course, found(effect, p)) == fed_back


@pytest.mark.parametrize(
    ("noise", "accepted", "returned", "dropped", "said"),
    [
        ((True, False), True, False, False, "the extended model does without it."),
        ((True, True), True, False, False, "the extended model has it again"),
        ((True, True), True, True, False, "found nothing to add, and began again with it."),
        ((True, False), False, True, True, "Nothing was found to add with or without it."),
        ((True, False), False, False, True, "Nothing was found to add without it."),
        ((True, False), False, False, False, "The search began without it."),  # and ended early
        ((False, False), True, False, False, "Fit it with process_noise=False"),  # in some layers
    ],
)
def test_what_was_done_about_noise_that_hides_is_said(noise, accepted, returned, dropped, said):
    first, current = (
        SimpleNamespace(model=MODEL if one else without_process_noise(MODEL)) for one in noise
    )
    course = SimpleNamespace(
        hidden="forecasts better", first=first, current=current, added=accepted,
        returned=returned, dropped=dropped,
    )  # fmt: skip
    (sentence,) = said_of_hiding(course)
    assert sentence.startswith("The model as given forecasts better")
    assert said in sentence
    course.hidden = ""
    assert said_of_hiding(course) == []
