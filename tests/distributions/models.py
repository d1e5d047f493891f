"""Small Pyro models of a trajectory, in the shapes that vectorised inference needs."""

import numpy as np
import pyro
import pyro.distributions as dist
import torch

from pyro_dynogp.distributions.process import LTIProcess
from pyro_dynogp.lti.modes import Modes

N = 12
TIME = np.cumsum(np.random.default_rng(0).uniform(0.1, 0.5, N))


def inputs(records=None):
    shape = (N, 1) if records is None else (records, N, 1)
    return torch.as_tensor(np.random.default_rng(1).standard_normal(shape))


def data(records=None):
    shape = (N,) if records is None else (records, N)
    return torch.as_tensor(np.random.default_rng(2).standard_normal(shape))


def sample_system():
    """Sites decay and gain (*b, 2), noise (*b); modes of batch *b."""
    one = torch.ones(2, dtype=torch.float64)
    decay = pyro.sample("decay", dist.LogNormal(0.0 * one, 0.3 * one).to_event(1))
    gain = pyro.sample("gain", dist.Normal(0.0 * one, one).to_event(1))
    noise = pyro.sample("noise", dist.LogNormal(0.0 * one[0], 0.3 * one[0]))
    poles = torch.complex(-decay, decay * torch.tensor([1.0, 3.0], dtype=torch.float64))
    B = torch.complex(gain, 0.5 * gain).unsqueeze(-1)
    L = noise[..., None, None] * torch.tensor([[1.0 + 0.2j], [0.5j]], dtype=torch.complex128)
    c = torch.tensor([1.0, 0.5j], dtype=torch.complex128)
    return Modes(poles, B, c, L)


def sample_sigma():
    half = torch.tensor(0.5, dtype=torch.float64)
    return pyro.sample("sigma", dist.LogNormal(half.log(), half))


def latent(u, y=None):
    """The trajectory is a site, its samples carry noise."""
    modes = sample_system()
    sigma = sample_sigma()
    g = pyro.sample("g", LTIProcess(modes, TIME, u, jitter=1e-6))
    pyro.sample("y", dist.Normal(g, sigma.unsqueeze(-1)).to_event(1), obs=y)
    return g


def observed(u, y=None):
    """The trajectory is integrated out."""
    modes = sample_system()
    return pyro.sample("y", LTIProcess(modes, TIME, u).observed(sample_sigma()), obs=y)


def latent_records(u, y=None):
    """One system, several records."""
    modes = sample_system()
    sigma = sample_sigma()
    with pyro.plate("records", len(u), dim=-1):
        g = pyro.sample("g", LTIProcess(modes, TIME, u, jitter=1e-6))
        return pyro.sample("y", dist.Normal(g, sigma.unsqueeze(-1)).to_event(1), obs=y)


def observed_records(u, y=None):
    modes = sample_system()
    sigma = sample_sigma()
    with pyro.plate("records", len(u), dim=-1):
        return pyro.sample("y", LTIProcess(modes, TIME, u).observed(sigma), obs=y)
