"""Models for guides: sites of every kind of support, and trajectories with exact posteriors."""

import numpy as np
import pyro
import pyro.distributions as dist
import torch

from pyro_dynogp.distributions.process import LTIProcess
from tests.distributions.cases import make

DATA = torch.tensor([0.8, 1.4, 0.3], dtype=torch.float64)
NOISE = 0.4


def real(value):
    return torch.tensor(value, dtype=torch.float64)


def users_model(y=None):
    """Scalars and vectors, real, positive and in intervals, one of which another site sets."""
    level = pyro.sample("level", dist.Normal(real(0.0), real(1.0)))
    width = pyro.sample("width", dist.LogNormal(real(0.0), real(0.5)))
    share = pyro.sample("share", dist.Uniform(real([-1.0, 0.0]), real([1.0, 3.0])).to_event(1))
    top = pyro.sample("top", dist.Uniform(0.0 * width, width))
    matrix = pyro.sample("matrix", dist.Normal(torch.zeros(2, 3).double(), 1.0).to_event(2))
    scale = pyro.sample("scale", dist.HalfCauchy(torch.ones(2).double()).to_event(1))
    mean = level + top + share.sum(-1) + (matrix * scale.unsqueeze(-1)).sum((-2, -1))
    pyro.deterministic("mean", mean)
    pyro.factor("penalty", -0.1 * mean.square())
    mean = mean.unsqueeze(-1).expand((*mean.shape, 3))
    return pyro.sample("y", dist.Normal(mean, width.unsqueeze(-1)).to_event(1), obs=y)


LATENT = ["level", "width", "share", "top", "matrix", "scale"]


class Trajectory:
    """A trajectory with known parameters under Gaussian noise: everything about it is exact."""

    def __init__(self, *, n=12, outputs=None, start="stationary", jitter=1e-9, missing=False):
        self.case = make(n=n, outputs=outputs, start=start, jitter=jitter)
        y = self.case.draw()
        if missing:
            y[[2, 3]] = np.nan
        self.y = self.case.event(y)

    def prior(self):
        """A new one: it keeps its factors with their gradient graph."""
        p = self.case.process
        return LTIProcess(p.modes, p.grid, p.inputs, p.initial_state, jitter=p.jitter)

    def __call__(self):
        h = pyro.sample("h", self.prior())
        missing = torch.isnan(self.y)
        noise = dist.Normal(h, NOISE).mask(~missing).to_event(self.prior().event_dim)
        pyro.sample("y", noise, obs=self.y.masked_fill(missing, 0.0))

    def exact(self):
        return self.prior().condition(self.y, NOISE)
