"""Simulation-based calibration of fits: a small run, what it draws, what fails, what is refused."""

from dataclasses import replace

import numpy as np
import pytest
import torch

import pyro_dynogp as dgp
from pyro_dynogp.criticism import simulation_based
from pyro_dynogp.criticism.simulation_based import _method, _simulated, _Task
from pyro_dynogp.fitting import Fit
from pyro_dynogp.inference.posterior_draws import PosteriorDraws
from pyro_dynogp.inference.posteriors import Sampled

QUIET = {"workers": 1, "progress": False}


@pytest.fixture(scope="module")
def blank():
    """Times and inputs, and outputs that only say where a gap is."""
    rng = np.random.default_rng(0)
    y = rng.standard_normal(24)
    y[5] = np.nan
    u = np.repeat(rng.standard_normal(4), 6)
    return dgp.Record(0.1 * np.arange(24), u, y, input_names=["valve"], output_names=["level"])


@pytest.fixture(scope="module")
def model(blank):
    return dgp.LinearDynamicGP(inputs=1, pairs=1, process_noise=False).scaled_to(blank)


def run(model, blank, **options):
    given = {"method": "map", "replicates": 3, "draws": 19, "restarts": 1, "steps": 40}
    return dgp.simulation_based_calibration(model, blank, **{**given, **QUIET, **options})


def test_a_small_run(model, blank):
    found = run(model, blank)
    assert found.replicates == 3
    assert found.failures == ()
    assert {"log joint", "noise_sd", "offset", "g_log_decay", "g_input_gain[1]"} <= set(found.ranks)
    assert all(((r >= 0) & (r <= 19)).all() and len(r) == 3 for r in found.ranks.values())
    assert found.calibrated  # three replicates cannot say otherwise
    text = str(found)
    assert text.startswith("Simulation-based calibration of map: 3 replicates, ranks among 19")
    assert found.verdict in text
    assert list(found.to_frame().index) == list(found.ranks)


def test_the_scaling_and_with_it_the_prior_stays(model, blank, monkeypatch):
    """Records far from unit scale: a fit that learnt its scaling anew would have another prior."""
    seen = []

    def fit(problem, method, run):
        seen.append((problem, method, run))
        raise RuntimeError("seen")

    monkeypatch.setattr(simulation_based, "train_model", fit)
    with pytest.raises(ValueError, match="replicates that all failed, the first with: RuntimeErr"):
        run(model, blank)
    for problem, _, _ in seen:
        assert problem.model.scaling == problem.scaling == model.scaling
    records = [problem.records[0].record for problem, _, _ in seen]
    assert np.isnan(records[0].outputs[5, 0])
    assert np.isnan(records[0].outputs).sum() == 1
    assert records[0].output_names == ("level",)
    assert not np.array_equal(records[0].outputs[0], records[1].outputs[0])
    assert [method for _, method, _ in seen] == [dgp.Mode()] * 3
    assert len({run.seed for _, _, run in seen}) == 3
    assert {run.restarts for _, _, run in seen} == {1}


def test_failures_are_counted_not_drawn_again(model, blank, monkeypatch):
    real, calls = simulation_based._fitted, []

    def sometimes(task, record):
        calls.append(task.run.seed)
        if len(calls) == 2:
            raise ValueError("covariance not\npositive definite")
        return real(task, record)

    monkeypatch.setattr(simulation_based, "_fitted", sometimes)
    found = run(model, blank)
    assert len(calls) == found.replicates == 3
    assert found.failures == ("ValueError: covariance not positive definite",)
    assert all(len(r) == 2 for r in found.ranks.values())
    assert "1 of 3 replicates failed" in found.verdict


@pytest.mark.parametrize(("width", "right"), [(1.0, True), (0.2, False)])
def test_an_overconfident_posterior_is_rejected(model, blank, monkeypatch, width, right):
    """Without a fit: draws from the prior are the posterior given data that say nothing."""

    def nothing(task, record):
        return Fit(task.model, Sampled({}), {}, {}, np.zeros(1), np.zeros(1), {}, 0, ())

    wide = dgp.TimeScale.of(model.scaling).brevity

    def equal_draws(fit, *, count, seed):
        generator = torch.Generator().manual_seed(seed)
        offset = width * wide * torch.randn(count, 1, generator=generator, dtype=torch.float64)
        return PosteriorDraws({"offset": offset}, np.zeros(count), None, np.zeros(count, int), "")

    monkeypatch.setattr(simulation_based, "_fitted", nothing)
    monkeypatch.setattr(simulation_based, "equal_draws", equal_draws)
    monkeypatch.setattr(simulation_based, "log_joint", lambda fit, values: np.zeros(1))
    found = run(model, blank, replicates=60)
    assert found.calibrated == right
    if not right:
        assert found.miscalibrated == ("offset",)
        assert "offset (posterior too narrow" in found.verdict


def test_outputs_of_a_cascade_come_from_its_trajectories(blank):
    wiener = dgp.Wiener(1, pairs=1, inducing=4).scaled_to(blank)
    blind = blank.with_outputs(np.empty((24, 0)), names=(), units=())
    method, run, learnt = _method(wiener, "svi", 19, {})
    task = _Task(wiener, blind, blank.missing, method, 19, replace(run, seed=3), learnt)
    truth, record = _simulated(task)
    assert {"g", "f", "f_values", "g_initial_state"} <= set(truth)
    assert record.outputs.shape == (24, 1)


def test_what_is_refused(model, blank):
    for change, words in (
        ({"method": "laplace"}, "method: expected one of \\['importance', 'map', 'svi', 'nuts'\\]"),
        ({"replicates": 1}, "replicates: expected a whole number >= 2"),
        ({"draws": 5}, "draws: expected a whole number >= 9"),
        ({"level": 1.0}, "level: expected a number between 0 and 1"),
        ({"checkpoint": "folder"}, "checkpoint: expected none"),
    ):
        with pytest.raises(ValueError, match=words):
            run(model, blank, **change)
    with pytest.raises(ValueError, match=r"model: expected a model with its scaling.*scaled_to"):
        run(replace(model, scaling=None), blank)
    with pytest.raises(ValueError, match="model: expected priors that can be drawn from"):
        run(replace(model, priors="paper"), blank)
    with pytest.raises(ValueError, match="record: expected one Record, got list"):
        run(model, [blank])
    with pytest.raises(ValueError, match="model: expected a LinearDynamicGP or a Cascade"):
        run("model", blank)
