"""Kernels of functions by the evidence: against dense normals, and what they are worth."""

import math
from dataclasses import replace

import numpy as np
import pytest
import scipy.stats
import torch
from gpytorch.kernels import MaternKernel

import pyro_dynogp as dgp
from pyro_dynogp.examples.feedback import simulate_duffing
from pyro_dynogp.inference import function_evidence
from pyro_dynogp.inference.density import Potential
from pyro_dynogp.inference.function_evidence import (
    BEHIND,
    SETTLED,
    _Expansion,
    functions_of,
    kernel_sites,
    kernels_by_evidence,
    with_kernels_by_evidence,
)
from pyro_dynogp.inference.methods.base import Problem
from pyro_dynogp.inference.methods.mode import at_optimum
from pyro_dynogp.inference.optimise.innovation_energy import Innovations
from pyro_dynogp.inference.optimise.maximum import maximise
from pyro_dynogp.inference.optimise.optimum import Optimum
from pyro_dynogp.inference.refit import refit
from pyro_dynogp.inference.run import Run
from pyro_dynogp.inference.starts.plans import starting_points
from pyro_dynogp.models.feedback_variants import with_feedback

ALONE = Run(workers=1)
PLANT = simulate_duffing(0, noise_ratio=0.02)
MODELS = {
    "one function": dgp.NonlinearFeedback(1),
    "two functions": dgp.NonlinearFeedback(1, hidden=1, inducing=8),
    "two outputs of a function": dgp.NonlinearFeedback(1, outputs=2, inducing=8),
    "another kernel": dgp.NonlinearFeedback(1, kernel=MaternKernel(2.5), inducing=8),
    "at the input": dgp.Hammerstein(1, pairs=1, inducing=8),
    "at the output": dgp.Wiener(1, pairs=1, inducing=12),
    "outliers": dgp.NonlinearFeedback(1, inducing=8, likelihood=dgp.StudentT()),
    "limits": dgp.Cascade(1, (dgp.Dynamic(), dgp.Static(limits=(-2.0, 2.0), inducing=8))),
}


def record_for(model, samples=120):
    record = PLANT.train[:samples]
    if model.outputs == 1:
        return record
    y = np.asarray(record.outputs)
    return dgp.Record(time=record.time, inputs=record.inputs, outputs=np.c_[y, 0.5 * y**2])


def begun(model, samples=120):
    """Problem, and a start of it a few steps on."""
    problem = Problem.of(model, record_for(model, samples))
    (start,) = starting_points(problem.target, problem.records, ALONE, count=1, steps=5)
    return problem, start


def expansion(name):
    problem, start = begun(MODELS[name])
    return _Expansion.at(problem.target, problem.records, start)


def dense(here, theta):
    """Log evidence of kernels as the density of pseudo outputs under the functions' prior.

    The quadratic log likelihood is that of outputs at v0 + F^-1 g with covariance F^-1, whitened by
    the kernels at the expansion's point: its prior covariance is A A'.
    """
    values = here.potential.unpack(torch.tensor(here.z))
    kernels = here.potential.places(kernel_sites(here.model))
    z = here.z.copy()
    z[kernels] = theta
    other = here.potential.unpack(torch.tensor(z))
    blocks = []
    for wire, layer in functions_of(here.model):
        old, new = (
            here.model.static_function(wire, layer, v, here.scaling) for v in (values, other)
        )
        for s, t in zip(old.output_scale, new.output_scale, strict=True):
            A = np.linalg.solve((s * old.root).numpy(), (t * new.root).numpy())
            blocks.append(A @ A.T)
    covariance = scipy.linalg.block_diag(*blocks)
    F, g = here.fisher.numpy(), here.gradient.numpy()
    at = here.z[here.places] + np.linalg.solve(F, g)
    log_prior = sum(
        float(site.prior.log_prob(other[site.name]).sum())
        for site in here.model.sites(here.scaling)
        if site.name in kernel_sites(here.model)
    )
    normal = scipy.stats.multivariate_normal(np.zeros(len(at)), covariance + np.linalg.inv(F))
    return normal.logpdf(at) + log_prior


@pytest.mark.parametrize("name", MODELS)
def test_gain_is_that_of_a_dense_normal(name):
    """At a well-conditioned matrix in place of the model's, where a dense density is exact."""
    here = expansion(name)
    rng = np.random.default_rng(1)
    m = len(here.places)
    root = rng.standard_normal((m, m))
    fisher = torch.tensor(root @ root.T + np.eye(m))
    here = replace(here, fisher=fisher, gradient=torch.tensor(3.0 * rng.standard_normal(m)))
    kernels = here.potential.places(kernel_sites(here.model))
    values, gain = here.best()
    theta = here.potential.pack(values).numpy()[kernels]
    assert gain > 0.1
    assert dense(here, theta) - dense(here, here.z[kernels]) == pytest.approx(gain, rel=1e-5)
    inside = np.abs(theta - here.z[kernels]) < 1.49
    for place in np.flatnonzero(inside):  # the top: no neighbour is higher
        for step in (-0.02, 0.02):
            beside = theta.copy()
            beside[place] += step
            assert dense(here, beside) < dense(here, theta)


@pytest.mark.parametrize("name", MODELS)
def test_slope_and_curvature_are_those_of_the_likelihood(name):
    """By differences of the density itself; the Fisher matrix where there are innovations."""
    here = expansion(name)
    _, slopes = here.potential.value_and_gradient(here.z)
    expected = here.z[here.places] - slopes[here.places]
    np.testing.assert_allclose(here.gradient, expected, rtol=1e-4, atol=1e-3 * abs(expected).max())
    assert np.linalg.eigvalsh(here.fisher.numpy()).min() > -1e-6 * float(here.fisher.abs().max())
    if name == "limits":  # not of a product of normals: the Hessian's part that curves downwards
        H = here.potential.hessian_of(here.z, here.places.tolist()) - np.eye(len(here.places))
        values, axes = np.linalg.eigh(H)
        np.testing.assert_allclose(
            here.fisher, (axes * values.clip(0)) @ axes.T, atol=1e-6 * abs(H).max()
        )
    else:
        local = Innovations(here.potential).local(here.z)
        np.testing.assert_allclose(here.fisher, local.fisher[np.ix_(here.places, here.places)])


def test_marginal_energy_is_laplace_of_the_joint():
    """Against the integral over a whitened value by quadrature, of a function with one of them."""
    problem, start = begun(dgp.NonlinearFeedback(1, inducing=1), 40)
    name = kernel_sites(problem.target)[0].removesuffix("_lengthscale") + "_values"
    start["noise_sd"] = torch.tensor([0.5], dtype=torch.float64)
    potential = Potential(problem.target, (problem.records,), start)
    innovations = Innovations(potential)
    grid = np.linspace(-8.0, 8.0, 4001)
    points = np.repeat(potential.pack(start).numpy()[None], len(grid), 0)
    points[:, potential.places([name])] = grid[:, None]
    energies = np.concatenate([
        innovations.energies(part) for part in np.array_split(points, 20)
    ])  # fmt: skip
    best = {**start, name: torch.tensor([[grid[energies.argmin()]]])}
    here = _Expansion.at(problem.target, problem.records, best)
    # The quadrature has the prior's 1/sqrt(2 pi), which Laplace's integral cancels.
    density = np.exp(energies.min() - energies)
    exact = (
        energies.min() - math.log(density.sum() * (grid[1] - grid[0])) + 0.5 * math.log(2 * math.pi)
    )
    assert here.energy == pytest.approx(exact, abs=0.05)


@pytest.mark.parametrize("optimizer", ["gauss-newton", "lbfgs", "preconditioned"])
def test_held_sites_stay(optimizer):
    problem, start = begun(dgp.NonlinearFeedback(1, inducing=8))
    held = kernel_sites(problem.target)
    before = Potential(problem.target, (problem.records,), start).energies_at([start])[0]
    (found,) = maximise(
        problem.target, problem.records, [start], ALONE, optimizer=optimizer, steps=8, held=held
    )
    for name in start:
        same = torch.allclose(found.values[name], start[name], rtol=1e-12)
        assert same == (name in held), name
    assert found.energy < before


@pytest.fixture(scope="module")
def rounds():
    """A spring, its joint mode and the one with kernels by the evidence."""
    problem = Problem.of(dgp.NonlinearFeedback(1), PLANT.train[:300])
    points = starting_points(problem.target, problem.records, ALONE, count=2, steps=20)
    best = maximise(
        problem.target, problem.records, points, ALONE, optimizer="gauss-newton", steps=40
    )[0]
    return problem, best, with_kernels_by_evidence(
        problem.target, problem.records, best, ALONE, "kernels"
    )[0]  # fmt: skip


def test_the_spring_is_smooth(rounds):
    """The joint mode has a short lengthscale under a cubic, the evidence a long one."""
    problem, joint, found = rounds
    before, after = (
        _Expansion.at(problem.target, problem.records, one.values) for one in (joint, found)
    )
    assert after.energy < before.energy - 3.0
    assert after.joint > before.joint
    assert float(joint.values["f_lengthscale"]) < 0.7
    assert float(found.values["f_lengthscale"]) > 1.3
    assert len(found.history) > len(joint.history)


@pytest.mark.parametrize(("gain", "climbs"), [(0.9 * SETTLED, 0), (1.1 * SETTLED, 1)])
def test_a_small_gain_ends_the_rounds(rounds, monkeypatch, gain, climbs):
    problem, _, found = rounds
    count = []

    def climb(*args, **options):
        count.append(args)
        return [found]

    monkeypatch.setattr(_Expansion, "best", lambda self: (found.values, gain))
    monkeypatch.setattr(function_evidence, "maximise", climb)
    kept, _ = with_kernels_by_evidence(problem.target, problem.records, found, ALONE, "small")
    assert kept is found
    assert len(count) == climbs


def test_no_more_than_the_rounds_that_are_wanted(rounds):
    problem, joint, found = rounds
    (records,) = (problem.records,)
    one, energy = with_kernels_by_evidence(problem.target, records, joint, ALONE, "one", rounds=1)
    energies = [
        _Expansion.at(problem.target, records, x.values).energy for x in (joint, one, found)
    ]
    assert energy == energies[1]
    assert energies[0] > energies[1] >= energies[2]


def test_a_round_that_lowers_the_evidence_is_not_taken(rounds, monkeypatch):
    problem, _, found = rounds

    def worse(self):
        z = self.z.copy()
        z[self.potential.places(["f_lengthscale"])] -= 3.0
        return self.potential.unpack(torch.tensor(z)), 1.0

    monkeypatch.setattr(_Expansion, "best", worse)
    kept, _ = with_kernels_by_evidence(problem.target, problem.records, found, ALONE, "worse")
    assert kept is found


def test_optima_of_known_functions_stay():
    known = dgp.Known(lambda y: y**3, range=(-3.0, 3.0))
    model = dgp.Cascade(1, (dgp.Dynamic(feedback=("f",)), known), output="g")
    problem = Problem.of(model, PLANT.train[:100])
    optima = [Optimum(energy, {}, np.zeros(1), "") for energy in (0.0, 1.0, 2.0)]
    assert kernels_by_evidence(problem.target, problem.records, optima, ALONE) == optima


def test_the_evidence_chooses_among_two_optima(rounds, monkeypatch):
    """The more probable one under its own kernel is not the one with more evidence."""
    problem, joint, found = rounds

    def kept(model, records, one, *_, **__):
        return one, _Expansion.at(model, records, one.values).energy

    monkeypatch.setattr(function_evidence, "with_kernels_by_evidence", kept)
    assert joint.energy < found.energy
    for optima in ([joint, found], [found, joint], [joint, found, joint]):
        best = kernels_by_evidence(problem.target, problem.records, optima, ALONE)
        assert best == [found]


@pytest.mark.parametrize(
    ("energies", "kept"),
    [
        ((3.0, 1.0, 0.0), [1, 0]),  # the third is not looked at
        ((1.0, 1.0 + 0.9 * BEHIND), [0, 1]),
        ((1.0, 1.0 + 1.1 * BEHIND), [0]),
        ((np.inf, 1.0), [1]),
    ],
)
def test_optima_without_feedback_stay_beside_the_best(monkeypatch, energies, kept):
    """In the order of the evidence of their kernels; those that lag far behind are left."""
    problem = Problem.of(dgp.Hammerstein(1, pairs=1, inducing=4), PLANT.train[:60])
    optima = [Optimum(0.0, {}, np.zeros(1), str(k)) for k in range(len(energies))]

    def looked_at(model, records, one, *_, **__):
        return one, energies[int(one.message)]

    monkeypatch.setattr(function_evidence, "with_kernels_by_evidence", looked_at)
    found = kernels_by_evidence(problem.target, problem.records, optima, ALONE)
    assert [int(one.message) for one in found] == kept


@pytest.mark.parametrize(("lag", "climbs"), [(BEHIND - 0.1, 2), (BEHIND + 0.1, 1)])
def test_an_optimum_that_stays_behind_is_left(rounds, monkeypatch, lag, climbs):
    """After a round: the first one gains tens of nats."""
    problem, _, found = rounds
    levels = iter([100.0, 90.0, 80.0])
    count = []

    class Place:
        def __init__(self, *_):
            self.energy = next(levels)

        def best(self):
            return found.values, 2.0 * SETTLED

    def climb(*args, **options):
        count.append(args)
        return [found]

    monkeypatch.setattr(_Expansion, "at", Place)
    monkeypatch.setattr(function_evidence, "maximise", climb)
    with_kernels_by_evidence(
        problem.target, problem.records, found, ALONE, "behind", rounds=2, enough=90.0 - lag
    )
    assert len(count) == climbs


def test_free_runs_of_a_default_fit_keep_to_the_spring():
    """Draws under the joint mode's kernel spread so far that 50 % bands hold 97 %."""
    plant = simulate_duffing(0, noise_ratio=0.01)
    fit = dgp.fit(dgp.NonlinearFeedback(1), plant.train, workers=1, progress=False, restarts=2)
    found = dgp.scores(fit.forecast(plant.train, plant.test, seed=0), plant.test)
    assert found["rmse"] < 1.15 * plant.noise_sd
    assert found["coverage_50"] < 0.75
    assert found["coverage_95"] > 0.9


def test_a_refit_keeps_to_the_evidence(rounds):
    """On the same data nothing changes much; a function that is added gets a smooth kernel, too."""
    problem, _, found = rounds
    fit = at_optimum(problem.model, [found], 0, problem.records)
    again = refit(fit, fit.records)
    ratio = float(again.mode["f_lengthscale"] / fit.mode["f_lengthscale"])
    assert 0.5 < ratio < 2.5
    line = dgp.fit(
        dgp.LinearDynamicGP(1, pairs=1), PLANT.train[:300], method="map", workers=1, progress=False
    )
    model = with_feedback(replace(line.model, scaling=None))
    grown = refit(line, line.records[0], model=model)
    name = kernel_sites(grown.model)[0]
    assert float(grown.mode[name]) > 1.0


def test_next_to_a_run_that_grows_without_bound_there_is_no_evidence(rounds, monkeypatch):
    problem, _, found = rounds
    steep = {**found.values, "f_values": 30.0 * found.values["f_values"]}
    wild, at = replace(found, values=steep), _Expansion.at

    def beyond(model, records, values):
        here = at(model, records, values)
        return replace(here, fisher=torch.nan * here.fisher) if values is steep else here

    monkeypatch.setattr(_Expansion, "at", beyond)
    kept, energy = with_kernels_by_evidence(problem.target, problem.records, wild, ALONE, "wild")
    assert kept is wild
    assert energy == math.inf
    with pytest.raises(ValueError, match="predictions run away, so that kernels of functions"):
        kernels_by_evidence(problem.target, problem.records, [wild, wild], ALONE)
    both = kernels_by_evidence(problem.target, problem.records, [wild, found], ALONE)
    assert both[0].values["f_lengthscale"] == found.values["f_lengthscale"]
    # Nor is it where a round leads to.
    monkeypatch.setattr(_Expansion, "best", lambda self: (steep, 1.0))
    monkeypatch.setattr(function_evidence, "maximise", lambda *args, **options: [wild])
    assert with_kernels_by_evidence(problem.target, problem.records, found, ALONE, "to")[0] is found


def test_steep_likelihoods_have_an_evidence_too():
    """P is not positive definite in double precision where the Fisher matrix is that large."""
    here = expansion("one function")
    one = torch.tensor(np.random.default_rng(0).standard_normal(len(here.places)))
    steep = replace(here, fisher=1e20 * torch.outer(one, one))
    values, gain = steep.best()
    assert np.isfinite(gain)
    assert gain >= 0.0
    assert all(bool(torch.isfinite(value).all()) for value in values.values())


class TestFreeRunsWithKernelsByEvidence:
    """Process noise that a climb of kernels lets in must not be paid for by free runs."""

    def found(self, monkeypatch, *errors):
        """The optimum and its evidence where the free runs of each climb have these errors."""
        problem, start = begun(MODELS["one function"])
        given = Optimum(values=start, energy=0.0, history=np.zeros(1), message="given")
        told = iter([1.0, *errors])
        monkeypatch.setattr(function_evidence, "free_run_error", lambda *_: next(told))
        one, _ = with_kernels_by_evidence(
            problem.target, problem.records, given, ALONE, "kernels", rounds=1
        )
        assert next(told, None) is None
        return start, one.values

    def moved(self, start, values, part):
        """But for rounding: a pair's phase, which nothing depends on, is put in its place."""
        before, after = (x[f"g_noise_gain_{part}"] for x in (start, values))
        return float((after - before).abs().max()) > 1e-12

    def test_a_climb_with_free_runs_as_good_is_taken(self, monkeypatch):
        start, values = self.found(monkeypatch, 1.24)
        assert self.moved(start, values, "unit")
        assert self.moved(start, values, "local_scale")

    def test_noise_is_held_where_they_are_worse(self, monkeypatch):
        start, values = self.found(monkeypatch, 1.26, 1.0)
        assert not torch.equal(start["f_lengthscale"], values["f_lengthscale"])
        assert not torch.equal(start["f_values"], values["f_values"])
        assert not self.moved(start, values, "unit")
        assert not self.moved(start, values, "local_scale")

    @pytest.mark.parametrize("again", [1.26, np.inf, np.nan])
    def test_nothing_is_taken_where_they_stay_worse(self, monkeypatch, again):
        start, values = self.found(monkeypatch, np.nan, again)
        assert values is start

    def test_forward_cascades_are_not_asked(self, monkeypatch):
        problem, start = begun(MODELS["at the output"])
        given = Optimum(values=start, energy=0.0, history=np.zeros(1), message="given")
        monkeypatch.setattr(function_evidence, "free_run_error", None)
        one, _ = with_kernels_by_evidence(
            problem.target, problem.records, given, ALONE, "kernels", rounds=1
        )
        assert one.values is not start
