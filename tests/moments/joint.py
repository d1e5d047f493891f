"""Linear cascades as one dense joint Gaussian over all signals at all times: the exact answer."""

from __future__ import annotations

import numpy as np
import torch

from pyro_dynogp.layers.functions import StaticFunction
from pyro_dynogp.layers.kernels import SampledKernel, _default_form
from pyro_dynogp.layers.noise import Gaussian, Noise
from pyro_dynogp.models.system import DynamicSystem, StaticSystem, System
from pyro_dynogp.models.wiring import Dynamic, wire
from tests.lti import oracles
from tests.lti.oracles import tensor


class Joint:
    """Mean and covariance of every signal, each flattened from (n, w)."""

    def __init__(self, time, inputs):
        self.time, self.n = time, len(time)
        self.mean, self.covariance = np.zeros(0), np.zeros((0, 0))
        self.width, self.start = {}, {}
        self._append("inputs", inputs.shape[1], inputs.reshape(-1), np.zeros((0, inputs.size)), 0.0)

    def _append(self, name, width, mean, cross, own):
        self.width[name], self.start[name] = width, len(self.mean)
        own = np.zeros((len(mean),) * 2) + own
        self.mean = np.concatenate([self.mean, mean])
        self.covariance = np.block([[self.covariance, cross], [cross.T, own]])

    def index(self, *names):
        """Where the signals stand, side by side (n, w)."""
        return np.concatenate(
            [
                self.start[name] + np.arange(self.n * self.width[name]).reshape(self.n, -1)
                for name in names
            ],
            1,
        )

    def add(self, name, sources, T, shift, S, width):
        """A signal T x + shift + N(0, S) of its sources x."""
        i = self.index(*sources).reshape(-1)
        cross = self.covariance[:, i] @ T.T
        self._append(name, width, T @ self.mean[i] + shift, cross, T @ cross[i] + S)

    def add_dynamic(self, name, sources, system, past, z0):
        n_y, n_u = system.D.shape
        T = np.zeros((self.n * n_y, self.n * n_u))
        for column, unit in enumerate(np.eye(self.n * n_u)):
            T[:, column] = oracles.mean(system, self.time, unit.reshape(self.n, n_u))[0].reshape(-1)
        shift = oracles.mean(system, self.time, np.zeros((self.n, n_u)), z0)[0].reshape(-1)
        initial = system.stationary + (past if z0 is None else 0.0)
        S = oracles.covariance(system, self.time, self.time, initial, self.time[0])
        self.add(name, sources, T, shift, S, n_y)

    def add_linear(self, name, sources, slope, constant):
        T = np.kron(np.eye(self.n), slope)
        self.add(name, sources, T, np.tile(constant, self.n), 0.0, len(slope))

    def given(self, name, noise_sd, y, seen):
        """Mean and covariance of everything given y, the signal `name` plus noise where `seen`."""
        i = self.index(name)[seen]
        S = self.covariance[np.ix_(i, i)] + np.diag((np.zeros_like(y) + noise_sd)[seen] ** 2)
        gain = np.linalg.solve(S, self.covariance[i]).T
        mean = self.mean + gain @ (y[seen] - self.mean[i])
        return mean, self.covariance - gain @ self.covariance[i]

    def log_density(self, name, noise_sd, y):
        seen = ~np.isnan(y)
        i = self.index(name)[seen]
        S = self.covariance[np.ix_(i, i)] + np.diag((np.zeros_like(y) + noise_sd)[seen] ** 2)
        return oracles.log_density(y[seen] - self.mean[i], S)


def linear_function(slope, constant, reach=80.0):
    """A static layer that is a straight line or plane: no deviation from its mean, no variance."""
    e, d = slope.shape
    one = torch.ones(d, dtype=torch.float64)
    locations = torch.linspace(-reach, reach, 3, dtype=torch.float64)[:, None] * one
    nothing = torch.zeros(e, 3, dtype=torch.float64)
    kernel = SampledKernel(_default_form(d), {"raw_lengthscale": one.unsqueeze(0)}, d)
    return StaticFunction(
        kernel, locations, nothing, nothing[:, 0], tensor(constant), tensor(slope), "line"
    )


def linear_cascade(inputs, layers, time, u, *, seed=0, noise="shared", known_start=()):
    """A cascade at random whose static layers are linear, and its joint Gaussian.

    Layers named in `known_start` begin in a known state, all others in an uncertain one; those
    without process noise have none.
    """
    rng = np.random.default_rng([seed, 3])
    joint = Joint(time, u)
    wires = wire(inputs, layers)
    systems = []
    for place, one in enumerate(wires):
        sources, width = one.sources, one.layer.outputs
        if isinstance(one.layer, Dynamic):
            system = oracles.random_system(
                seed + place,
                pairs=one.layer.pairs,
                inputs=one.channels,
                outputs=width if width > 1 else None,
                noise=noise,
                brownian=2 if one.layer.process_noise else 0,
            )
            past = oracles.random_covariance(2 * one.layer.pairs, seed + place)
            z0 = rng.standard_normal(2 * one.layer.pairs) if one.name in known_start else None
            P = one.layer.pairs
            state = None if z0 is None else tensor(z0[:P] + 1j * z0[P:])
            systems.append(DynamicSystem(system.modes, tensor(past), state))
            joint.add_dynamic(one.name, sources, system, past, z0)
        else:
            slope = rng.standard_normal((width, one.channels)) / np.sqrt(one.channels)
            constant = 0.3 * rng.standard_normal(width)
            systems.append(StaticSystem(linear_function(slope, constant)))
            joint.add_linear(one.name, sources, slope, constant)
    n_y = layers[-1].outputs
    sd = rng.uniform(0.2, 0.6, n_y)
    offset = 0.5 * rng.standard_normal(n_y) if isinstance(layers[-1], Dynamic) else None
    system = System(
        wires,
        tuple(systems),
        Noise(Gaussian(), tensor(sd), None),
        None if offset is None else tensor(offset),
    )
    return system, joint, sd, np.zeros(n_y) if offset is None else offset
