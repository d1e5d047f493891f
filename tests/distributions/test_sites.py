"""Honest sites: the value of a trajectory, and every hyperparameter, is used.

Where an inducing or latent site is decoration, conditioning it on another value leaves the
likelihood unchanged, and everything computed from such a site is wrong.
"""

import pytest
import torch
from pyro import poutine
from scipy.stats import norm

from pyro_dynogp.distributions.process import LTIProcess
from pyro_dynogp.lti.modes import Modes
from pyro_dynogp.lti.state import ModalState
from tests.distributions.cases import make
from tests.distributions.models import N, data, inputs, latent
from tests.lti import oracles
from tests.lti.oracles import tensor

HYPER = {
    "decay": torch.tensor([0.7, 1.4], dtype=torch.float64),
    "gain": torch.tensor([0.5, -1.0], dtype=torch.float64),
    "noise": torch.tensor(0.8, dtype=torch.float64),
    "sigma": torch.tensor(0.5, dtype=torch.float64),
}


def densities(**values):
    """Log-densities of the sites of the latent model at the given values."""
    conditioned = poutine.condition(latent, HYPER | values)
    trace = poutine.trace(conditioned).get_trace(inputs(), data())
    trace.compute_log_prob()
    return {name: trace.nodes[name]["log_prob_sum"].item() for name in ("g", "y")}


def test_the_likelihood_follows_the_trajectory():
    for shift in (0.0, 0.4):
        g = torch.sin(torch.arange(N, dtype=torch.float64)) + shift
        expected = norm(g.numpy(), 0.5).logpdf(data().numpy()).sum()
        assert densities(g=g)["y"] == pytest.approx(expected, rel=1e-12)


def test_a_single_sample_of_the_trajectory_matters():
    g = torch.zeros(N, dtype=torch.float64)
    base = densities(g=g)
    for k in range(N):
        other = g.clone()
        other[k] = 0.5
        assert abs(densities(g=other)["y"] - base["y"]) > 1e-3
        assert abs(densities(g=other)["g"] - base["g"]) > 1e-3


@pytest.mark.parametrize("name", ["decay", "gain", "noise"])
def test_hyperparameters_enter_through_the_trajectory(name):
    g = torch.sin(torch.arange(N, dtype=torch.float64))
    base, other = densities(g=g), densities(g=g, **{name: 1.1 * HYPER[name]})
    assert abs(base["g"] - other["g"]) > 1e-2
    assert base["y"] == other["y"]


def real_leaves(case):
    """Every real number that defines the system, as one tensor for each kind."""
    s = case.system
    leaves = {
        "poles": torch.view_as_real(tensor(s.poles)),
        "input_gain": torch.view_as_real(tensor(s.B_modal)),
        "output_gain": torch.view_as_real(tensor(s.c if s.several else s.c[0])),
        "noise_gain": torch.view_as_real(tensor(s.L_modal)),
        "feedthrough": tensor(s.D if s.several else s.D[0]),
        "state": tensor([[0.3, 0.1], [-0.4, 1.0]]),
        "covariance": tensor(oracles.random_covariance(4)),
        "offset": torch.full((2,) if s.several else (), 0.2, dtype=torch.float64),
        "sigma": torch.tensor(0.3, dtype=torch.float64),
        "inputs": tensor(case.inputs),
    }
    return {name: value.clone().requires_grad_() for name, value in leaves.items()}


def rebuilt(case, leaf):
    complex_ = {
        name: torch.view_as_complex(leaf[name])
        for name in ("poles", "input_gain", "output_gain", "noise_gain")
    }
    modes = Modes(**complex_, feedthrough=leaf["feedthrough"], noise=case.system.noise)
    state = ModalState(torch.view_as_complex(leaf["state"]), leaf["covariance"])
    return LTIProcess(modes, case.time, leaf["inputs"], state, jitter=1e-4, offset=leaf["offset"])


@pytest.mark.parametrize("noise", ["shared", "independent"])
@pytest.mark.parametrize("outputs", [None, 2])
@pytest.mark.parametrize("kind", ["trajectory", "observed", "posterior", "sample"])
def test_every_number_of_the_system_changes_the_density(kind, outputs, noise):
    case = make(outputs=outputs, noise=noise)
    y, h = case.event(case.draw(seed=1)), case.event(case.draw(seed=2))

    def value(leaf):
        g = rebuilt(case, leaf)
        if kind == "trajectory":
            return g.log_prob(h)
        if kind == "observed":
            return g.observed(leaf["sigma"]).log_prob(y)
        if kind == "posterior":
            return g.condition(y, leaf["sigma"]).log_prob(h)
        weights = torch.arange(1.0, h.numel() + 1, dtype=torch.float64).reshape(h.shape)
        return (weights * g.observed(leaf["sigma"]).from_innovations(h)).sum()

    leaf = real_leaves(case)
    grads = torch.autograd.grad(value(leaf), list(leaf.values()), allow_unused=True)
    for (name, x), grad in zip(leaf.items(), grads, strict=True):
        if name == "sigma" and kind == "trajectory":
            assert grad is None
            continue
        assert (grad.abs() > 1e-9).all(), name
        # ... and not by a gradient of its own making: the largest one is the slope of the density.
        k = int(grad.abs().argmax())
        step = 1e-5
        slope = []
        for sign in (1.0, -1.0):
            moved = x.detach().clone()
            if name == "covariance":  # symmetric: both halves move together
                i, j = divmod(k, 4)
                moved[i, j] += sign * step / 2
                moved[j, i] += sign * step / 2
            else:
                moved.reshape(-1)[k] += sign * step
            slope.append(value(leaf | {name: moved}).item())
        difference = (slope[0] - slope[1]) / (2 * step)
        assert difference == pytest.approx(grad.reshape(-1)[k].item(), rel=1e-5), name
