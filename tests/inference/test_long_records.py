"""Long records: optima are looked for along an excerpt first."""

import numpy as np
import pytest
import torch
from scipy.signal import lfilter

import pyro_dynogp as dgp
from pyro_dynogp.inference.density import Potential
from pyro_dynogp.inference.log_joint import density_of
from pyro_dynogp.inference.methods import base, mode
from pyro_dynogp.inference.methods.base import Problem
from pyro_dynogp.inference.run import Run

QUICK = {"method": "map", "seed": 0, "workers": 1, "progress": False, "restarts": 3}


def long_record(samples, *, quiet=False, missing=0):
    """A resonance under white noise; with `quiet` the input begins after half of the record."""
    rng = np.random.default_rng(0)
    u = rng.standard_normal(samples)
    if quiet:
        u[: samples // 2] = 0.0
    x = lfilter([0.0, 0.25, 0.1], [1.0, -1.5, 0.7], u)
    y = x + 0.1 * rng.standard_normal(samples)
    y[:missing] = np.nan
    return dgp.Record(np.arange(samples) * 0.1, u, y)


@pytest.fixture(autouse=True)
def shorter(monkeypatch):
    """The same rules at lengths that tests can afford."""
    monkeypatch.setattr(base, "LONG", 2000)
    monkeypatch.setattr(base, "EXCERPT", 500)


MODEL = dgp.LinearDynamicGP(1, pairs=1, process_noise=False)


class TestExcerpt:
    def test_the_first_part_in_the_same_units(self):
        record = long_record(2000)
        problem = Problem.of(MODEL, record)
        excerpt = problem.excerpt
        assert excerpt is not None
        (part,), (whole,) = excerpt.records, problem.records
        assert len(part) == 500
        assert part.scaling is whole.scaling
        assert excerpt.model is problem.model
        for name in ("inputs", "scaled_inputs", "observations", "scaled_outputs"):
            torch.testing.assert_close(getattr(part, name), getattr(whole, name)[:500])
        np.testing.assert_array_equal(part.record.time, record.time[:500])

    def test_none_of_a_short_one(self):
        assert Problem.of(MODEL, long_record(1999)).excerpt is None

    def test_none_of_several(self):
        assert Problem.of(MODEL, [long_record(2000), long_record(2500)]).excerpt is None

    def test_none_where_an_input_does_not_move_at_first(self):
        assert Problem.of(MODEL, long_record(2000, quiet=True)).excerpt is None

    def test_none_where_no_output_is_measured_at_first(self):
        assert Problem.of(MODEL, long_record(2000, missing=500)).excerpt is None
        assert Problem.of(MODEL, long_record(2000, missing=100)).excerpt is not None


@pytest.mark.parametrize("model", [MODEL, dgp.Wiener(1, pairs=1, process_noise=False)])
def test_the_optimum_is_that_of_the_whole_record(model, monkeypatch):
    """As high as without an excerpt, along all samples, with most evaluations along few."""
    record = long_record(2000)
    lengths = []
    evaluate = Potential.values_and_gradients

    def counted(self, z, *, jacobian=False):
        lengths.append(len(self.args[0][0]))
        return evaluate(self, z, jacobian=jacobian)

    monkeypatch.setattr(Potential, "values_and_gradients", counted)
    fit = dgp.fit(model, record, **QUICK)
    assert {500, 2000} <= set(lengths)
    monkeypatch.setattr(base, "LONG", 10_000)
    lengths.clear()
    whole = dgp.fit(model, record, **QUICK)
    assert set(lengths) == {2000}
    if model.is_linear:
        assert whole.start_energies.min() - fit.start_energies.min() > -0.1
        return
    # Kernels are those of the evidence, and priors of a grid change from optimum to optimum.
    density = density_of(fit.model.collapsed, (fit.records,))
    before, after = (float(density.likelihood(one.mode)) for one in (whole, fit))
    assert after - before > -1.0


def test_only_the_best_optima_go_on_along_the_whole(monkeypatch):
    carried = []
    near = mode._near

    def watched(problem, starts, *rest):
        carried.append((len(problem.records[0]), len(starts)))
        return near(problem, starts, *rest)

    monkeypatch.setattr(mode, "_near", watched)
    problem = Problem.of(MODEL, long_record(2000))
    mode.best_optima(problem, Run(seed=0, workers=1, progress=False, restarts=5), None, None)
    assert carried == [(2000, 3)]
