"""Refits of extended models: what they start from, and how far they get."""

from dataclasses import dataclass, replace
from types import SimpleNamespace

import numpy as np
import pyro
import pytest
import torch

import pyro_dynogp as dgp
from pyro_dynogp.criticism.comparison import block_standard_error
from pyro_dynogp.data.channels import Recorded
from pyro_dynogp.discrepancy import held_out, trials
from pyro_dynogp.discrepancy.failures import TimeLimitError
from pyro_dynogp.discrepancy.held_out import held_out_density
from pyro_dynogp.effects.nonlinear_feedback import NonlinearFeedbackOfOutput
from pyro_dynogp.inference import refit as refits
from pyro_dynogp.inference.methods.base import Problem
from pyro_dynogp.inference.optimise.maximum import maximise
from pyro_dynogp.inference.refit import refit
from pyro_dynogp.inference.run import Run
from pyro_dynogp.inference.starts.extended import extended_starts
from pyro_dynogp.inference.starts.poles import grown
from pyro_dynogp.models.feedback_variants import with_feedback
from pyro_dynogp.models.variants import (
    with_channel,
    with_input_function,
    with_output_function,
    with_pairs,
    without_process_noise,
)
from tests.discrepancy.made import SETTINGS, coloured, fitted_mode
from tests.discrepancy.plant_dynamics import System, response

NOISE, N, TRAINING = 0.05, 320, 220


@dataclass(frozen=True, eq=False)
class Made:
    """A fit of which the model, its density of held-out data and its evidence are asked for."""

    model: dgp.LinearDynamicGP
    level: float
    evidence: float = 0.0
    records: tuple[dgp.Record, ...] = ()


@pytest.fixture(scope="module")
def record():
    """A sensor curve behind the responses to u and to "w"; nothing else acts."""
    rng = np.random.default_rng(3)
    u, w = coloured(rng, N, 0.9), coloured(rng, N, 0.9)
    system = System(np.array([-0.15 + 0.25j]), np.array([[0.2 - 0.3j, -0.1 - 0.2j]]))
    g = response(system, np.column_stack([u, w]))
    g /= g.std()
    y = np.tanh(g) + 0.3 * np.tanh(g) ** 2 + NOISE * rng.standard_normal(N)
    return dgp.Record(
        time=0.1 * np.arange(N), inputs=u[:, None], outputs=y[:, None], extra={"w": w}
    )


@pytest.fixture(scope="module")
def base(record):
    model = dgp.Wiener(1, pairs=1, inducing=6)
    training = record[:TRAINING]
    fit = dgp.fit(model, training, method="map", restarts=1, steps=60, workers=1, progress=False)
    return refit(fit, training, model=model)


def log_likelihood(model, records, values):
    trace = pyro.poutine.trace(pyro.poutine.condition(model, data=values)).get_trace(records)
    trace.compute_log_prob()
    return float(trace.nodes["y"]["log_prob_sum"])


@pytest.mark.parametrize("more", ["channel", "pair"])
def test_what_has_grown_starts_at_the_likelihood_of_its_base(record, base, more):
    plain = replace(base.model, scaling=None)
    extended = with_channel(plain, Recorded("w")) if more == "channel" else with_pairs(plain, 1)
    problem = Problem.of(extended, record[:TRAINING])
    target, records = problem.target, problem.records
    (learnt,), start = extended_starts(base, target, records, 0)
    before = log_likelihood(base.model.collapsed, base.model.prepare(record[:TRAINING]), base.mode)
    after = log_likelihood(target, records, learnt)
    loud = log_likelihood(target, records, grown(base.mode, start))
    # A new pair has a little process noise already.
    assert after == pytest.approx(before, rel=1e-9 if more == "channel" else 1e-2)
    assert abs(loud - before) > 4.0 * max(abs(after - before), 1.0)


@pytest.mark.parametrize("first", [True, False])
@pytest.mark.parametrize("kind", ["linear", "Wiener", "Hammerstein"])
def test_a_function_more_starts_as_a_line(record, base, kind, first):
    """The model with it explains what its base does, of whatever layers that is."""
    training = record[:TRAINING]
    if kind == "linear":
        given = fitted_mode(dgp.LinearDynamicGP(1, pairs=1), training)
    else:
        given = base
        if kind == "Hammerstein":
            model = dgp.Hammerstein(1, pairs=1, inducing=6)
            given = dgp.fit(model, training, method="map", restarts=1, steps=60, workers=1,
                            progress=False)  # fmt: skip
    plain = replace(given.model, scaling=None)
    extended = with_input_function(plain) if first else with_output_function(plain)
    if extended is None:  # there is one already
        assert kind == ("Hammerstein" if first else "Wiener")
        return
    problem = Problem.of(extended, training)
    target = problem.target
    (learnt, *curved), _ = extended_starts(given, target, problem.records, 0)
    before = log_likelihood(given.model.collapsed, given.model.prepare(training), given.mode)
    assert log_likelihood(target, problem.records, learnt) == pytest.approx(before, abs=5.0)
    assert len(curved) == (not first)


def test_an_extended_cascade_explains_what_its_base_lacks(record, base):
    training, fold = record[:TRAINING], np.arange(N) >= TRAINING
    model = with_channel(replace(base.model, scaling=None), Recorded("w"))
    fit = refit(base, training, model=model)
    assert float(fit.start_energies[0]) < float(base.start_energies[0]) - 50.0
    gain = held_out_density(fit, record, fold, "forecast")
    gain = gain - held_out_density(base, record, fold, "forecast")
    # What the loop asks of an effect.
    assert gain.sum() > max(SETTINGS.gain, SETTINGS.standard_errors * block_standard_error(gain)[0])
    error = fit.forecast(training, record[TRAINING:]).mean - record.outputs[TRAINING:]
    # 100 samples; the bend and both responses are known to some 10 % of the noise each.
    assert np.sqrt(np.mean(error**2)) < 1.3 * NOISE


def test_the_same_model_goes_on_from_where_it_is(record, base):
    again = refit(base, record[:TRAINING], model=base.model)
    assert float(again.start_energies[0]) <= float(base.start_energies[0]) + 1e-6


def test_a_climb_without_process_noise_comes_first(monkeypatch, record, base):
    calls = []

    def recorded(model, records, starts, run, **options):
        found = maximise(model, records, starts, run, **options)
        calls.append((model, starts, found))
        return found

    monkeypatch.setattr(refits, "maximise", recorded)
    monkeypatch.setattr(refits, "LAYERED_STEPS", 5)
    training, run = record[:TRAINING], Run(0, workers=1)
    model = with_channel(replace(base.model, scaling=None), Recorded("w"))
    found = refit(base, training, model=model, run=run)
    problem = Problem.of(model, [training])
    (_, new) = extended_starts(base, problem.target, problem.records, 0)
    (quiet, (loud,), without), (_, (first, second), optima) = calls
    assert not quiet.layers[0].process_noise
    assert float(loud["noise_sd"]) >= 0.5
    torch.testing.assert_close(first["f_values"], base.mode["f_values"])
    torch.testing.assert_close(second["f_values"], without[0].values["f_values"])
    torch.testing.assert_close(second["g_noise_gain_unit"], new["g_noise_gain_unit"])
    assert found.start_energies.tolist() == [one.energy for one in optima]
    # Where there is no such noise, and to compare variants, one climb is enough.
    for one, own in ((without_process_noise(model), run), (model, replace(run, steps=5))):
        calls.clear()
        refit(base, training, model=one, run=own)
        ((_, starts, _),) = calls
        assert len(starts) == 1


def test_models_without_process_noise_stay_as_they_are():
    for model in (
        dgp.Wiener(1, process_noise=False),
        dgp.LinearDynamicGP(1, process_noise=False),
        dgp.Cascade(1, (dgp.Dynamic(pairs=1, process_noise=False),)),
    ):
        assert without_process_noise(model) == model
    assert not without_process_noise(dgp.LinearDynamicGP(1)).layers[0].process_noise


def refitted_by(monkeypatch, again, noise=False):
    """Refits are made by `again`, and gain their level in nine samples; certain is one nat.

    Their errors of forecasts are noise alone, or not.
    """

    def density(fit, *_):
        return np.full(9, fit.level / 9)

    monkeypatch.setattr(trials, "refit", again)
    monkeypatch.setattr(refits, "refit", again)
    monkeypatch.setattr(trials, "held_out_density", density)
    monkeypatch.setattr(trials, "scored", lambda fit, *_: (density(fit), np.zeros((9, 1))))
    monkeypatch.setattr(trials, "are_noise", lambda errors, fit, most=0.0: noise)
    for module in (trials, held_out):
        monkeypatch.setattr(module, "certain", lambda gain, settings: gain.sum() > 1.0)
    monkeypatch.setattr(
        held_out, "log_bayes_factor", lambda one, other: one.evidence - other.evidence
    )


@pytest.mark.parametrize(
    ("gains", "hidden", "substeps"),
    [
        ((0.0, 50.0, 50.0), 1, 3),  # better again with substeps
        ((0.0, 50.0, 0.1), 1, 1),  # no better with them
        ((0.0, 0.1, 50.0), 0, 1),  # of the output: no step, and nothing to divide
    ],
)
def test_a_step_has_substeps_where_they_are_better(record, monkeypatch, gains, hidden, substeps):
    """Each variant and the finer one gain so many nats over those before.

    The finer one is refitted from what is kept, once it is to be added.
    """
    plain = dgp.LinearDynamicGP(1, pairs=1)
    models = (with_feedback(plain), with_feedback(plain, output=False, hidden=True))
    made, began = [], []

    def again(fit, training, *, model, run):
        made.append(Made(model, sum(gains[: len(made) + 1])))
        began.append(fit)
        return made[-1]

    refitted_by(monkeypatch, again)
    fold = np.arange(N) >= TRAINING
    base = SimpleNamespace(model=plain)
    trial = trials.Trial(models, record, (fold,), base, 0, SETTINGS, compared="held out")
    tried = trials.run(trial)
    assert tried.model.dynamic[0][1].hidden == hidden
    assert tried.model.substeps == 1
    assert len(made) == 2
    finer = trials.with_substeps(trial, tried)
    assert finer.model.dynamic[0][1].hidden == hidden
    assert finer.model.substeps == substeps
    assert (finer is tried) == (substeps == 1)
    assert len(made) == 2 + hidden
    assert began[:2] == [base, base]
    assert began[2:] == [tried.fit] * hidden


@pytest.mark.parametrize(
    ("levels", "noise", "fitted", "kept"),
    [
        ((5.0, -3.0, 9.0), False, 3, 2),
        ((-3.0, 0.5, 9.0), False, 3, 2),
        ((-3.0, 0.5, 1.0), False, 3, 1),  # certain is more than one nat
        ((-3.0, -1.5, 9.0), False, 2, 1),  # neither forecasts better than the base
        ((-1.0, 0.0, 9.0), False, 2, 0),
        ((5.0, -3.0, 9.0), True, 2, 0),  # one leaves nothing to explain
        ((-3.0, 0.5, 9.0), True, 2, 1),
    ],
)
def test_both_functions_together_are_fitted_where_one_of_them_helps_and_leaves_something(
    record, monkeypatch, levels, noise, fitted, kept
):
    plain = dgp.LinearDynamicGP(1, pairs=1)
    models = (with_feedback(plain), with_feedback(plain, output=False, hidden=True),
              with_feedback(plain, hidden=True))  # fmt: skip
    made = []

    def again(fit, training, *, model, run):
        made.append(Made(model, levels[len(made)], records=(record,)))
        return made[-1]

    refitted_by(monkeypatch, again, noise)
    fold = np.arange(N) >= TRAINING
    trial = trials.Trial(models, record, (fold,), Made(plain, 0.0), 0, SETTINGS,
                         compared="held out")  # fmt: skip
    tried = trials.run(trial)
    assert len(made) == fitted
    assert tried.model == models[kept]


# Variants of a nonlinear feedback in their order.
VARIANTS = (
    "feedback", "cube_of_output", "step_of_output", "root_of_output", "cube_of_hidden",
    "step_of_hidden", "root_of_hidden", "hidden_feedback", "feedback_product", "hidden_product",
    "step", "forms", "hidden_forms", "compartments", "states", "hysteresis", "both",
)  # fmt: skip


@pytest.mark.parametrize(
    ("usual", "levels", "noise", "last"),
    [
        (6.0, {"hidden_feedback": 9.0}, (), "both"),
        # Forms, products, compartments and a hysteresis are tried whatever functions do.
        (-3.0, {"hidden_feedback": 1.0}, (), "both"),
        # Both functions are not where nothing helps,
        (-3.0, {"hidden_feedback": -1.0}, (), "hysteresis"),
        # nor where forms lead, nor products, nor compartments, nor a hysteresis,
        *((-3.0, {"hidden_feedback": 1.0, name: 3.0}, (), "hysteresis") for name in (
            "cube_of_output", "root_of_hidden", "hidden_product", "forms", "compartments",
            "hysteresis")),
        # but where a step does.
        (-3.0, {"hidden_feedback": 1.0, "step": 3.0}, (), "both"),
        # The rest is not beside noise alone: forms, products, a step, compartments,
        *((6.0, {"hidden_feedback": 9.0, name: 20.0}, (20.0,), name) for name in (
            "cube_of_output", "root_of_output", "step_of_hidden", "feedback_product", "step",
            "forms", "hidden_forms", "compartments")),
        # unless another one forecasts better.
        (6.0, {"hidden_feedback": 9.0, "hidden_product": 7.0}, (7.0,), "both"),
        (6.0, {"hidden_feedback": 9.0}, (9.0,), "hidden_feedback"),
    ],
)  # fmt: skip
def test_later_variants_are_fitted_one_by_one_while_something_is_left(
    record, monkeypatch, usual, levels, noise, last
):
    plain = dgp.LinearDynamicGP(1, pairs=2)
    said = SimpleNamespace(where={"output": "y", "products": 0.9})
    models = tuple(NonlinearFeedbackOfOutput().extend(plain, said, record))
    assert len(models) == len(VARIANTS)
    levels = [(levels | {"both": 9.0}).get(name, usual) for name in VARIANTS]
    fitted = VARIANTS.index(last) + 1
    made = []

    def again(fit, training, *, model, run):
        made.append(Made(model, levels[len(made)], records=(record,)))
        return made[-1]

    refitted_by(monkeypatch, again)
    monkeypatch.setattr(
        trials, "are_noise", lambda errors, fit, most=0.0: most == 0.0 and fit.level in noise
    )
    fold = np.arange(N) >= TRAINING
    trial = trials.Trial(models, record, (fold,), Made(plain, 0.0), 0, SETTINGS,
                         compared="held out")  # fmt: skip
    trials.run(trial)
    assert [one.model for one in made] == list(models[:fitted])


@pytest.mark.parametrize(
    ("model", "kept"), [(dgp.Wiener(1), True), (dgp.LinearDynamicGP(1), False)]
)
def test_with_functions_later_folds_begin_where_the_first_one_ended(
    record, monkeypatch, model, kept
):
    base, first = (SimpleNamespace(model=replace(model, scaling=None)) for _ in range(2))
    begun = []

    def again(start, *_, **__):
        begun.append(start)
        return first

    monkeypatch.setattr(trials, "_kept", lambda *_: first)
    monkeypatch.setattr(trials, "refit", again)
    monkeypatch.setattr(trials, "scored", lambda *_: (np.zeros(2), np.zeros((2, 1))))
    folds = tuple(np.arange(N) // 80 == k for k in range(3))
    tried = trials.run(trials.Trial((model,), record, folds, base, 0, SETTINGS))
    assert [one is first for one in begun] == [kept, kept]
    assert len(tried.densities) == 6


@pytest.mark.parametrize("workers", [1, 2, 3, 40])
@pytest.mark.parametrize(("noise", "kept"), [(20.0, "step_of_hidden"), (None, "hysteresis")])
def test_variants_that_are_fitted_side_by_side_come_to_the_same(
    record, monkeypatch, workers, noise, kept
):
    """As many at a time as there are processes; what is not wanted after all does not count."""
    plain = dgp.LinearDynamicGP(1, pairs=2)
    said = SimpleNamespace(where={"output": "y", "products": 0.9})
    models = NonlinearFeedbackOfOutput().extend(plain, said, record)
    special = {"step_of_hidden": 20.0, "hysteresis": 25.0}
    levels = [special.get(name, float(place)) for place, name in enumerate(VARIANTS)]
    groups = []

    def side_by_side(function, places, *, workers, progress, description):
        groups.append(len(places))
        return [function(place) for place in places]

    def again(fit, training, *, model, run):
        return Made(model, levels[models.index(model)], records=(record,))

    refitted_by(monkeypatch, again)
    monkeypatch.setattr(trials, "parallel_map", side_by_side)
    monkeypatch.setattr(
        trials, "are_noise", lambda errors, fit, most=0.0: most == 0.0 and fit.level == noise
    )
    fold = np.arange(N) >= TRAINING
    trial = trials.Trial(tuple(models), record, (fold,), Made(plain, 0.0), 0, SETTINGS,
                         compared="held out")  # fmt: skip
    assert trials.run(trial, trials.Ahead(workers)).model == models[VARIANTS.index(kept)]
    assert max(groups) == min(workers, len(models))


@pytest.mark.parametrize(("asked", "fitted"), [(1, 0), (3, 2)])
def test_no_variant_is_begun_once_the_time_limit_has_passed(record, monkeypatch, asked, fitted):
    """And a trial that the limit ends comes to nothing: what is left may have been better."""
    plain = dgp.LinearDynamicGP(1, pairs=2)
    said = SimpleNamespace(where={"output": "y", "products": 0.9})
    models = NonlinearFeedbackOfOutput().extend(plain, said, record)
    done = []

    def again(fit, training, *, model, run):
        done.append(model)
        return Made(model, 0.0, records=(record,))

    refitted_by(monkeypatch, again)
    monkeypatch.setattr(trials, "are_noise", lambda errors, fit, most=0.0: False)
    trial = trials.Trial(tuple(models), record, (np.arange(N) >= TRAINING,), Made(plain, 0.0), 0,
                         SETTINGS, compared="held out")  # fmt: skip
    answers = iter([False] * (asked - 1) + [True])
    with pytest.raises(TimeLimitError):
        trials.run(trial, trials.Ahead(late=answers.__next__))
    assert len(done) == fitted


@pytest.mark.parametrize("little", [(), ("fits",), ("base",), ("fits", "base")])
def test_other_dynamics_are_tried_where_more_than_a_little_is_left(record, monkeypatch, little):
    """By the noise of the best variant and of the base: that of a poor fit may be too large."""
    plain = dgp.LinearDynamicGP(1, pairs=2)
    said = SimpleNamespace(where={"output": "y", "products": 0.9})
    models = tuple(NonlinearFeedbackOfOutput().extend(plain, said, record))
    made = []

    def again(fit, training, *, model, run):
        made.append(Made(model, -3.0, records=(record,)))
        return made[-1]

    refitted_by(monkeypatch, again)
    base = Made(plain, 0.0)

    def are_noise(errors, fit, most=0.0):
        return most == trials.LITTLE_ELSE and ("base" if fit is base else "fits") in little

    monkeypatch.setattr(trials, "are_noise", are_noise)
    fold = np.arange(N) >= TRAINING
    trials.run(trials.Trial(models, record, (fold,), base, 0, SETTINGS, compared="held out"))
    fitted = [one.model for one in made]
    left = {name for name, model in zip(VARIANTS, models, strict=True) if model not in fitted}
    others = {"compartments", "states", "hysteresis"}
    assert left - {"both"} == (others if len(little) == 2 else set())


@pytest.mark.parametrize("compared", ["held out", "rehearsed"])
@pytest.mark.parametrize(
    ("failing", "kept"), [((), 2), ((0,), 2), ((0, 1), 2), ((2,), 0), ((0, 1, 2), None)]
)
def test_variants_that_cannot_be_fitted_are_left_out(record, monkeypatch, failing, kept, compared):
    plain = dgp.LinearDynamicGP(1, pairs=1)
    models = (with_feedback(plain), with_feedback(plain, output=False, hidden=True, step=False),
              with_feedback(plain, output=False, hidden=True))  # fmt: skip

    def again(fit, training, *, model, run):
        place = models.index(model)
        if place in failing:
            raise ValueError(f"variant {place} diverges. Take another one.")
        return Made(model, (5.0, 0.0, 9.0)[place], records=(record,))

    refitted_by(monkeypatch, again)
    monkeypatch.setattr(trials, "lasting", lambda fits, *_: fits)
    fold = np.arange(N) >= TRAINING
    trial = trials.Trial(models, record, (fold,), Made(plain, 0.0), 0, SETTINGS, compared=compared)
    tried = trials.run(trial)
    assert tried.failure == ("variant 0 diverges" if kept is None else "")
    assert tried.model == models[kept or 0]
    assert (tried.fit is None) == (kept is None)


@pytest.mark.parametrize(
    ("ratios", "noise"), [((1.09, 1.0), True), ((1.11, 1.0), False), ((1.0, 1.11), False)]
)
def test_errors_are_noise_up_to_a_tenth_more_in_every_output(ratios, noise):
    sd = np.array([0.5, 20.0])
    errors = np.resize([1.0, -1.0, np.nan], (30, 1)) * sd * ratios
    fit = SimpleNamespace(noise_sd=sd, system=SimpleNamespace(noise=SimpleNamespace(constant_sd=1)))
    assert trials.are_noise(errors, fit) == noise
    assert trials.are_noise(errors, fit, trials.LITTLE_ELSE)
    assert not trials.are_noise(1.4 * errors, fit, trials.LITTLE_ELSE)
    fit.system.noise.constant_sd = None  # it varies, and has no one size
    assert not trials.are_noise(errors, fit)


@pytest.mark.parametrize(
    ("level", "nats", "kept"),
    [
        (0.5, 4.6, 1),  # what it gains counts
        (0.5, 4.4, 0),  # less than very strong evidence
        (0.0, 5.1, 1),
        (-0.5, 5.6, 1),  # forecasts are worse, if not certainly
        (-0.9, 5.8, 0),  # together they are no very strong evidence
        (-1.5, 99.0, 0),  # forecasts are certainly worse
        (1.5, -99.0, 1),  # they are certainly better
    ],
)
def test_of_functions_that_forecast_alike_the_more_probable_one_is_kept(
    record, monkeypatch, level, nats, kept
):
    plain = dgp.LinearDynamicGP(1, pairs=1)
    models = (with_feedback(plain), with_feedback(plain, output=False, hidden=True))
    made = []

    def again(fit, training, *, model, run):
        more = bool(made)
        made.append(Made(model, level * more, nats * more))
        return made[-1]

    refitted_by(monkeypatch, again)
    fold = np.arange(N) >= TRAINING
    trial = trials.Trial(models, record, (fold,), Made(plain, 0.0), 0, SETTINGS,
                         compared="held out")  # fmt: skip
    assert trials.run(trial).model == models[kept]


@pytest.mark.parametrize(
    ("factor", "gain", "more"),
    [(-4.9, 10.0, True), (-4.9, 9.8, False), (-5.1, 90.0, False), (np.nan, 90.0, False)],
)
def test_held_out_data_do_not_outweigh_very_strong_evidence(monkeypatch, factor, gain, more):
    monkeypatch.setattr(held_out, "log_bayes_factor", lambda one, best: factor)
    monkeypatch.setattr(held_out, "certain", lambda gain, settings: False)
    assert held_out.is_more_probable(None, None, np.array([gain]), SETTINGS) is more


def test_substeps_that_cannot_be_fitted_are_left(record, monkeypatch):
    model = with_feedback(dgp.LinearDynamicGP(1, pairs=1), output=False, hidden=True)
    fold = np.arange(N) >= TRAINING
    base = Made(dgp.LinearDynamicGP(1, pairs=1), 0.0)
    tried = trials.Tried(model, np.zeros(9), 1.0, fit=Made(model, 0.0))
    trial = trials.Trial((model,), record, (fold,), base, 0, SETTINGS)

    def refused(*_, **__):
        raise ValueError("fit: no start reached a point.")

    monkeypatch.setattr(trials, "refit", refused)
    assert trials.with_substeps(trial, tried) is tried
