"""What residuals of a fit along a record are uncertain by."""

import pytest
import torch

import pyro_dynogp as dgp
from pyro_dynogp.discrepancy import residuals
from pyro_dynogp.inference.methods.base import Problem
from pyro_dynogp.inference.methods.mode import at_optimum
from pyro_dynogp.inference.optimise.maximum import maximise
from pyro_dynogp.inference.run import Run
from pyro_dynogp.inference.starts.plans import starting_points
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
