"""What residuals of a fit along a record are uncertain by."""

import numpy as np
import pytest
import torch
from scipy.signal import lfilter

import pyro_dynogp as dgp
from pyro_dynogp import effects
from pyro_dynogp.discrepancy import residuals
from pyro_dynogp.discrepancy.parameter_spread import normal_near
from pyro_dynogp.inference.methods.base import Problem
from pyro_dynogp.inference.methods.mode import at_optimum
from pyro_dynogp.inference.optimise.maximum import maximise
from pyro_dynogp.inference.refit import refit
from pyro_dynogp.inference.run import Run
from pyro_dynogp.inference.starts.plans import starting_points
from pyro_dynogp.lti.semiseparable import NotPositiveDefiniteError
from pyro_dynogp.models.feedback_variants import with_feedback
from pyro_dynogp.prediction import first_state
from pyro_dynogp.prediction.first_state import estimate
from pyro_dynogp.prediction.predict import forecast, runs_after, states_before
from pyro_dynogp.statistics.settings import LoopSettings
from tests.benchmarks.textbook import plant
from tests.prediction.test_feedback import rubbed

ALONE = Run(workers=1)


@pytest.fixture(scope="module")
def modes():
    """A few steps up from a start: what is drawn around it is no question of how high it is."""
    record, _, _ = rubbed(150, 0)

    def mode(model):
        problem = Problem.of(model, record)
        points = starting_points(problem.target, problem.records, ALONE, count=1, steps=5)
        optima = maximise(problem.target, problem.records, points, ALONE, steps=5)
        return dgp.Fit.of(at_optimum(problem.model, optima, 0, problem.records))

    return record, {
        "feedback": mode(dgp.NonlinearFeedback(1, pairs=1, inducing=5)),
        "linear": mode(dgp.LinearDynamicGP(1, pairs=1)),
    }


@pytest.mark.parametrize("name", ["feedback", "linear"])
def test_runs_are_linear_around_the_mode(modes, name, monkeypatch):
    """Draws cost a climb and a Hessian, and are no posterior along ridges."""

    def no_draws(*args, **options):
        raise AssertionError

    record, fits = modes
    monkeypatch.setattr(residuals, "draws_of", no_draws)
    settings = LoopSettings()
    found = residuals.residuals_of(fits[name], record, settings=settings)
    assert found.deviations.shape == (settings.draws, len(record))
    assert (found.deviations.std(0) > 0.0).all()


def test_more_poles_than_a_plant_has_spread_runs_by_less_than_the_noise():
    """Of p numbers n samples leave sqrt(p / n) of the noise; normal draws left 18 times that.

    A tank of one pole, fitted with two pairs: what tests take for the parameters' uncertainty is
    added to each replicate, and hid effects of four times the noise.
    """
    rng, n, sd = np.random.default_rng(3), 300, 0.1
    u = np.repeat(rng.standard_normal(n // 10), 10)
    y = lfilter([0.0, 0.05], [1.0, -0.95], u) + sd * rng.standard_normal(n)
    record = dgp.Record(np.arange(float(n)), u, y)
    model = dgp.LinearDynamicGP(1, pairs=2, process_noise=False)
    fit = dgp.fit(model, record, method="map", restarts=2, workers=1, progress=False)
    run = residuals.free_run_of(
        fit, record, held_out=np.zeros(n, dtype=bool), seed=0, settings=LoopSettings()
    )
    spread = np.sqrt(np.square(run.deviations[:, run.begin :]).mean())
    numbers = sum(value.numel() for value in fit.mode.values())
    assert 0.3 < spread / (sd * np.sqrt(numbers / n)) < 1.5


def test_parameters_of_linear_models_are_drawn(modes):
    _, fits = modes
    spread = residuals._spread(fits["linear"], 7, 0)
    assert all(float(value.std(0).max()) > 0.0 for value in spread.draws.values())
    again = residuals._spread(fits["linear"], 7, 0)
    assert all(torch.equal(value, again.draws[name]) for name, value in spread.draws.items())


def left_alone(n, noise=0.01):
    """Two equal poles, far from rest at the first sample, and hardly driven afterwards."""
    rng = np.random.default_rng(0)
    t = 0.2 * np.arange(n)
    u = 0.1 * np.repeat(rng.standard_normal(n // 5), 5)
    step = [0.0, 1.0 - 1.2 * np.exp(-0.2), np.exp(-0.4) - 0.8 * np.exp(-0.2)]  # (1 + s)^-2, held
    driven = lfilter(step, [1.0, -2.0 * np.exp(-0.2), np.exp(-0.4)], u)
    y = driven + (3.0 + 9.0 * t) * np.exp(-t) + noise * rng.standard_normal(n)
    return dgp.Record(t, u[:, None], y[:, None])


def test_free_runs_begin_where_the_filter_is():
    """Poles that are alike remember for longer than the slowest by itself."""
    record, settings = left_alone(400), LoopSettings()
    model = dgp.LinearDynamicGP(1, pairs=2, process_noise=False)
    fit = dgp.fit(model, record, method="map", restarts=2, workers=1, progress=False)
    begin = residuals.settling(fit, record, settings)
    found = residuals.residuals_of(fit, record, settings=settings)
    soon = slice(begin, begin + 8)
    assert np.isnan(found.residual[:begin]).all()
    assert np.abs(found.residual[soon]).max() < 0.05
    from_rest = record.outputs[:, 0] - fit.simulate(record, seed=0).mean[:, 0]
    assert np.abs(from_rest[soon]).max() > 0.2
    # They are uncertain by the state there, and that is forgotten.
    spread = found.deviations.std(0)
    assert spread[soon].mean() > 0.002
    # What is left is of the gains, which differ between processors: a quarter or a little less.
    assert spread[-8:].mean() < 0.5 * spread[soon].mean()


def test_draws_of_free_runs_have_the_moments_of_the_forecast(modes):
    record, fits = modes
    fit = fits["linear"].at_mode()
    many = fit.with_draws(
        {name: x.unsqueeze(0).expand(4000, *x.shape) for name, x in fit.mode.items()}
    )
    past, future = record[:12], record[12:40]
    runs = runs_after(many, past, future, seed=1)
    ahead = fit.forecast(past, future, process_noise=False)
    assert runs.shape == (4000, 28, 1)
    error = np.sqrt(ahead.signal_variance / 4000)
    assert (np.abs(runs.mean(0) - ahead.mean) < 5.0 * error + 1e-9).all()
    np.testing.assert_allclose(runs.var(0), ahead.signal_variance, rtol=0.15, atol=1e-12)
    assert np.array_equal(runs, runs_after(many, past, future, seed=1))


def test_without_outputs_at_the_beginning_the_first_state_is_unknown():
    record, settings = left_alone(400), LoopSettings()
    model = dgp.LinearDynamicGP(1, pairs=2, process_noise=False)
    fit = dgp.fit(model, record, method="map", restarts=2, workers=1, progress=False)
    y = record.outputs.copy()
    y[: residuals.settling(fit, record, settings)] = np.nan
    unseen = record.with_outputs(y)
    found = residuals.residuals_of(fit, unseen, settings=settings)
    np.testing.assert_array_equal(found.mean, fit.simulate(unseen, seed=fit.seed).mean[:, 0])


def test_parameter_draws_at_which_the_filter_fails_are_left_out(modes, monkeypatch):
    """The others are as they are by themselves; without any the first state is unknown."""
    record, fits = modes
    fit = fits["linear"]
    one = {name: x.unsqueeze(0).expand(6, *x.shape).clone() for name, x in fit.mode.items()}
    one["noise_sd"] = torch.full_like(one["noise_sd"], 0.1)
    one["noise_sd"][[1, 4]] = 1e-12
    spread = fit.with_draws(one)
    past, rest = record[:12], record[12:]

    def fails(some, *records, **options):
        if bool((some.draws["noise_sd"] < 1e-9).any()):
            raise NotPositiveDefiniteError
        return runs_after(some, *records, **options)

    monkeypatch.setattr(residuals, "runs_after", fails)
    runs = residuals._runs(spread, past, rest, 6, 0)
    assert runs.shape == (4, len(rest), 1)
    none = fit.with_draws({name: x[[1, 4]] for name, x in one.items()})
    assert len(residuals._runs(none, past, rest, 6, 0)) == 0
    _, component = residuals._free_run(fit, none, record, 12, 6, 0)
    np.testing.assert_array_equal(component, none.simulate(record, seed=0).component_mean)


def test_the_first_state_is_estimated_once_for_all_runs(monkeypatch):
    """It is that of the mode; estimates took a fifth of the time of loops with feedback."""
    rng = np.random.default_rng(0)
    u = np.repeat(rng.standard_normal(40), 4)
    y = lfilter([0.0, 0.2], [1.0, -0.8], u) + 0.02 * rng.standard_normal(160)
    record = dgp.Record(np.arange(160.0), u, y)
    model = dgp.NonlinearFeedback(1, parametric="cube", substeps=1)
    options = {"method": "map", "restarts": 1, "steps": 4, "workers": 1, "progress": False}
    fit = dgp.fit(model, record[:80], **options)
    past, rest = record[80:120], record[120:]
    known = states_before(fit, past, rest)
    one, other = (forecast(fit, past, rest, states=states) for states in (None, known))
    np.testing.assert_array_equal(one.component_mean, other.component_mean)
    assert states_before(fit, record[:80], record[80:]) is None  # a record that was fitted
    far = {name: 3.0 + z for name, z in known.items()}
    assert not np.allclose(one.mean[:3], forecast(fit, past, rest, states=far).mean[:3])
    calls = []
    monkeypatch.setattr(
        first_state, "estimate", lambda *each: calls.append(each) or estimate(*each)
    )
    held_out = np.ones(len(record), dtype=bool)
    settings = LoopSettings()
    run = residuals.free_run_of(fit, record, held_out=held_out, seed=0, settings=settings)
    assert run.begin > 0
    assert len([head for _, head in calls if len(head) == run.begin]) == 1


def bent(feedback):
    """A fit of a linear system with a bent sensor behind it, or with a bend in feedback."""
    rng = np.random.default_rng(3)
    t = 0.1 * np.arange(240)
    u = np.repeat(rng.standard_normal(60), 4)
    if feedback:
        y = np.zeros(240)
        for k in range(1, 240):
            y[k] = y[k - 1] + 0.1 * (u[k - 1] - y[k - 1] - y[k - 1] ** 3)
    else:
        x = lfilter([0.0, 1.0 - np.exp(-0.1)], [1.0, -np.exp(-0.1)], u)
        y = x + 0.4 * x**2
    record = dgp.Record(t, u[:, None], y[:, None] + 0.02 * rng.standard_normal((240, 1)))
    # In feedback values at 24 inputs say all of a function: nothing of it is drawn beside them.
    options = {"pairs": 1, "process_noise": False, "initial_state": "zero"}
    model = (
        dgp.NonlinearFeedback(1, inducing=24, **options)
        if feedback else dgp.Wiener(1, inducing=6, **options)
    )  # fmt: skip
    return record, dgp.fit(model, record, method="map", restarts=2, workers=1, progress=False)


@pytest.fixture(scope="module")
def sensor():
    return bent(feedback=False)


@pytest.mark.parametrize("feedback", [False, True])
def test_runs_of_functions_are_linear_in_the_parameters(feedback):
    """Variances are those of finite differences of simulations; the first state is known."""
    record, fit = bent(feedback)

    def runs(some):
        """One run (S, n) for each draw."""
        found = some.simulate(record, process_noise=False, samples=some.n_draws, seed=0)
        return found.component_mean[: some.n_draws, :, 0]

    def run(some):
        return fit.simulate(record, process_noise=False, seed=0).mean, runs(some)

    settings = LoopSettings(draws=3000)
    found = residuals._straight(run, fit, settings, 1)[1].var(0)
    normal = normal_near(fit, settings)
    z, root = normal.loc[0], normal.scale_tril[0].numpy()

    def around(step):
        """Runs (100, n) at a parameter nearby: what functions leave open is the same each time."""
        near = fit.with_draws(normal.at_latent(z + step))
        return near.simulate(record, process_noise=False, samples=100, seed=0).component_mean[
            ..., 0
        ]

    steps = 1e-4 * torch.eye(len(z), dtype=torch.float64)[:, None]
    slopes = np.stack([(around(step) - around(-step)) / 2e-4 for step in steps])
    expected = np.square(np.einsum("dsn,dk->ksn", slopes, root)).sum(0).mean(0)
    expected += around(0.0 * steps[0]).var(0)
    late = slice(60, None)
    # 3000 draws tell a variance to sqrt(2 / 3000) = 2.6 %; five of these.
    np.testing.assert_allclose(found[late], expected[late], rtol=0.13)
    # A posterior spreads simulations by less than the noise; draws as they are do not.
    assert found[late].mean() < 0.02**2
    loose = fit.with_draws(normal.draws(200, 0).values)
    assert runs(loose).var(0)[late].mean() > 2.0 * found[late].mean()


def test_one_free_run_serves_every_output(sensor, monkeypatch):
    record, _ = sensor
    y = record.outputs[:, 0]
    both = dgp.Record(record.time, record.inputs, np.column_stack([y, np.roll(y, 3)]))
    model = dgp.LinearDynamicGP(1, outputs=2, pairs=1, process_noise=False)
    fit = dgp.fit(model, both, method="map", restarts=1, workers=1, progress=False)
    settings = LoopSettings()
    alone = [residuals.residuals_of(fit, both, output=a, settings=settings) for a in (0, 1)]
    everywhere = np.ones(len(both), dtype=bool)
    run = residuals.free_run_of(fit, both, held_out=everywhere, seed=0, settings=settings)
    monkeypatch.setattr(residuals, "free_run_of", None)
    for a, one in enumerate(alone):
        again = residuals.residuals_of(fit, both, output=a, settings=settings, run=run)
        np.testing.assert_array_equal(again.residual, one.residual)
        np.testing.assert_array_equal(again.deviations, one.deviations)


def test_what_parameters_leave_next_to_feedback_is_no_effect():
    """A spring that softens, with the model that is right: its half-known parameters show.

    With deviations of the function alone two of these tests had p-values of 4e-6 and 2e-4.
    """
    record = plant("pendulum", 5)[0][:900]
    training = record[:600]
    linear = dgp.LinearDynamicGP(1, pairs=1, process_noise=False)
    base = dgp.fit(linear, training, method="map", workers=1, progress=False)
    fit = refit(base, training, model=with_feedback(linear), run=ALONE)
    settings = LoopSettings()
    found = residuals.residuals_of(fit, record, held_out=np.arange(900) >= 600, settings=settings)
    tests = (effects.NonlinearFeedbackOfOutput(), effects.DeadTime(), effects.OutputNonlinearity())
    for effect in tests:
        for one in effect.detect(found, settings):
            assert one.p_value > 0.01, effect.name
