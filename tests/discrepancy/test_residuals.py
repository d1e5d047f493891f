"""What residuals of a fit along a record are uncertain by."""

import numpy as np
import pytest
import torch
from scipy.signal import lfilter

import pyro_dynogp as dgp
from pyro_dynogp.discrepancy import residuals
from pyro_dynogp.inference.methods.base import Problem
from pyro_dynogp.inference.methods.mode import at_optimum
from pyro_dynogp.inference.optimise.maximum import maximise
from pyro_dynogp.inference.run import Run
from pyro_dynogp.inference.starts.plans import starting_points
from pyro_dynogp.lti.semiseparable import NotPositiveDefiniteError
from pyro_dynogp.prediction.predict import runs_after
from pyro_dynogp.statistics.settings import LoopSettings
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


def test_with_feedback_first_states_and_functions_are_drawn_at_the_mode(modes, monkeypatch):
    """Draws around the mode cost a climb and a Hessian, and simulations spread no more."""

    def no_draws(*args, **options):
        raise AssertionError

    record, fits = modes
    monkeypatch.setattr(residuals, "draws_of", no_draws)
    fit = fits["feedback"]
    spread = residuals._spread(fit, 7, 0)
    for name, value in spread.draws.items():
        assert value.shape == (7, *fit.mode[name].shape)
        assert bool((value == fit.mode[name]).all()), name
    settings = LoopSettings()
    found = residuals.residuals_of(fit, record, settings=settings)
    assert found.deviations.shape == (settings.draws, len(record))
    assert (found.deviations.std(0) > 0.0).all()


def test_without_feedback_parameters_are_drawn(modes):
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
    assert spread[-8:].mean() < 0.25 * spread[soon].mean()


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
