"""The log joint density as a function of one vector."""

import numpy as np
import pyro
import pyro.distributions as dist
import pytest
import torch
from scipy import stats
from scipy.optimize import approx_fprime

import pyro_dynogp as dgp
from pyro_dynogp.inference.density import Potential
from pyro_dynogp.inference.laplace import laplace, log_evidence
from pyro_dynogp.inference.optimise.descent import bounded_root
from pyro_dynogp.inference.starts.poles import starting_values


@pytest.fixture(scope="module")
def potential(record):
    model = dgp.LinearDynamicGP(inputs=1, pairs=2).scaled_to(record)
    values = starting_values(model, model.prepare(record), count=1, seed=0)[0]
    return Potential(model, (record,), values), values


@pytest.mark.parametrize("jacobian", [False, True])
def test_gradient_against_finite_differences(potential, jacobian):
    function, values = potential
    z = function.pack(values).numpy() + 0.05 * np.random.default_rng(0).standard_normal(
        function.size
    )
    numeric = approx_fprime(z, lambda x: function.value_and_gradient(x, jacobian=jacobian)[0], 1e-6)
    exact = function.value_and_gradient(z, jacobian=jacobian)[1]
    np.testing.assert_allclose(exact, numeric, rtol=2e-4, atol=1e-4 * np.abs(exact).max())


def test_pack_and_unpack_are_inverse(potential):
    function, values = potential
    again = function.unpack(function.pack(values))
    for name, value in values.items():
        torch.testing.assert_close(again[name], value, rtol=1e-10, atol=1e-12)


def test_a_value_on_a_boundary_has_a_finite_vector_next_to_it(potential):
    function, values = potential
    (frequency,) = (site for site in function.sites if site.name == "g_log_frequency")
    top = frequency.transform(torch.full_like(values["g_log_frequency"], 100.0))
    z = function.pack({**values, "g_log_frequency": top})
    assert torch.isfinite(z).all()
    torch.testing.assert_close(function.unpack(z)["g_log_frequency"], top, rtol=0.0, atol=1e-11)
    centre, root = laplace(function, {**values, "g_log_frequency": top})
    assert np.isfinite(centre).all()
    assert np.isfinite(root).all()


def test_energy_is_the_trace_of_the_model(potential, record):
    function, values = potential
    conditioned = pyro.poutine.condition(function.model, data=values)
    expected = -float(pyro.poutine.trace(conditioned).get_trace(record).log_prob_sum())
    assert function.value_and_gradient(function.pack(values).numpy())[0] == pytest.approx(expected)


def test_jacobian_makes_a_density_of_the_unconstrained_vector():
    """A log-normal variable has a normal logarithm: the energy with Jacobian must say so."""

    def model():
        pyro.sample("x", dist.LogNormal(torch.tensor(0.3).double(), 0.7))

    function = Potential(model, (), {"x": torch.tensor(1.0).double()})
    for z in (-1.0, 0.5):
        expected = -torch.distributions.Normal(0.3, 0.7).log_prob(torch.tensor(z))
        got = function.value_and_gradient(np.array([z]), jacobian=True)[0]
        assert got == pytest.approx(float(expected), rel=1e-6)


def test_hessian_and_bounded_root_of_a_normal():
    covariance = np.array([[2.0, 0.6], [0.6, 0.5]])

    def model():
        mean = torch.zeros(2, dtype=torch.float64)
        pyro.sample("x", dist.MultivariateNormal(mean, torch.as_tensor(covariance)))

    function = Potential(model, (), {"x": torch.zeros(2, dtype=torch.float64)})
    H = function.hessian(np.array([0.2, -0.1]))
    np.testing.assert_allclose(H, np.linalg.inv(covariance), rtol=1e-6)
    root = bounded_root(H)
    np.testing.assert_allclose(root @ root.T, covariance, rtol=1e-6)


def test_bounded_root_bounds_flat_directions():
    """And takes upward curvature for downward curvature (tests/inference/test_descent.py)."""
    root = bounded_root(np.diag([4.0, 0.0, -1.0]))
    np.testing.assert_allclose(np.diag(root @ root.T), [0.25, 2.25, 1.0])


def test_out_of_range_is_a_wall_not_a_crash(potential):
    function, values = potential
    z = function.pack(values).numpy()
    z[:] = 800.0
    energy, gradient = function.value_and_gradient(z)
    assert energy == 1e15
    assert not gradient.any()


def test_a_matrix_without_a_factor_is_a_wall_too():
    def model():
        x = pyro.sample("x", dist.Normal(torch.tensor(0.0).double(), 1.0))
        root = torch.linalg.cholesky(x * torch.eye(2, dtype=torch.float64))
        pyro.sample("y", dist.Normal(root.sum(), 1.0), obs=torch.tensor(0.0).double())

    function = Potential(model, (), {"x": torch.tensor(1.0).double()})
    assert function.value_and_gradient(np.array([0.5]))[0] < 1e3
    assert function.value_and_gradient(np.array([-0.5])) == (1e15, np.zeros(1))


def test_every_latent_site_needs_a_value():
    def model():
        pyro.sample("x", dist.Normal(0.0, 1.0))
        pyro.sample("z", dist.Normal(0.0, 1.0))

    with pytest.raises(ValueError, match=r"values: expected a value for every latent site.*'z'"):
        Potential(model, (), {"x": torch.tensor(0.0)})


def test_evidence_of_a_linear_model_is_exact():
    rng = np.random.default_rng(3)
    A = rng.standard_normal((9, 3))
    y, sd, prior = rng.standard_normal(9), 0.4, 1.3

    def model():
        x = pyro.sample("x", dist.Normal(torch.zeros(3).double(), prior).to_event(1))
        pyro.sample("y", dist.Normal(torch.tensor(A) @ x, sd).to_event(1), obs=torch.tensor(y))

    mode = np.linalg.solve(A.T @ A / sd**2 + np.eye(3) / prior**2, A.T @ y / sd**2)
    potential = Potential(model, (), {"x": torch.tensor(mode)})
    covariance = prior**2 * A @ A.T + sd**2 * np.eye(9)
    expected = stats.multivariate_normal(np.zeros(9), covariance).logpdf(y)
    assert log_evidence(potential, potential.at) == pytest.approx(expected, rel=1e-6)


def test_evidence_prefers_a_broad_hill_to_a_needle():
    weights = torch.tensor([0.02, 0.98]).double().log()

    def model():
        x = pyro.sample("x", dist.Normal(torch.tensor(0.0).double(), 3.0))
        hills = dist.Normal(torch.tensor([-2.0, 2.0]).double(), torch.tensor([1e-3, 0.5]).double())
        pyro.factor("hills", torch.logsumexp(weights + hills.log_prob(x.unsqueeze(-1)), -1))

    found = {}
    for name, at in (("needle", -2.0), ("hill", 2.0)):
        potential = Potential(model, (), {"x": torch.tensor(at).double()})
        found[name] = (
            -potential.value_and_gradient(np.array([at]))[0],
            log_evidence(potential, potential.at),
        )
    assert found["needle"][0] > found["hill"][0] + 2.0
    # Both hills stand where the prior is equal: shares of the mass are the weights.
    difference = found["hill"][1] - found["needle"][1]
    assert difference == pytest.approx(np.log(49.0), abs=0.05)
