"""Where climbs begin that start from another fit."""

from types import SimpleNamespace

import numpy as np
import pytest
import torch

import pyro_dynogp as dgp
from pyro_dynogp.inference import refit as again
from pyro_dynogp.inference.density import Potential
from pyro_dynogp.inference.methods import mode
from pyro_dynogp.inference.methods.base import Problem
from pyro_dynogp.inference.optimise import maximum
from pyro_dynogp.inference.optimise.optimum import Optimum
from pyro_dynogp.inference.run import Run
from pyro_dynogp.inference.starts import noise
from pyro_dynogp.inference.starts.plans import starting_points
from tests.models.closed_loops import make_record

RUN = Run(0, 1, False)


def first_point(monkeypatch, model, sd):
    """The point that a climb from another fit begins at, by the noise which that has learnt."""
    problem = Problem.of(model, make_record(missing=False))
    (usual,) = starting_points(problem.target, problem.records, RUN, count=1, steps=5)
    learnt = {**usual, "noise_sd": torch.full_like(usual["noise_sd"], sd)}
    seen = []

    def climb(model, records, starts, warm, *_, **__):
        seen.extend(warm)
        return [SimpleNamespace(energy=0.0, values=None)]

    monkeypatch.setattr(mode, "climb", climb)
    monkeypatch.setattr(mode, "free_run_error", lambda *_: 0.0)
    mode.cascade_optima(Problem(problem.model, problem.records, learnt), RUN, "lbfgs", 5)
    return float(seen[0]["noise_sd"])


@pytest.mark.parametrize(("sd", "begins"), [(1e-3, noise.UNEXPLAINED), (0.6, 0.6)])
def test_in_feedback_with_more_noise_where_that_is_more_probable(monkeypatch, sd, begins):
    model = dgp.NonlinearFeedback(1, pairs=2, process_noise=False)
    assert first_point(monkeypatch, model, sd) == pytest.approx(begins)


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
    assert noise.most_probable(problem.target, problem.records, points) is points[1]


@pytest.mark.parametrize(("optimizer", "lasts"), [("gauss-newton", 2), ("lbfgs", 1)])
def test_what_is_learnt_climbs_to_the_end(monkeypatch, optimizer, lasts):
    """It begins below three fresh starts, and ends above them; these share the work as without."""
    shared: list[list[int]] = []

    def climb(task):
        def end(start):
            which, height = int(start["which"]), float(start["height"])
            height += 100.0 if which == 0 else 1.0 / which
            return Optimum(-height, start | {"height": torch.tensor(height)}, np.zeros(1), "")

        return [end(start) for start in task.starts]

    def mapped(function, tasks, **_):
        shared.append(sorted(int(start["which"]) for task in tasks for start in task.starts))
        return [function(task) for task in tasks]

    monkeypatch.setattr(maximum, "_optimise", climb)
    monkeypatch.setattr(maximum, "parallel_map", mapped)
    starts = [
        {"which": torch.tensor(which), "height": torch.tensor(0.0 if which else -150.0)}
        for which in range(4)
    ]
    model = dgp.NonlinearFeedback(1, pairs=2)
    records = model.prepare(make_record(missing=False))
    ends = [
        maximum.maximise(
            model, records, starts, RUN, optimizer=optimizer, steps=50, learnt=learnt,
            effort=mode.HALF,
        )[0]
        for learnt in (0, 1)
    ]  # fmt: skip
    assert [int(one.values["which"]) for one in ends] == [1, 0]
    halfway = len(shared) // 2
    assert shared[0] == shared[halfway] == [0, 1, 2, 3]
    for without, beside in zip(shared[1:halfway], shared[halfway + 1 :], strict=True):
        assert 0 not in without
        assert 0 in beside
    assert halfway == 1 + lasts


def test_half_of_those_that_have_climbed_without_process_noise_climb_to_the_end_with_it(
    monkeypatch,
):
    problem = Problem.of(dgp.NonlinearFeedback(1, pairs=1), make_record(missing=False))
    (usual,) = starting_points(problem.target, problem.records, RUN, count=1, steps=5)
    kept = []

    def maximised(model, records, starts, run, *, effort, **_):
        kept.append((len(starts), effort.kept))
        return [Optimum(0.0, start, np.zeros(1), "") for start in starts]

    monkeypatch.setattr(mode, "maximise", maximised)
    mode.climb(
        problem.target, problem.records, [usual] * 6, [], RUN, steps=20, optimizer="gauss-newton",
        effort=again.LOOPED,
    )  # fmt: skip
    assert kept == [(6, 1.0), (3, 0.5)]


def test_a_fit_with_other_substeps_begins_with_more_noise_where_that_is_more_probable(monkeypatch):
    """What is learnt with one step a sample may have hardly any density with three."""
    model = dgp.NonlinearFeedback(1, pairs=1, process_noise=False, substeps=1)
    record = make_record(missing=False)
    quick = {"method": "map", "restarts": 1, "steps": 2, "workers": 1, "progress": False}
    with pytest.warns(UserWarning, match="free numbers"):
        fit = dgp.fit(model, record, **quick)
    quiet = fit.mode["noise_sd"]
    seen = []

    def compared(model, records, points):
        seen.append([float(point["noise_sd"]) for point in points])
        return points[1]

    def climbed(model, records, points, run, **_):
        seen.append([float(point["noise_sd"]) for point in points])
        return [Optimum(0.0, points[0], np.zeros(1), "")]

    monkeypatch.setattr(noise, "most_probable", compared)
    monkeypatch.setattr(again, "maximise", climbed)
    monkeypatch.setattr(again, "kernels_by_evidence", lambda model, records, optima, run: optima)
    finer = dgp.NonlinearFeedback(1, pairs=1, process_noise=False, substeps=3)
    again.refit(fit, record, model=finer, run=RUN)
    louder = max(noise.UNEXPLAINED, float(quiet))
    assert seen == [[pytest.approx(float(quiet)), louder], [louder]]
