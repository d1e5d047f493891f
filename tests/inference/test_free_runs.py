"""Fits of cascades are chosen by their free runs, too: the rules, and that they hold."""

import warnings
from types import SimpleNamespace

import numpy as np
import pytest
import torch

import pyro_dynogp as dgp
from pyro_dynogp.inference import free_runs
from pyro_dynogp.inference.free_runs import free_run_error, noise_pays, noise_sites
from pyro_dynogp.inference.methods import mode
from pyro_dynogp.inference.optimise.optimum import Optimum
from pyro_dynogp.inference.run import Run
from pyro_dynogp.inference.starts.noise import FAINT
from pyro_dynogp.inference.starts.plans import starting_points
from pyro_dynogp.models.outputs import output_process
from tests.models.closed_loops import ClosedLoop, make_record, spring, system_at, values_of

LINE = 0.5


def optimum(energy, error):
    return SimpleNamespace(energy=energy, values=error)


def chosen(monkeypatch, *attempts, model=None):
    """Optima that `cascade_optima` returns of given (energy, free-run error) by attempt."""
    model = model or dgp.Wiener(1)
    problem = SimpleNamespace(target=model, records=[], learnt=None)
    twin = (dgp.LinearDynamicGP(1), [], [LINE])
    left = list(attempts)
    monkeypatch.setattr(mode, "linear_twins", lambda *_: {"g": twin})
    monkeypatch.setattr(mode, "starts_of", lambda *_: [{}])
    monkeypatch.setattr(mode, "free_run_error", lambda model, values, records: values)
    monkeypatch.setattr(mode, "climb", lambda *_, **__: [optimum(*one) for one in left.pop(0)])
    found = mode.cascade_optima(problem, Run(0, 1, False), "adam", 10)
    return [(one.energy, one.values) for one in found], len(attempts) - len(left)


@pytest.mark.parametrize("model", [dgp.Wiener(1), dgp.Hammerstein(1), dgp.NonlinearFeedback(1)])
def test_optima_that_run_worse_than_the_linear_model_are_left_out(monkeypatch, model):
    given = [(-9.0, 0.6), (-7.0, 0.51), (-3.0, 0.4), (-1.0, 0.5)]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        found, used = chosen(monkeypatch, given, [], model=model)
    assert found == [(-3.0, 0.4), (-1.0, 0.5)]
    assert used == 1


def test_there_is_another_set_of_starts_where_none_holds(monkeypatch):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        found, used = chosen(monkeypatch, [(-9.0, 0.6)], [(-8.0, 0.45), (-8.5, 0.55)])
    assert found == [(-8.0, 0.45)]
    assert used == 2


def test_a_warning_where_nothing_helps(monkeypatch):
    with pytest.warns(UserWarning, match="no better than those of the linear model"):
        found, used = chosen(monkeypatch, [(-8.0, 0.6)], [(-9.0, 0.7)])
    assert found == [(-9.0, 0.7), (-8.0, 0.6)]
    assert used == 2


def test_a_model_without_functions_is_not_judged(monkeypatch):
    model = dgp.Cascade(1, (dgp.Dynamic(), dgp.Dynamic()))
    assert chosen(monkeypatch, [(-8.0, 0.6)], model=model) == ([(-8.0, 0.6)], 1)


@pytest.mark.parametrize(
    ("model", "with_noise", "pays"),
    [
        (dgp.Wiener(1), 1.49, True),
        (dgp.Wiener(1), 1.51, False),
        (dgp.NonlinearFeedback(1), 0.98, True),
        (dgp.NonlinearFeedback(1), 1.0, False),
    ],
)
def test_what_process_noise_may_cost(monkeypatch, model, with_noise, pays):
    monkeypatch.setattr(free_runs, "free_run_error", lambda model, values, records: values)
    assert noise_pays(model, [], optimum(0.0, with_noise), optimum(0.0, 1.0), 1.5) == pays
    if not model.has_feedback:  # nor has it to run better than both
        assert noise_pays(model, [], optimum(0.0, 1.0), optimum(0.0, 1.0), 0.5)


def bent(n=240):
    """A sensor that saturates, behind a lag."""
    rng = np.random.default_rng(4)
    u, x = np.repeat(rng.standard_normal(n // 3), 3), np.zeros(n)
    for k in range(1, n):
        x[k] = 0.85 * x[k - 1] + 0.4 * u[k - 1]
    y = np.tanh(1.5 * x) + 0.03 * rng.standard_normal(n)
    return dgp.Record(time=np.arange(float(n)), inputs=u, outputs=y)


def test_a_fit_runs_better_than_the_linear_model():
    record = bent()
    options = {"method": "map", "restarts": 2, "workers": 1, "progress": False}
    fits = (
        dgp.fit(dgp.Wiener(1, pairs=1), record, steps=100, **options),
        dgp.fit(dgp.LinearDynamicGP(1, pairs=1), record, **options),
    )
    errors = [free_run_error(f.model.collapsed, f.mode, f.model.prepare(record)) for f in fits]
    assert errors[0] < 0.7 * errors[1]


def test_without_process_noise_the_error_is_that_of_the_whole_run():
    """The filter learns nothing then: blocks go on where the one before them ended."""
    model = spring(process_noise=False)
    record = make_record(n=300, irregular=True)
    model = model.scaled_to(record)
    values = values_of(model, record, seed=1)
    loop = ClosedLoop(model, system_at(model, values), record)
    error = loop.scaled(record.outputs) - loop.filter()[1]
    found = free_runs.free_run_error(model, values, model.prepare(record))
    assert found == pytest.approx(np.sqrt(np.nanmean(error**2)), rel=1e-9)


def test_with_process_noise_blocks_begin_at_the_state_of_the_filter():
    """Nearer than a run from the first sample alone, on a record that the model makes."""
    model = spring()
    blank = make_record(n=600, missing=False)
    model = model.scaled_to(blank)
    values = values_of(model, blank, seed=2)
    values["g_noise_gain_unit"] = 2.0 + 0.0 * values["g_noise_gain_unit"]
    process = output_process(system_at(model, values), model.prepare(blank)[0])
    with torch.random.fork_rng():
        torch.manual_seed(0)
        record = blank.with_outputs(process.sample().numpy()[:, None])
    whole = process.components(samples=200, seed=0).mean.mean(0)
    error = np.sqrt(np.mean((record.outputs - whole) ** 2)) / float(model.scaling.output_scale[0])
    assert free_runs.free_run_error(model, values, model.prepare(record)) < 0.97 * error


def test_the_warning_is_of_the_line_that_called(monkeypatch):
    monkeypatch.setattr(mode, "free_run_error", lambda model, *_: 1.0 + model.has_function)
    with pytest.warns(UserWarning, match="no better than") as caught:
        dgp.fit(
            dgp.Wiener(1, pairs=1), bent(60), method="map", restarts=1, steps=2, workers=1,
            progress=False,
        )  # fmt: skip
    said = [one for one in caught if "no better" in str(one.message)]
    assert [one.filename for one in said] == [__file__]


def test_process_noise_begins_faint_after_climbs_without_any(monkeypatch):
    model = dgp.Wiener(1, pairs=1).scaled_to(bent(60)).collapsed
    ready = model.prepare(bent(60))
    starts = starting_points(model, ready, Run(0, 1, False), count=2, steps=5)
    given = []

    def maximise(target, records, points, run, **options):
        given.append(points)
        own = {site.name for site in target.all_sites(target.scaling, 1)}
        return [
            Optimum(0.0, {k: v for k, v in point.items() if k in own}, np.zeros(1), "")
            for point in points
        ]

    monkeypatch.setattr(mode, "maximise", maximise)
    run = Run(0, 1, False)
    mode.climb(model, ready, starts, [starts[0]], run, steps=10, optimizer="adam")
    quiet, (learnt, noisy) = given
    assert quiet[0] is starts[0]  # what is learnt climbs without any noise, too
    assert len(quiet) == 3
    scale = "g_noise_gain_local_scale"
    assert torch.equal(learnt[scale], starts[0][scale])  # what is learnt stays
    assert torch.allclose(noisy[scale], FAINT * starts[0][scale])
    assert torch.equal(noisy["f_values"], quiet[0]["f_values"])


def test_where_noise_does_not_pay_what_is_learnt_is_not_lost(monkeypatch):
    """An axis with friction: of its refit a poor fresh start was left, 1350 nats below."""
    model = spring().scaled_to(make_record(n=60))
    ready = model.prepare(make_record(n=60))
    learnt, fresh = starting_points(model, ready, Run(0, 1, False), count=2, steps=5)

    def maximise(target, records, points, run, **options):
        found = [
            Optimum(0.0 if torch.equal(p["g_input_gain"], learnt["g_input_gain"]) else 9.0,
                    dict(p), np.zeros(1), "")
            for p in points
        ]  # fmt: skip
        return sorted(found, key=lambda one: one.energy)

    monkeypatch.setattr(mode, "maximise", maximise)
    monkeypatch.setattr(mode, "noise_pays", lambda *_: False)
    run = Run(0, 1, False)
    (found,) = mode.climb(model, ready, [fresh], [learnt], run, steps=10, optimizer="gauss-newton")
    assert torch.equal(found.values["g_input_gain"], learnt["g_input_gain"])


@pytest.mark.parametrize(
    ("model", "parts"),
    [
        (dgp.NonlinearFeedback(1), ("noise_gain_local_scale", "noise_gain_unit")),
        (dgp.NonlinearFeedback(1, process_noise=False), ()),
        (
            dgp.LinearDynamicGP(1, integrators=1),
            ("noise_gain_local_scale", "noise_gain_unit", "integrator_noise"),
        ),
    ],
)
def test_noise_sites_are_those_of_the_model(model, parts):
    scaling = model.scaled_to(dgp.datasets.load("gas_furnace").train).scaling
    names = [site.name for site in model.sites(scaling)]
    assert noise_sites(model) == tuple(f"g_{part}" for part in parts)
    assert set(noise_sites(model)) == {
        n for n in names if n.endswith("_noise") or "_noise_gain" in n
    }
