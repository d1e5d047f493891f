"""Static functions by dense algebra, and what draws them, for the tests of this folder."""

import math

import numpy as np
import pyro
import torch

from pyro_dynogp.layers.functions import JITTER
from pyro_dynogp.layers.static import sample_static


def close(actual, expected, atol=1e-9, rtol=1e-9):
    expected = torch.as_tensor(np.asarray(expected), dtype=torch.float64)
    torch.testing.assert_close(actual.detach(), expected, atol=atol, rtol=rtol)


def normal(*shape, seed=0):
    return torch.as_tensor(np.random.default_rng(seed).standard_normal(shape))


def draw(model, *args, seed=0, particles=None, **kwargs):
    """Trace of a model under a plate of particles."""
    with torch.random.fork_rng():
        torch.manual_seed(seed)

        def whole():
            if particles is None:
                return model(*args, **kwargs)
            with pyro.plate("particles", particles):
                return model(*args, **kwargs)

        return pyro.poutine.trace(whole).get_trace()


def function(seed=0, particles=None, **kwargs):
    options = {"channels": 1, "outputs": 1, "inducing": 6} | kwargs
    trace = draw(sample_static, "f", seed=seed, particles=particles, **options)
    return trace.nodes["_RETURN"]["value"]


def values(trace):
    """Values of the sites of a trace, without its plates."""
    return {
        name: node["value"]
        for name, node in trace.nodes.items()
        if node["type"] == "sample" and name != "particles"
    }


def matern32(x, z, lengthscale):
    r = np.sqrt((((x[:, None] - z[None]) / lengthscale) ** 2).sum(-1))
    return (1.0 + math.sqrt(3.0) * r) * np.exp(-math.sqrt(3.0) * r)


class Dense:
    """The conditional of a function with the default kernel, by inverses."""

    def __init__(self, f):
        self.f = f
        self.Z, self.v = f.locations.numpy(), f.whitened.numpy()
        self.scale, self.lengthscale = f.output_scale.numpy(), f.kernel.radial[1].numpy()
        self.K = self.k(self.Z, self.Z) + JITTER * np.eye(len(self.Z))
        self.inverse = np.linalg.inv(self.K)

    def k(self, x, z):
        return matern32(x, z, self.lengthscale)

    def prior_mean(self, x):
        slope = np.zeros((self.f.outputs, self.f.channels))
        slope = slope if self.f.slope is None else self.f.slope.numpy()
        return self.f.constant.numpy() + x @ slope.T

    @property
    def inducing_values(self):
        return self.prior_mean(self.Z).T + self.scale[:, None] * (
            self.v @ np.linalg.cholesky(self.K).T
        )

    def mean(self, x):
        residual = self.inducing_values - self.prior_mean(self.Z).T
        return self.prior_mean(x) + self.k(x, self.Z) @ self.inverse @ residual.T

    def covariance(self, x, z):
        """R(x, z), of a function of unit scale."""
        return self.k(x, z) - self.k(x, self.Z) @ self.inverse @ self.k(self.Z, z)
