"""Variants of an effect race from what their base has learnt; which of them run."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

import pyro_dynogp as dgp
from pyro_dynogp import effects
from pyro_dynogp.data.channels import Delayed, Play, Recorded, Step, Trend
from pyro_dynogp.discrepancy import leading_variant, trials
from pyro_dynogp.discrepancy.failures import why_not
from pyro_dynogp.discrepancy.held_out import forecast_errors, held_out_density
from pyro_dynogp.discrepancy.search import candidates_of
from pyro_dynogp.discrepancy.trials import Trial, run
from pyro_dynogp.inference import refit as refits
from pyro_dynogp.inference.bayes_factor import energy
from pyro_dynogp.inference.density import Potential
from pyro_dynogp.inference.methods.base import Problem
from pyro_dynogp.inference.refit import race, refit
from pyro_dynogp.inference.run import Run
from pyro_dynogp.inference.starts.extended import extended_starts
from pyro_dynogp.inference.starts.linear import fresh_starts
from pyro_dynogp.models.delays import longest_delay, unknown_beginning
from pyro_dynogp.models.variants import (
    with_channel,
    with_output_function,
    with_pairs,
    without_process_noise,
)
from tests.discrepancy.made import SETTINGS, coloured, fitted_mode
from tests.discrepancy.plant_dynamics import System, response
from tests.discrepancy.test_decision import spoken_for, two_inputs

N, STEP, LATE = 300, 0.1, 5
MODEL = dgp.LinearDynamicGP(1, pairs=1)
RUN = Run(0, workers=1)


@pytest.fixture(scope="module")
def record():
    """The output follows the input five samples late; a recorded channel never moves."""
    rng = np.random.default_rng(5)
    u = coloured(rng, N + LATE, 0.6)
    system = System(np.array([-0.3 + 0.4j]), np.array([[0.3 - 0.2j]]))
    y = response(system, u[:N, None])
    y = y / y.std() + 0.05 * rng.standard_normal(N)
    return dgp.Record(
        STEP * np.arange(N), u[LATE:, None], y[:, None], input_names=("u",),
        extra={"still": np.ones(N)},
    )  # fmt: skip


@pytest.fixture(scope="module")
def base(record):
    return fitted_mode(MODEL, record)


def later(samples: float) -> dgp.LinearDynamicGP:
    return with_channel(MODEL, Delayed("u", samples * STEP))


def test_the_most_probable_variant_comes_first(record, base):
    delays = (1, 2, 3, 4, 5, 6, 8, 11)
    found, problems = race(base, [later(d) for d in delays], record, RUN)
    assert not problems
    assert len(found) == len(delays)
    assert [energy(one) for one in found] == sorted(energy(one) for one in found)
    assert replace(found[0].model, scaling=None) == later(LATE)
    assert energy(found[0]) < energy(base) - 100.0
    # To its end the winner's climb gains little, and no other variant would have come before it.
    whole = {d: energy(refit(base, record, model=later(d))) for d in delays}
    assert min(whole, key=lambda d: whole[d]) == LATE
    assert energy(found[0]) - whole[LATE] < 4.0


def test_those_behind_take_only_the_first_steps(monkeypatch, record, base):
    taken = []

    def counted(fit, records, *, model=None, run):
        taken.append((model is None, run.steps))
        return refit(fit, records, model=model, run=run)

    monkeypatch.setattr(refits, "refit", counted)
    found, _ = race(base, [later(d) for d in range(1, 9)], record, RUN)
    first, more = refits.FIRST_STEPS[0], refits.MORE_STEPS[0]
    assert taken == [(False, first)] * 8 + [(True, more)] * refits.FEWEST
    assert all(len(one.history) <= first for one in found[refits.FEWEST :])


def climbs_of(monkeypatch, name):
    """Optimizer and starts of every call of a climb of `refits`."""
    calls, climb = [], getattr(refits, name)

    def noted(model, records, starts, *args, **options):
        calls.append((options["optimizer"], starts))
        return climb(model, records, starts, *args, **options)

    monkeypatch.setattr(refits, name, noted)
    return calls


def test_with_steps_the_most_probable_start_of_a_linear_model_climbs_alone(
    monkeypatch, record, base
):
    calls = climbs_of(monkeypatch, "maximise")
    model = later(LATE)
    problem = Problem.of(model, record)
    starts, _ = extended_starts(base, problem.model, problem.records, 0)
    monkeypatch.setattr(refits, "extended_starts", lambda *given: (starts[::-1], starts[0]))
    potential = Potential(problem.target, (problem.records,), starts[0])
    # The base has learnt its gains without the delay: least squares are nearer.
    assert potential.log_joint(starts[0]) > potential.log_joint(starts[-1]) + 10.0
    fresh: list[dict[str, torch.Tensor]] = []
    monkeypatch.setattr(refits, "fresh_starts", lambda *given, compared: fresh)
    refit(base, record, model=model, run=replace(RUN, steps=1))
    ((optimizer, (start,)),) = calls
    assert optimizer == "gauss-newton"
    assert start is starts[0]
    refit(base, record, model=model, run=RUN)
    assert len(calls[1][1]) == len(starts)
    fresh += starts[:1]
    refit(base, record, model=model, run=RUN)
    assert len(calls[2][1]) == len(starts) + 1


@pytest.mark.parametrize(
    ("model", "alone", "compared"),
    [
        (MODEL, False, False),
        (later(LATE), True, True),  # learnt poles have imitated the dead time
        (dgp.LinearDynamicGP(1, pairs=2), True, False),
        (dgp.LinearDynamicGP(1, pairs=1, integrators=1), True, False),
    ],
)
def test_which_linear_models_have_starts_of_a_first_fit_as_well(record, model, alone, compared):
    problem = Problem.of(model, record)
    for expected, variants in ((alone, False), (compared, True)):
        found = fresh_starts(MODEL, problem.target, problem.records, 0, compared=variants)
        assert bool(found) == expected
    # A dead time that there is already is learnt.
    late = later(2 * LATE)
    assert not fresh_starts(late, problem.target, problem.records, 0, compared=True)


def test_a_function_more_is_climbed_by_adam_from_what_is_learnt(monkeypatch, record, base):
    calls = climbs_of(monkeypatch, "climb")
    refit(base, record, model=with_output_function(MODEL), run=replace(RUN, steps=2))
    ((optimizer, starts),) = calls
    assert (optimizer, len(starts)) == ("adam", 2)


def test_a_function_more_is_climbed_from_linear_fits_of_its_own_too():
    """The sensor reports a size: the optimum of the linear model leads nowhere."""
    record = dgp.datasets.load("coupled_drives", record=1).train[:260]
    linear = dgp.LinearDynamicGP(1, pairs=3, process_noise=False)
    model = dgp.Cascade(1, (dgp.Dynamic(pairs=3, process_noise=False), dgp.Static()))
    base = dgp.fit(linear, record, method="map", workers=1, progress=False)
    first = dgp.fit(model, record, method="map", restarts=4, workers=1, progress=False)
    # Of what the base has learnt alone: some 150 nats less.
    assert energy(refit(base, record, model=model, run=RUN)) < energy(first) + 100.0


@pytest.mark.parametrize(
    ("channels", "said"),
    [
        ((Recorded("still"),), "'still' is constant on the training block"),
        ((Step(25.0),), "'step at 25' is constant on the training block"),
        (
            (
                Delayed("u", 0.2),
                Play("u delayed", 0.4),
                Recorded("still"),
            ),
            "'still' is constant on the training block",
        ),
        ((Trend(0.0, 30.0), Trend(0.0, 30.0)), "the model has 'trend' already"),
    ],
)
def test_why_a_trial_failed_is_said_in_words_of_the_data(record, base, channels, said):
    model = MODEL
    for channel in channels:
        model = with_channel(model, channel)
    fold = np.arange(N) >= 200
    found = run(Trial((model,), record, (fold,), base, 0, SETTINGS, "forecast"))
    assert found.failure == said
    assert "Record.select" not in found.failure


def test_what_else_a_refit_refuses_is_said_without_advice(record, base):
    trial = Trial((MODEL,), record, (np.arange(N) >= 200,), base, 0, SETTINGS)
    error = ValueError("record: expected 7 samples, got 3. Give a longer one (Record.select).")
    assert (
        why_not(trial.models, trial.record, trial.folds, error)
        == "record: expected 7 samples, got 3"
    )


def test_errors_of_forecasts_are_kept_whatever_is_scored(record, base):
    fold = np.arange(N) >= 200
    for score in ("one step", "forecast"):
        found = run(Trial((MODEL,), record, (fold,), base, 0, SETTINGS, score))
        assert found.errors.shape == (100, 1)
        wanted = forecast_errors(found.fit, record, fold)[0][fold]
        np.testing.assert_array_equal(found.errors, wanted)
        density = held_out_density(found.fit, record, fold, score)
        np.testing.assert_array_equal(found.densities, density)


def test_what_cannot_be_fitted_is_said(record, base):
    still = with_channel(MODEL, Recorded("still"))
    found, (problem,) = race(base, [still, later(LATE)], record, RUN)
    assert len(found) == 1
    assert "constant" in str(problem)
    assert race(base, [], record, RUN) == ([], [])


def test_a_cascade_that_is_no_larger_goes_on_from_its_base(record):
    model = dgp.Wiener(1, pairs=1, inducing=4, process_noise=False)
    start = dgp.fit(model, record[:150], method="map", restarts=1, steps=30, workers=1,
                    progress=False)  # fmt: skip
    delayed = [with_channel(model, Delayed("u", d * STEP)) for d in (3, LATE)]
    found, _ = race(start, delayed, record[:150], RUN)
    assert replace(found[0].model, scaling=None) == delayed[1]
    assert energy(found[0]) < energy(start) - 50.0
    assert without_process_noise(found[0].model) == found[0].model


def test_other_noise_goes_on_from_a_linear_base(record):
    outliers = record.outputs.copy()
    outliers[20::25] += 2.0
    spoilt = record.with_outputs(outliers)
    base = fitted_mode(later(LATE), spoilt)
    robust = replace(later(LATE), likelihood=dgp.StudentT())
    plain = later(LATE)
    found, _ = race(base, [plain, robust], spoilt, RUN)
    first, second = found
    assert replace(first.model, scaling=None) == robust
    # The same model under another name is as probable; twelve outliers are not normal.
    assert energy(second) == pytest.approx(energy(base), abs=1.0)
    assert energy(first) < energy(base) - 100.0


def test_a_variant_is_tried_for_one_channel_only():
    data, model = two_inputs(), dgp.LinearDynamicGP(inputs=2, pairs=1)
    first = spoken_for(effects.DeadTime(), 0.001, 0.01, channel="a", delay=7200.0)
    second = spoken_for(effects.DeadTime(), 0.002, 0.01, channel="b", delay=9000.0)
    (_, some), (_, others) = candidates_of([first, second], model, data, 0.05, 8, SETTINGS)
    assert others
    assert len(others) < len(some)
    assert not {repr(one) for one in some} & {repr(one) for one in others}
    assert len(candidates_of([first, first], model, data, 0.05, 8, SETTINGS)) == 1


def test_a_saturation_knows_its_limits_and_a_function_goes_on_as_a_line():
    where = {"low": -np.inf, "high": 0.7}
    record = dgp.Record(STEP * np.arange(5), np.zeros((5, 1)), np.zeros((5, 1)))
    limits = spoken_for(effects.Saturation(), 1e-9, 1e-8, **where).evidence
    curve = spoken_for(effects.OutputNonlinearity(), 1e-9, 1e-8).evidence

    def last(effect, model, evidence):
        (extended,) = effect.extend(model, evidence, record)
        return extended.layers[-1]

    stops = last(effects.Saturation(), MODEL, limits)
    assert (stops.mean, stops.limits) == ("linear", (None, 0.7))
    bends = last(effects.OutputNonlinearity(), MODEL, curve)
    assert (bends.mean, bends.limits) == ("linear", None)
    # Which output they are of is not known, or something comes on top of the sensor.
    for model in (
        replace(MODEL, layers=(replace(MODEL.layers[0], outputs=2),)),
        with_channel(MODEL, Trend(0.0, 1.0)),
    ):
        assert last(effects.Saturation(), model, limits).limits is None


def test_limits_are_followed_for_as_long_as_they_gain():
    """From a test that was a quarter of the width off; two steps of each size do not lead there."""
    rng = np.random.default_rng(0)
    u = 1.5 * coloured(rng, 600, 0.6)
    system = System(np.array([-0.3 + 0.4j]), np.array([[0.3 - 0.2j]]))
    y = response(system, (u - np.clip(u, -0.5, 0.9))[:, None])
    y = y / y.std() + 0.05 * rng.standard_normal(len(y))
    record = dgp.Record(STEP * np.arange(len(y)), u[:, None], y[:, None], input_names=("u",))
    fold = np.arange(len(y)) >= 500
    fit = fitted_mode(MODEL, record[:500])
    effect = effects.DeadZoneOfInput()
    found = spoken_for(effect, 1e-9, 1e-9, channel="u", low=-0.9, high=0.5)
    variants = tuple(effect.extend(MODEL, found.evidence, record))
    trial = Trial(variants, record, (fold,), fit, 0, SETTINGS, "forecast", refine=effect.refine)
    (zone,) = run(trial).model.channels
    # The smallest steps are 5 % of the width of 1.4, of which the fit tells a few hundredths.
    assert zone.low == pytest.approx(-0.5, abs=0.06)
    assert zone.high == pytest.approx(0.9, abs=0.06)


def test_no_variant_is_later_than_all_are_compared_for(monkeypatch, record, base):
    """Beyond that it would have fewer samples than the others."""
    asked = []

    def noted(fit, models, same, run):
        asked.append((longest_delay(*models), int(np.isnan(same.outputs[:, 0]).sum())))
        return race(fit, models, same, run)

    for module in (trials, leading_variant):
        monkeypatch.setattr(module, "race", noted)
    fold = np.arange(len(record)) >= 200
    # Each time something later is near, and looks better than it is.
    steps = iter([later(4.0), later(3.5), later(3.7), later(9.0), later(12.0)])
    trial = Trial(
        (later(2.0), later(3.0)), record, (fold,), base, 0, SETTINGS, "forecast",
        refine=lambda model, data, times: [next(steps, later(20.0))],
    )  # fmt: skip
    run(trial)
    (_, missing), *further = asked
    assert missing == unknown_beginning(record, SETTINGS.reach * 4.0 * STEP)  # of what is to come
    assert len(further) > 1
    longest = SETTINGS.reach * 3.0 * STEP  # of the variants that lead
    assert all(delay <= longest + 1e-12 for delay, _ in further)
    assert {missing for _, missing in further} == {unknown_beginning(record, longest)}


def test_functions_are_fitted_from_the_base_once_a_variant_is_chosen(monkeypatch, record):
    """Few steps of a race may lead to a poor optimum; a linear model goes on from there."""
    fold, calls = np.arange(N) >= 200, []

    def noted(fit, records, *, model=None, run=None):
        calls.append(fit)
        return refit(fit, records, model=model, run=run)

    monkeypatch.setattr(trials, "refit", noted)
    for model in (MODEL, dgp.Hammerstein(1, pairs=1, inducing=8, process_noise=False)):
        start = fitted_mode(model, record[:200])
        variants = tuple(with_channel(model, Delayed("u", k * STEP)) for k in (4, 5))
        run(Trial(variants, record, (fold,), start, 0, SETTINGS, "forecast"))
        assert (calls[-1] is start) == model.has_function


@pytest.mark.parametrize("compared", ["training", "known"])
def test_variants_of_an_instant_are_compared_on_all_known_data(record, base, monkeypatch, compared):
    """The instant may be held out; what is kept is fitted to the training data all the same."""
    fold, seen, refined, fitted = np.arange(len(record)) >= 200, [], [], []

    def raced(fit, models, data, run):
        seen.append(int(np.isfinite(data.outputs[:, 0]).sum()))
        return race(fit, models, data, run)

    def noted(fit, data, *, model=None, run=None):
        fitted.append(int(np.isfinite(data.outputs[:, 0]).sum()))
        return refit(fit, data, model=model, run=run)

    def finer(model, data, times):
        refined.append(int(np.isfinite(data.outputs[:, 0]).sum()))
        return []

    monkeypatch.setattr(leading_variant, "race", raced)
    monkeypatch.setattr(trials, "refit", noted)
    plain = replace(base.model, scaling=None)
    trial = Trial(
        (plain, with_pairs(plain, 1)), record, (fold,), base, 0, SETTINGS, "forecast",
        refine=finer, compared=compared,
    )  # fmt: skip
    assert not run(trial).failure
    own = len(record) if compared == "known" else 200
    assert set(seen) == {own}
    assert set(refined) == {own}
    assert fitted == [200]


def test_what_has_no_finer_variants_races_once(monkeypatch, record, base):
    asked = []

    def noted(fit, models, same, run):
        asked.append(len(models))
        return race(fit, models, same, run)

    for module in (trials, leading_variant):
        monkeypatch.setattr(module, "race", noted)
    fold = np.arange(len(record)) >= 200
    run(Trial((later(4.0), later(5.0)), record, (fold,), base, 0, SETTINGS, "forecast"))
    assert asked == [2]
