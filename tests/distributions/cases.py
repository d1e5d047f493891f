"""A trajectory of each kind, with its mean and covariance from the oracles."""

from dataclasses import dataclass

import numpy as np

from pyro_dynogp.distributions.process import LTIProcess
from pyro_dynogp.lti.state import ModalState
from tests.lti import oracles
from tests.lti.oracles import System, random_system, tensor


@dataclass
class Case:
    system: System
    time: np.ndarray
    inputs: np.ndarray
    mean: np.ndarray  # (N,)
    covariance: np.ndarray  # (N, N), noise-free
    process: LTIProcess

    @property
    def size(self):
        return len(self.mean)

    def event(self, x):
        """Rows (..., N) as trajectories (..., *event)."""
        return tensor(x).reshape(np.shape(x)[:-1] + self.process.event_shape)

    def draw(self, *shape, seed=0):
        """Numbers of the size of a trajectory, (*shape, N)."""
        rng = np.random.default_rng([seed, 19])
        return self.mean + 1.5 * rng.standard_normal((*shape, self.size))


START = ["stationary", "state", "gaussian"]


def make(*, outputs=None, noise="shared", start="stationary", n=10, offset=False, seed=0, **kw):
    system = random_system(seed, pairs=2, outputs=outputs, noise=noise)
    t, u = oracles.irregular_times(n, seed), oracles.random_inputs(n, 2, seed)
    z0, P0, state = np.zeros(4), None, None
    if start != "stationary":
        z0 = np.random.default_rng(seed).standard_normal(4)
        state = tensor(z0[:2] + 1j * z0[2:])
    if start == "gaussian":
        P0 = oracles.random_covariance(4, seed)
        state = ModalState(state, tensor(P0))
    m = oracles.mean(system, t, u, z0)[0]
    if offset:
        kw["offset"] = [0.7, -2.0][: outputs or 1] if outputs else 0.7
        m = m + np.array(kw["offset"])
    process = LTIProcess(system.modes, t, u, state, **kw)
    S = oracles.covariance(system, t, t, P0, t[0])
    return Case(system, t, u, m.reshape(-1), S, process)
