"""Small systems and fits that several test files share."""

from __future__ import annotations

import os

import numpy as np
import pytest
import torch
from hypothesis import settings
from threadpoolctl import threadpool_limits

import pyro_dynogp as dgp

# As many processes run tests as there are processors: more threads or processes would wait for each
# other, here and in the kernels of notebooks. Where a test is about processes it asks for them.
torch.set_num_threads(1)
threadpool_limits(1)
os.environ["OMP_NUM_THREADS"] = "1"
os.environ["LOKY_MAX_CPU_COUNT"] = "1"
settings.register_profile("deterministic", derandomize=True, deadline=None)
settings.load_profile("deterministic")


def pytest_collection_modifyitems(items):
    """Notebooks first: they take longest, and at the end one process would wait for another."""
    items.sort(key=lambda item: "test_notebooks" not in item.nodeid)


def simulate_record(modes, noise_sd, n=240, step=0.1, seed=0, **names):
    """Random steps as input through a known system."""
    rng = np.random.default_rng(seed)
    inputs = np.repeat(rng.standard_normal((n // 6 + 1, modes.inputs)), 6, axis=0)[:n]
    time = np.arange(n) * step
    with torch.random.fork_rng():
        torch.manual_seed(seed)
        outputs = dgp.LTIProcess(modes, time, inputs).observed(noise_sd).sample().numpy()
    return dgp.Record(time=time, inputs=inputs, outputs=outputs, **names)


@pytest.fixture(scope="session")
def one_pair():
    return dgp.Modes([-0.5 + 2.0j], [[1.0 + 0.3j]], [1.0], [[0.2 + 0.1j]])


@pytest.fixture(scope="session")
def record(one_pair):
    return simulate_record(one_pair, 0.1)


@pytest.fixture(scope="session")
def map_fit(record):
    model = dgp.LinearDynamicGP(inputs=1, pairs=1)
    return dgp.fit(model, record[:160], restarts=2, workers=1, progress=False, method="map")


@pytest.fixture(scope="session")
def svi_fit(record):
    model = dgp.LinearDynamicGP(inputs=1, pairs=1)
    return dgp.fit(
        model, record[:160], method="svi", restarts=2, steps=60, draws=40, workers=1, progress=False
    )


@pytest.fixture(scope="session")
def two_outputs():
    """A record of a system with two inputs and two outputs that share their states."""
    modes = dgp.Modes(
        [-0.5 + 2.0j, -1.5 + 0.8j],
        [[1.0 + 0.3j, 0.2j], [0.5, 1.0 - 0.5j]],
        [[1.0, 0.4], [0.3 + 0.5j, 1.0]],
        [[0.2, 0.1j], [0.1, 0.3]],
    )
    return simulate_record(
        modes, torch.tensor([0.1, 0.05]), seed=3, output_names=("force", "speed")
    )


@pytest.fixture(scope="session")
def two_output_fit(two_outputs):
    model = dgp.LinearDynamicGP(inputs=2, outputs=2, pairs=2)
    return dgp.fit(
        model, two_outputs[:160], restarts=2, steps=120, workers=1, progress=False, method="map"
    )
