"""Measurement noise in the filter: mixtures for a Student-t, their moments and derivatives."""

from dataclasses import replace

import numpy as np
import pyro
import pytest
import torch
from scipy.integrate import quad
from scipy.stats import norm, t

import pyro_dynogp as dgp
from pyro_dynogp.layers.noise import Gaussian, StudentT, student_components
from pyro_dynogp.moments.noise import noise_adjoint, noise_terms
from pyro_dynogp.moments.problem import log_density
from tests.conftest import simulate_record
from tests.lti import oracles
from tests.lti.dense import signal_covariance
from tests.lti.oracles import tensor
from tests.moments.problems import element, random_problem
from tests.moments.wiener import Wiener


# Bounds: log-density over +-3 and over +-10 scales [nats], variance (relative). Far tails are up to
# 15 % too light between the components (more where nu is so large that nobody needs a Student-t);
# the variance misses what lies beyond the last component.
@pytest.mark.parametrize(("nu", "middle", "error", "variance"), [
    (2.5, 0.08, 0.15, 0.12),
    (3.0, 0.08, 0.15, 0.08),
    (4.0, 0.06, 0.14, 0.05),
    (10.0, 0.04, 0.15, 0.015),
    (50.0, 0.02, 0.24, 0.002),
])  # fmt: skip
def test_mixture_is_a_student_t(nu, middle, error, variance):
    share, multiple = student_components(nu)
    assert share.sum() == pytest.approx(1.0, rel=1e-14)
    assert (share > 0.0).all()
    assert (np.diff(multiple) < 0.0).all()  # bins of rising precision
    x = np.linspace(-10.0, 10.0, 801)
    mixture = np.log(norm.pdf(x[:, None], 0.0, np.sqrt(multiple)) @ share)
    off = np.abs(mixture - t.logpdf(x, nu))
    assert off.max() < error
    assert off[np.abs(x) <= 3.0].max() < middle
    assert share @ multiple == pytest.approx(t.var(nu), rel=variance)
    # Precisions keep their mean exactly, by the choice of each bin's.
    assert share @ (1.0 / multiple) == pytest.approx(1.0, rel=1e-12)


def test_gaussian_is_one_component():
    assert [x.tolist() for x in Gaussian().components()] == [[1.0], [1.0]]
    assert len(StudentT(4.0).components()[0]) > 10


def mixture(r, s, R, share, multiple):
    """Value, alpha and beta as torch sees them: derivatives by automatic differentiation."""
    r = r if r.requires_grad else r.requires_grad_()
    S = s + R * torch.tensor(multiple)
    l = torch.logsumexp(
        torch.tensor(np.log(share)) - 0.5 * (2 * np.pi * S).log() - 0.5 * r**2 / S, -1
    )
    (slope,) = torch.autograd.grad(l, r, create_graph=True)
    (curvature,) = torch.autograd.grad(slope, r, create_graph=True)
    return l, -slope, -curvature


CASES = [(0.3, 0.5, 0.2), (-1.7, 0.05, 0.4), (6.0, 0.1, 0.05), (0.0, 0.3, 0.3), (-40.0, 1e-3, 0.1)]


@pytest.mark.parametrize("nu", [None, 3.0, 8.0])
@pytest.mark.parametrize("at", CASES)
def test_noise_terms_and_their_adjoint(nu, at):
    share, multiple = Gaussian().components() if nu is None else student_components(nu)
    leaf = [torch.tensor(x, dtype=torch.float64, requires_grad=True) for x in at]
    expected = mixture(*leaf, share, multiple)
    found = noise_terms(*at, share, multiple)
    np.testing.assert_allclose(found, [float(x.detach()) for x in expected], rtol=1e-9, atol=1e-12)
    for bars in (np.eye(3), np.array([[0.7, -1.3, 0.4]])):
        for bar in bars:
            total = sum(b * x for b, x in zip(bar.tolist(), expected, strict=True))
            grads = torch.autograd.grad(total, leaf, retain_graph=True, allow_unused=True)
            ours = noise_adjoint(*at, share, multiple, *bar)
            theirs = [0.0 if g is None else float(g) for g in grads]
            atol = 1e-9 * max(1.0, *np.abs(theirs))
            np.testing.assert_allclose(ours, theirs, rtol=1e-8, atol=atol)


@pytest.mark.parametrize("at", CASES[:4])
def test_noise_adjoint_by_finite_differences(at):
    share, multiple = student_components(4.0)
    h = 1e-6
    for index in range(3):
        plus, minus = (
            np.array(noise_terms(*(x + s * h * (i == index) for i, x in enumerate(at)),
                                 share, multiple))
            for s in (1.0, -1.0)
        )  # fmt: skip
        slope = (plus - minus) / (2.0 * h)
        ours = [noise_adjoint(*at, share, multiple, *bar)[index] for bar in np.eye(3)]
        np.testing.assert_allclose(ours, slope, rtol=1e-5, atol=1e-6)


def test_an_outlier_pulls_a_gaussian_but_not_a_student_t():
    share, multiple = student_components(4.0)
    _, gaussian, _ = noise_terms(20.0, 0.1, 0.1, np.ones(1), np.ones(1))
    _, student, curvature = noise_terms(20.0, 0.1, 0.1, share, multiple)
    assert gaussian == pytest.approx(100.0)
    assert 0.0 < student < 2.0
    # Where two explanations compete the state may become less certain than before.
    assert curvature < 0.0


def test_one_sample_of_student_t_noise_is_exact_but_for_the_mixture():
    """A Gaussian signal of variance s plus Student-t noise: their convolution, by quadrature."""
    problem = random_problem((), n=1, student=True, missing=False, seed=3)
    share, multiple = student_components(4.0)
    layout = problem.layout._replace(share=share, multiple=multiple)
    problem = replace(problem, layout=layout)
    values = element(problem)
    h = values.H[0]
    mean, s = h @ values.m0 + values.y_offset[0, 0], h @ values.P0 @ h
    scale = np.sqrt(values.R[0, 0])

    def joint(g):
        return norm.pdf(g, mean, np.sqrt(s)) * t.pdf(values.y[0, 0], 4.0, g, scale)

    exact, _ = quad(joint, mean - 12 * np.sqrt(s), mean + 12 * np.sqrt(s), limit=200)
    assert float(log_density(problem)) == pytest.approx(np.log(exact), abs=0.02)


@pytest.mark.parametrize("outlier", [0.0, 1.5])
def test_student_t_along_a_record(outlier):
    """Linear g, three samples, against a grid over g; measured error 0.02 nats, 0.1 with outlier.

    Moments of the mixture are exact at each sample; what they lose is the shape of the posterior.
    """
    share, multiple = student_components(4.0)
    errors, gaussian = [], []
    for seed in range(6):
        w = Wiener("mild", 3, seed=seed, noise_sd=0.15)
        y = w.y.copy()
        y[1] += outlier
        line = torch.linspace(-8.0, 8.0, w.problem().table_mean.shape[-1], dtype=torch.float64)
        problem = replace(w.problem(), table_mean=line.unsqueeze(0), y=tensor(y).unsqueeze(-1))
        layout = problem.layout._replace(share=share, multiple=multiple)
        student = replace(problem, layout=layout)
        value = float(log_density(student))
        z = np.linspace(-6.0, 6.0, 61)
        Z = np.stack([a.reshape(-1) for a in np.meshgrid(z, z, z, indexing="ij")])
        g = w.known[:, None] + np.linalg.cholesky(w.covariance) @ Z
        log_w = norm.logpdf(Z).sum(0) + t.logpdf(y[:, None], 4.0, g, w.noise_sd).sum(0)
        exact = np.logaddexp.reduce(log_w) + 3 * np.log(z[1] - z[0])
        errors.append(abs(value - exact))
        gaussian.append(abs(float(log_density(problem)) - exact))
    assert max(errors) < (0.3 if outlier else 0.05)
    if outlier:
        assert np.mean(gaussian) > 10.0 * np.mean(errors)


def given(model, record, values):
    conditioned = pyro.poutine.condition(model, data=values)
    trace = pyro.poutine.trace(conditioned).get_trace(record)
    trace.compute_log_prob()
    return trace.nodes


@pytest.mark.parametrize("of", ["inputs", "output"])
@pytest.mark.parametrize("outputs", [1, 2])
def test_varying_noise_is_one_function_for_explicit_and_collapsed_model(outputs, of):
    """Hammerstein: given f the outputs are exactly Gaussian, of the explicit model's variances."""
    modes = dgp.Modes([-0.5 + 2.0j], [[1.0 + 0.3j]], np.ones((outputs, 1)), [[0.2 + 0.1j]])
    record = simulate_record(modes, 0.2, n=30)
    model = dgp.Hammerstein(
        1,
        outputs=outputs,
        pairs=1,
        inducing=6,
        likelihood=dgp.Heteroscedastic(inducing=5, of=of),
        initial_state="zero",
    ).scaled_to(record)
    with torch.random.fork_rng():
        torch.manual_seed(3)
        drawn = pyro.poutine.trace(model).get_trace(record)
    values = {
        name: node["value"]
        for name, node in drawn.nodes.items()
        if node["type"] == "sample" and name not in ("y", "g", "f", "f_residual")
    }
    values["f_residual"] = torch.zeros_like(drawn.nodes["f_residual"]["value"])
    nodes = given(model, record, values)
    sd = torch.broadcast_to(nodes["y"]["fn"].base_dist.scale, record.outputs.squeeze().shape)
    assert sd.max() > 1.2 * sd.min()
    scale, shift = tensor(model.scaling.output_scale), tensor(model.scaling.output_offset)
    # The trajectory of the explicit model without its jitter, plus its noise: a dense normal.
    process = nodes["g"]["fn"]
    level = values["offset"] if outputs > 1 else values["offset"][0]
    mean = (process.mean + level) * scale + shift
    S = signal_covariance(process.modes, record.time, record.time, process.initial_covariance)
    each = np.tile(scale.numpy(), len(record))
    K = S.numpy() * np.outer(each, each) + np.diag(sd.numpy().reshape(-1) ** 2)
    y = record.outputs.reshape(-1)
    expected = oracles.log_density(y - mean.numpy().reshape(-1), K)
    collapsed = given(model.collapsed, record, values)["y"]["log_prob_sum"]
    # The path of f with a residual of zero is its mean, up to the jitter of its factorisation.
    assert float(collapsed) == pytest.approx(expected, rel=1e-7)
