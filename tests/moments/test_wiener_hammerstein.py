"""A Wiener-Hammerstein cascade, from modes and a static GP to its likelihood, by particles."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.stats import norm

from pyro_dynogp.layers.functions import StaticFunction
from pyro_dynogp.layers.kernels import SampledKernel, _default_form
from pyro_dynogp.layers.noise import Gaussian, Noise
from pyro_dynogp.models.moment_outputs import MomentOutputs
from pyro_dynogp.models.system import DynamicSystem, StaticSystem, System
from pyro_dynogp.models.wiring import Dynamic, Static, wire
from tests.lti import oracles as lti
from tests.lti.oracles import tensor
from tests.models.outputs import outputs_along
from tests.moments.wiener import Wiener, particle_filter


def interpolating(f, count=41, reach=5.0):
    """A static function whose mean goes through f at its inducing locations."""
    one = torch.ones(1, dtype=torch.float64)
    kernel = SampledKernel(_default_form(1), {"raw_lengthscale": 1.5 * one.unsqueeze(0)}, 1)
    locations = torch.linspace(-reach, reach, count, dtype=torch.float64).unsqueeze(-1)
    nothing = torch.zeros(1, count, dtype=torch.float64)
    blank = StaticFunction(kernel, locations, nothing, one, 0.0 * one)
    whitened = torch.linalg.solve_triangular(blank.root, f(locations), upper=False).mT
    return replace(blank, whitened=whitened)


@pytest.mark.parametrize("seed", range(3))
def test_wiener_hammerstein_by_particles(seed):
    """The whole way from modes and a static GP to the likelihood; measured error up to 0.9 nats.

    A second layer passes on the first one's uncertainty, correlated over time.
    """
    n, step, sd = 60, 0.25, 0.1
    first = Wiener("saturation", n, seed=seed, drift=0.4).system
    raw = lti.random_system(seed, pairs=1, inputs=1, brownian=1)
    raw = replace(raw, poles=np.array([-1.2 + 1.0j]), B_modal=np.array([[0.8 - 0.4j]]))
    size = np.sqrt((raw.C @ raw.stationary @ raw.C.T).item())
    second = replace(raw, L_modal=raw.L_modal * 0.05 / size, D=0.3 * np.ones((1, 1)))
    rng = np.random.default_rng([seed, 3])
    time, u = step * np.arange(n), np.repeat(rng.standard_normal((n // 4, 1)), 4, axis=0)
    function = interpolating(lambda g: torch.tanh(1.5 * g))
    grid = np.linspace(-7.0, 7.0, 4001)
    with torch.no_grad():
        table = function.mean(tensor(grid).unsqueeze(-1))[:, 0].numpy()
    known, _ = lti.mean(first, time, u)
    moves = []
    for system in (first, second):
        block = np.zeros((3, 3))
        block[:2] = np.hstack([system.A, system.B])
        E = lti.expm(block * step)
        moves.append((E[:2, :2], E[:2, 2], np.linalg.cholesky(lti.sampled_noise(system, step))))

    def output(x, k):
        f = np.interp(known[k, 0] + x[:, :2] @ first.C[0], grid, table)
        return f, x[:, 2:] @ second.C[0] + 0.3 * f + 0.4

    def advance(x, k):
        f, _ = output(x, k - 1)
        (F1, _, L1), (F2, gain, L2) = moves
        noise = rng.standard_normal(x.shape)
        low = x[:, :2] @ F1.T + noise[:, :2] @ L1.T
        high = x[:, 2:] @ F2.T + f[:, None] * gain + noise[:, 2:] @ L2.T
        return np.hstack([low, high])

    def begin(count):
        z = rng.standard_normal((count, 4))
        roots = [np.linalg.cholesky(s.stationary) for s in (first, second)]
        return np.hstack([z[:, :2] @ roots[0].T, z[:, 2:] @ roots[1].T])

    x, y = begin(1), []
    for k in range(n):
        x = advance(x, k) if k else x
        y.append(output(x, k)[1][0] + sd * rng.standard_normal())
    y = np.array(y)

    def log_likelihood(x, k):
        return norm.logpdf(y[k], output(x, k)[1], sd)

    totals = [
        particle_filter(rng, 10_000, begin(10_000), log_likelihood, advance, n)[0] for _ in range(3)
    ]
    zero = torch.zeros(1, dtype=torch.complex128)
    nothing = torch.zeros(2, 2, dtype=torch.float64)
    wires = wire(1, (Dynamic(pairs=1), Static(inducing=41), Dynamic(pairs=1)))
    layers = (
        DynamicSystem(first.modes, nothing, zero),
        StaticSystem(function),
        DynamicSystem(second.modes, nothing, zero),
    )
    noise = Noise(Gaussian(), torch.tensor([sd], dtype=torch.float64), None)
    system = System(wires, layers, noise, torch.tensor([0.4], dtype=torch.float64))
    observed = outputs_along(system, time, tensor(u), engine=MomentOutputs)
    value = float(observed.log_prob(tensor(y)))
    assert abs(value - np.mean(totals)) < 1.2 + 2.0 * np.std(totals)
    # Taking the first layer for certain costs many times as much (27 nats or more).
    certain = replace(layers[0], modes=first.modes.without_process_noise())
    system = replace(system, layers=(certain, *layers[1:]))
    observed = outputs_along(system, time, tensor(u), engine=MomentOutputs)
    assert float(observed.log_prob(tensor(y))) < value - 10.0
