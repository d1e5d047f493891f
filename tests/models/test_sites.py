"""Every number of every sample site changes the likelihood: none is there for its prior alone."""

import numpy as np
import pyro.distributions as dist
import pytest
import torch

import pyro_dynogp as dgp
from pyro_dynogp.inference.density import Potential
from pyro_dynogp.inference.run import Run
from pyro_dynogp.inference.starts.linear import linear_starts
from pyro_dynogp.inference.starts.plans import starting_points

Dynamic, Static, Known = dgp.Dynamic, dgp.Static, dgp.Known


def bend(x, a, b):
    return torch.tanh(a * x) + b * x


def known(**options):
    numbers = {"a": dist.LogNormal(0.0, 0.5), "b": dist.Normal(0.5, 0.5)}
    return Known(bend, numbers, **options)


MODELS = {
    "integrator": dgp.LinearDynamicGP(1, pairs=1, integrators=1),
    "integrators of two outputs": dgp.LinearDynamicGP(1, outputs=2, pairs=1, integrators=1),
    "integrator without process noise": dgp.LinearDynamicGP(
        1, pairs=1, integrators=1, process_noise=False
    ),
    "integrator behind a sensor": dgp.Cascade(
        1, (Dynamic(pairs=1, integrators=1), Static(inducing=5))
    ),
    "integrator in feedback": dgp.Cascade(
        1, (Dynamic(pairs=1, integrators=1, feedback=("f",)), Static(inducing=5)),
        output="g", integrate="all",
    ),
    "known sensor": dgp.Cascade(1, (Dynamic(pairs=1), known())),
    "known actuator": dgp.Cascade(1, (known(), Dynamic(pairs=1))),
    "known function in feedback": dgp.Cascade(
        1, (Dynamic(pairs=1, feedback=("f",)), known()), output="g", integrate="all"
    ),
    "branches": dgp.ParallelWienerHammerstein(1, pairs=1, inducing=5),
}  # fmt: skip


@pytest.mark.parametrize("name", MODELS)
def test_every_number_changes_the_likelihood(name):
    model = MODELS[name]
    rng = np.random.default_rng(0)
    n = 150
    y = np.cumsum(rng.standard_normal((n, model.outputs)), 0)
    record = dgp.Record(time=0.1 * np.arange(n), inputs=rng.standard_normal(n), outputs=y)
    model = model.scaled_to(record).collapsed
    ready = model.prepare(record)
    if model.is_linear:
        (start,) = linear_starts(model, ready, 1, 0)
    else:
        (start,) = starting_points(model, ready, Run(0, 1, False), count=1, steps=3)
    potential = Potential(model, (ready,), start)
    density = potential.log_density
    z = potential.pack(start)
    z = z + 0.1 * torch.tensor(rng.standard_normal(len(z)))  # a start may be at zero gain

    def likelihood(at):
        with torch.no_grad():
            values = potential.unpack(at)
            return float(density(values, None) - density.prior.log_prob(values))

    before = likelihood(z)
    labels = [site.name for site in potential.sites for _ in range(site.unconstrained.numel())]
    step = 0.3 * torch.eye(len(z), dtype=z.dtype)
    same = [label for label, move in zip(labels, step, strict=True)
            if abs(likelihood(z + move) - before) < 1e-9 * abs(before)]  # fmt: skip
    assert same == []
