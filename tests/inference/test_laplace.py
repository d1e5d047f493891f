"""Normals by the Fisher matrix of one-step predictions, and the evidence that they give."""

import math

import numpy as np
import pyro
import pyro.distributions as dist
import pytest
import torch

import pyro_dynogp as dgp
from pyro_dynogp.inference.bayes_factor import counted, log_bayes_factor, log_evidence_of
from pyro_dynogp.inference.density import Potential
from pyro_dynogp.inference.laplace import fisher_normal, laplace, log_evidence
from pyro_dynogp.inference.methods.base import Problem
from pyro_dynogp.inference.methods.normal import log_weights
from pyro_dynogp.inference.optimise.descent import WIDEST
from pyro_dynogp.inference.optimise.innovation_energy import Innovations
from pyro_dynogp.inference.run import Run
from pyro_dynogp.inference.starts.plans import starting_points
from tests.conftest import simulate_record
from tests.inference.test_log_joint import GAPS

LONG = simulate_record(dgp.Modes([-0.6 + 2.0j], [[0.8 + 0.3j]], [1.0], [[0.15]]), 1e-2, n=150)
HAMMERSTEIN = dgp.Hammerstein(1, pairs=1, inducing=5)


def begun(model, record=GAPS):
    """Potential of a model, and values near its start."""
    problem = Problem.of(model, record)
    (start,) = starting_points(problem.target, problem.records, Run(workers=1), count=1, steps=5)
    return Potential(problem.target, (problem.records,), start), start


def of_values(model, record=GAPS):
    """The potential of a function's values, all else fixed, and where they start."""
    potential, start = begun(model, record)
    fixed = {name: x for name, x in start.items() if name != "f_values"}
    free = {"f_values": torch.zeros_like(start["f_values"])}
    return Potential(potential.model, potential.args, free, fixed), free


def test_where_outputs_are_linear_in_the_values_it_is_the_posterior():
    """A function of the input: its values have a normal posterior, given all else."""
    potential, start = of_values(HAMMERSTEIN)
    centre, root = fisher_normal(potential, start)
    z, inverse = laplace(potential, start)
    np.testing.assert_allclose(centre, z, atol=1e-4)
    np.testing.assert_allclose(root @ root.T, inverse @ inverse.T, atol=1e-5)
    weights = log_weights(potential, torch.as_tensor(centre), torch.as_tensor(root), 0)
    assert float(weights.std()) < 1e-3


def test_the_centre_is_where_values_are_without_steps():
    potential, start = of_values(HAMMERSTEIN)
    assert np.abs(fisher_normal(potential, start)[0]).max() > 0.1
    assert not fisher_normal(potential, start, steps=0)[0].any()


@pytest.mark.parametrize("likelihood", [dgp.Gaussian(), dgp.StudentT(3.0)])
def test_near_the_posterior_where_outputs_are_not_linear_in_them(likelihood):
    """Half the variance of the log ratios is the divergence, where it is small."""
    nu, y = likelihood.degrees_of_freedom, LONG.outputs
    noise = np.random.default_rng(0).standard_t(nu or 1e6, y.shape)
    record = LONG.with_outputs(y + 0.3 * np.nanstd(y) * noise)
    model = dgp.Wiener(1, pairs=1, inducing=5, likelihood=likelihood)
    potential, start = of_values(model, record)
    centre, root = (torch.as_tensor(x) for x in fisher_normal(potential, start))
    assert 0.5 * float(log_weights(potential, centre, root, 0).var()) < 0.5
    wider = log_weights(potential, centre, 2.0 * root, 0)
    assert 0.5 * float(wider.var()) > 1.0  # what it would be of another normal


@pytest.mark.parametrize("limited", [True, False])
def test_none_without_a_fisher_matrix(limited):
    if not limited:  # a user's own model

        def model(y):
            x = pyro.sample("x", dist.Normal(torch.tensor(0.0).double(), 1.0))
            pyro.sample("y", dist.Normal(x, 1.0), obs=y)

        start = {"x": torch.tensor(0.3).double()}
        potential = Potential(model, (torch.tensor(1.0).double(),), start)
    else:
        function = dgp.Static(mean="linear", limits=(0.0, None), inducing=5)
        potential, start = begun(dgp.Cascade(1, (dgp.Dynamic(pairs=1), function)))
    assert fisher_normal(potential, start) is None
    assert np.isfinite(log_evidence(potential, start))


def test_evidence_of_functions_takes_no_hessian(monkeypatch):
    potential, start = begun(HAMMERSTEIN)
    z = potential.pack(start).numpy()
    here = Innovations(potential, jacobian=True).local(z)
    curvature = np.maximum(np.linalg.eigvalsh(here.fisher + here.prior), WIDEST**-2)
    energy = potential.value_and_gradient(z, jacobian=True)[0]
    expected = -energy - 0.5 * np.log(curvature / (2.0 * math.pi)).sum()
    monkeypatch.setattr(Potential, "hessian", lambda *args, **options: pytest.fail("a Hessian"))
    assert log_evidence(potential, start) == pytest.approx(expected)


def test_inducing_values_that_tell_nothing_are_no_parameters():
    """Twenty more of them would cost 50 nats by Schwarz's criterion."""
    few, many = (
        dgp.fit(dgp.Hammerstein(1, pairs=1, inducing=inducing), LONG, method="map", restarts=2,
                workers=1, progress=False)
        for inducing in (10, 30)
    )  # fmt: skip
    assert counted(many)[0] - counted(few)[0] == 20
    assert abs(log_bayes_factor(many, few)) < 3.0
    assert log_bayes_factor(few, many) == pytest.approx(-log_bayes_factor(many, few))


def test_no_evidence_next_to_runs_that_grow_without_bound(monkeypatch):
    fit = dgp.fit(
        dgp.LinearDynamicGP(1), GAPS, method="map", restarts=1, steps=1, workers=1, progress=False
    )
    assert np.isfinite(log_evidence_of(fit))
    for value in (np.nan, np.inf):
        matrix = np.full((9, 9), value)
        monkeypatch.setattr(Potential, "hessian", lambda *a, matrix=matrix, **k: matrix)
        assert log_evidence_of(fit) == -math.inf
        assert not log_bayes_factor(fit, fit) > 0.0


def test_energies_without_gradients():
    """Of a model that takes batches and of one that does not."""
    rng = np.random.default_rng(0)
    potential, start = begun(HAMMERSTEIN)
    z = potential.pack(start).numpy() + 0.1 * rng.standard_normal((5, potential.size))

    def model():
        x = pyro.sample("x", dist.Normal(torch.zeros(2).double(), 1.0).to_event(1))
        assert x.shape == (2,)

    plain = Potential(model, (), {"x": torch.zeros(2).double()})
    for one, points in ((potential, z), (plain, rng.standard_normal((5, 2)))):
        expected = one.values_and_gradients(points, jacobian=True)[0]
        np.testing.assert_allclose(one.energies(torch.tensor(points)), expected, rtol=1e-10)
