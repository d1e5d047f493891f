"""Where climbs begin that start from another fit."""

from types import SimpleNamespace

import pytest
import torch

import pyro_dynogp as dgp
from pyro_dynogp.inference.density import Potential
from pyro_dynogp.inference.methods import mode
from pyro_dynogp.inference.methods.base import Problem
from pyro_dynogp.inference.run import Run
from pyro_dynogp.inference.starts.plans import starting_points
from tests.models.closed_loops import make_record

RUN = Run(0, 1, False)


def first_point(monkeypatch, model, noise):
    """The point that a climb from another fit begins at, by the noise which that has learnt."""
    problem = Problem.of(model, make_record(missing=False))
    (usual,) = starting_points(problem.target, problem.records, RUN, count=1, steps=5)
    learnt = {**usual, "noise_sd": torch.full_like(usual["noise_sd"], noise)}
    seen = []

    def climb(model, records, starts, warm, *_, **__):
        seen.extend(warm)
        return [SimpleNamespace(energy=0.0, values=None)]

    monkeypatch.setattr(mode, "climb", climb)
    monkeypatch.setattr(mode, "free_run_error", lambda *_: 0.0)
    mode.cascade_optima(Problem(problem.model, problem.records, learnt), RUN, "lbfgs", 5)
    return float(seen[0]["noise_sd"])


@pytest.mark.parametrize(("noise", "begins"), [(1e-3, mode.UNEXPLAINED), (0.6, 0.6)])
def test_in_feedback_with_more_noise_where_that_is_more_probable(monkeypatch, noise, begins):
    model = dgp.NonlinearFeedback(1, pairs=2, process_noise=False)
    assert first_point(monkeypatch, model, noise) == pytest.approx(begins)


def test_elsewhere_with_the_noise_that_is_learnt(monkeypatch):
    assert first_point(monkeypatch, dgp.Wiener(1, pairs=2), 1e-3) == pytest.approx(1e-3)


def test_the_most_probable_of_several_starts():
    problem = Problem.of(dgp.Wiener(1, pairs=2), make_record(missing=False))
    (usual,) = starting_points(problem.target, problem.records, RUN, count=1, steps=5)
    points = [
        {**usual, "noise_sd": torch.full_like(usual["noise_sd"], x)} for x in (1e-3, 0.5, 9.0)
    ]
    potential = Potential(problem.target, (problem.records,), usual)
    energies = [
        float(potential.values_and_gradients(potential.pack(p).numpy()[None])[0][0]) for p in points
    ]
    assert min(energies) == energies[1]
    assert mode.most_probable(problem, points) is points[1]
