"""Nonlinear loops as data, and a bootstrap particle filter for them in plain numpy."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch

import pyro_dynogp as dgp
from pyro_dynogp.models.outputs import output_process
from pyro_dynogp.models.priors import TimeScale
from tests.models.closed_loops import ClosedLoop, plain_loop, system_at


@dataclass(frozen=True)
class Plant:
    """x' = A x + B u + F f(y), poles -decay +- i frequency [1/s], steady gains of u and of f."""

    function: Callable[[np.ndarray], np.ndarray]
    of_torch: Callable[[torch.Tensor], torch.Tensor]
    decay: float
    frequency: float
    gain: float
    back: float


def _softened(x):
    return x / (1.0 + x**2) ** 0.5


SPRING = (0.3, 2.0, 1.5)
PLANTS = {
    "hardening spring": Plant(lambda y: y**3, lambda y: y**3, 0.3, 2.0, 0.7, -1.0),
    "softening spring": Plant(_softened, _softened, *SPRING, -2.0),
    "one-sided spring": Plant(
        lambda y: np.maximum(y, 0.0), lambda y: y.clamp_min(0.0), *SPRING, -4.0
    ),
    "friction": Plant(lambda y: np.tanh(y / 0.1), lambda y: (y / 0.1).tanh(), 0.5, 0.05, 2.0, -0.5),
    "outflow": Plant(
        lambda y: np.sqrt(np.maximum(y + 1.2, 0.0)),
        lambda y: (y + 1.2).clamp_min(0.0).sqrt(),
        *(0.2, 0.02, 3.0, -2.0),
    ),
}
STEP = 0.1


def make_loop(plant: Plant, noise: float, n: int, seed: int):
    """A model, its values, the loop in numpy, its function, and outputs (n, 1) that it makes.

    Args:
        noise: sd of what process noise alone makes of the linear part, and of measurement noise,
            over the sd of the output without either.
    """
    rng = np.random.default_rng(seed)
    u = np.repeat(rng.standard_normal(n // 10 + 1), 10)[:n]
    u = (u - u.mean()) / u.std()
    y = rng.standard_normal(n)
    record = dgp.Record(time=STEP * np.arange(n), inputs=u, outputs=(y - y.mean()) / y.std())
    layers = (dgp.Dynamic(pairs=1, feedback=("f",), feedthrough=False), dgp.Known(plant.of_torch))
    model = dgp.Cascade(1, layers, output="g").scaled_to(record)
    function = model.system(_values(model, plant, 1.0, 1.0), model.scaling).layer("f").function
    centre, size = float(function.centre), float(function.size)

    def back(g):
        return (plant.function(g) - centre) / size

    def loop_at(process, measurement):
        values = _values(model, plant, process, measurement)
        return values, plain_loop(model, system_at(model, values), record)

    _, quiet = loop_at(1e-9, 1e-9)
    sd = float(quiet.simulate(back, rng)[0, n // 10 :].std())
    _, unit = loop_at(1.0, 1.0)
    alone = float((unit.H @ unit.P0 @ unit.H.conj().T).real[0, 0]) ** 0.5
    values, loop = loop_at(noise * sd / alone, noise * sd)
    return model, values, loop, back, loop.simulate(back, rng)[0], record


def _values(model, plant, process, measurement):
    typical = TimeScale.of(model.scaling).typical_rate

    def tensor(x):
        return torch.tensor(x, dtype=torch.float64)

    return {
        "g_log_decay": tensor([np.log(plant.decay / typical)]),
        "g_log_frequency": tensor([np.log(plant.frequency / typical)]),
        "g_input_gain": tensor([[[0.0, plant.gain], [0.0, plant.back]]]),
        "g_noise_gain_local_scale": tensor([process]),
        "g_noise_gain_unit": tensor([[[0.0, 1.0]]]),
        "offset": tensor([0.0]),
        "noise_sd": tensor([measurement]),
        "g_initial_state": tensor([0.0, 0.0]),
    }


def filtered(model, values, record, y) -> float:
    """Log density of outputs (n, 1) by the moment filter."""
    known = dgp.Record(time=record.time, inputs=record.inputs, outputs=y)
    (prepared,) = model.prepare(known)
    process = output_process(system_at(model, values), prepared)
    return float(process.log_prob(prepared.observations))


def particle_filter(loop: ClosedLoop, function, y: np.ndarray, count: int, rng) -> float:
    """Log density of outputs (n, 1) by the bootstrap filter of Gordon, Salmond and Smith (1993).

    Systematic resampling at every sample. Unbiased for the density, not for its logarithm.
    """
    half = len(loop.m0) // 2
    eye = np.eye(half)
    real = 0.5 * np.block([[eye, eye], [-1j * eye, 1j * eye]])

    def noise(Q):
        Q = (real @ Q @ real.conj().T).real
        w = rng.standard_normal((count, 2 * half)) @ np.linalg.cholesky(Q).T
        w = w[:, :half] + 1j * w[:, half:]
        return np.concatenate([w, w.conj()], 1)

    x, total, variance = loop.m0 + noise(loop.P0), 0.0, float(loop.noise[0])
    for k in range(len(y)):
        g = (x @ loop.H[0]).real
        error = y[k, 0] - g - loop.level[k, 0]
        log = -0.5 * (error**2 / variance + np.log(2.0 * np.pi * variance))
        weight = np.exp(log - log.max())
        total += log.max() + np.log(weight.mean())
        if k == len(loop.F):
            break
        ends = np.cumsum(weight)
        chosen = np.searchsorted(ends, (rng.random() + np.arange(count)) * ends[-1] / count)
        chosen = chosen.clip(0, count - 1)
        x, g = x[chosen], g[chosen]
        moved = function(g)[:, None] * loop.back[k][:, 0]
        x = x @ loop.F[k].T + loop.drive[k] + moved + noise(loop.Q[k])
    return float(total)
