"""A simulated Wiener system, y = f(g) + e, and what is exactly true of it.

Brute force on a few samples (a grid over g at all times together), and a bootstrap particle filter
with backward simulation on longer records. The package gets the problem and has no other part.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch

from pyro_dynogp.moments.problem import TABLE, FilterProblem, make_layout
from tests.lti import oracles

FUNCTIONS = {
    "mild": lambda g: g + 0.3 * np.tanh(g),
    "saturation": lambda g: np.tanh(1.5 * g),
    "positive part": lambda g: np.maximum(g, 0.0),
}
# Points of the table: 12 spacings to a standard deviation of g, and no error from it to speak of.
LOW, HIGH, GRID = -8.0, 8.0, 1601


@dataclass(frozen=True)
class Wiener:
    """One pair with process noise of standard deviation `drift`, driven by steps to `drive`."""

    name: str
    n: int
    step: float = 0.25
    noise_sd: float = 0.15
    drift: float = 0.3
    drive: float = 1.0
    seed: int = 0

    @property
    def f(self):
        return FUNCTIONS[self.name]

    @cached_property
    def system(self):
        raw = oracles.System(
            np.array([-0.8 + 2.0j]), np.array([[1.0 + 0.3j]]), np.ones((1, 1)),
            np.array([[0.5 + 0.2j]]), np.zeros((1, 1)),
        )  # fmt: skip
        sd = np.sqrt((raw.C @ raw.stationary @ raw.C.T).item())
        return oracles.System(raw.poles, raw.B_modal, raw.c, raw.L_modal * self.drift / sd, raw.D)

    @cached_property
    def time(self):
        return self.step * np.arange(self.n)

    @cached_property
    def known(self):
        """What the inputs cause, of standard deviation near `drive`."""
        rng = np.random.default_rng([self.seed, 1])
        u = np.repeat(rng.standard_normal((self.n // 4 + 2, 1)), 4, axis=0)
        lead = 40  # samples before the record, so that it does not begin at rest
        u = np.concatenate([np.repeat(rng.standard_normal((lead // 4, 1)), 4, axis=0), u])
        time = self.step * np.arange(lead + self.n)
        m = oracles.mean(self.system, time, u[: lead + self.n])[0][lead:, 0]
        return 1.3 * self.drive * m

    @cached_property
    def covariance(self):
        """Of g at all times."""
        return oracles.covariance(self.system, self.time, self.time)

    @cached_property
    def y(self):
        rng = np.random.default_rng([self.seed, 2])
        root = np.linalg.cholesky(self.covariance + 1e-12 * np.eye(self.n))
        g = self.known + root @ rng.standard_normal(self.n)
        return self.f(g) + self.noise_sd * rng.standard_normal(self.n)

    @cached_property
    def transition(self):
        return oracles.expm(self.system.A * self.step), oracles.sampled_noise(
            self.system, self.step
        )

    def problem(self, measured=False):
        """With the update of joint moments, or that of an output measured through f."""
        F, Q = self.transition
        grid = np.linspace(LOW, HIGH, GRID)
        zero = np.zeros
        values = {
            "re": F[:1, :1],
            "im": F[1:, :1],
            "Q": Q[None],
            "gamma": zero((1, 2, 1)),
            "m0": zero(2),
            "P0": self.system.stationary,
            "G": np.hstack([self.system.C, zero((1, 1))]),
            "offset": self.known[:, None],
            "table_mean": self.f(grid)[None],
            "table_variance": zero((1, GRID)),
            "low": np.array([LOW]),
            "spacing": np.array([(HIGH - LOW) / (GRID - 1)]),
            "weight": zero((1, 1)),
            "Z": zero((1, 1, 1)),
            "inverse": zero((1, 1)),
            "constant": zero(1),
            "slope": zero((1, 1)),
            "H": np.array([[0.0, 0.0, 1.0]]),
            "y_offset": zero((self.n, 1)),
            "y": self.y[:, None],
            "R": np.full((self.n, 1), self.noise_sd**2),
        }
        step = np.concatenate([[-1], np.zeros(self.n - 1, dtype=int)])
        layout = make_layout(step, [1], [1], [TABLE], np.ones(1), np.ones(1), measured=measured)
        tensors = {k: torch.tensor(np.array(v), dtype=torch.float64) for k, v in values.items()}
        return FilterProblem(layout, **tensors)


def brute_force(known, covariance, f, y, variance, *, nodes=41, reach=5.0):
    """Log-likelihood, and mean and sd of g at each of a few samples given them all.

    The trapezoidal rule over the whitened g; its error is far below the tolerances of the tests.
    """
    n = len(y)
    z = np.linspace(-reach, reach, nodes)
    axes = np.meshgrid(*[z] * n, indexing="ij")
    Z = np.stack([a.reshape(-1) for a in axes])
    g = known[:, None] + np.linalg.cholesky(covariance) @ Z
    log_w = -0.5 * (Z**2).sum(0) + n * np.log((z[1] - z[0]) / np.sqrt(2 * np.pi))
    r = y[:, None] - f(g)
    log_w -= 0.5 * (r**2 / variance + np.log(2 * np.pi * variance)).sum(0)
    top = log_w.max()
    w = np.exp(log_w - top)
    mean = g @ w / w.sum()
    return top + np.log(w.sum()), mean, np.sqrt((g - mean[:, None]) ** 2 @ w / w.sum())


def resample(rng, weight):
    """Systematic resampling: indices of the survivors."""
    edges = np.cumsum(weight)
    return np.searchsorted(
        edges, (np.arange(len(weight)) + rng.uniform()) / len(weight) * edges[-1]
    )


def particle_filter(rng, count, x0, log_likelihood, advance, n):
    """Log-likelihood estimate, and the particles (count, J) and weights of each sample."""
    x, total, kept = x0, 0.0, []
    for k in range(n):
        if k:
            x = advance(x[resample(rng, kept[-1][1])], k)
        log_w = log_likelihood(x, k)
        top = log_w.max()
        w = np.exp(log_w - top)
        total += top + np.log(w.mean())
        kept.append((x, w / w.sum()))
    return total, kept


def backward_draws(rng, kept, F, Q, draws):
    """Trajectories (n, draws, J) from the smoothing distribution (Godsill, Doucet & West 2004)."""
    inverse = np.linalg.inv(Q)
    x, w = kept[-1]
    path = [x[rng.choice(len(x), draws, p=w)]]
    for x, w in kept[-2::-1]:
        mean = x @ F.T
        left = path[-1] @ inverse  # terms without the particle drop out
        log_w = left @ mean.T - 0.5 * ((mean @ inverse) * mean).sum(-1) + np.log(w + 1e-300)
        log_w -= log_w.max(-1, keepdims=True)
        edges = np.cumsum(np.exp(log_w), -1)
        at = rng.uniform(size=(draws, 1)) * edges[:, -1:]
        path.append(x[(edges < at).sum(-1)])
    return np.array(path[::-1])
