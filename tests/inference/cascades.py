"""Small records for fits of cascades, and options with which a fit takes seconds."""

from __future__ import annotations

import numpy as np

import pyro_dynogp as dgp
from tests.conftest import simulate_record

# Far from converged: these tests are about what a fit does, not about how good it gets.
FAST = {"restarts": 1, "steps": 4, "particles": 1, "draws": 10, "workers": 1, "progress": False}


def wiener_record(n=100, seed=0, noise_sd=0.05, **names):
    """y = tanh(2 g) + e: a resonant pair with some process noise, bent by a sensor."""
    modes = dgp.Modes([-0.5 + 2.0j], [[0.5 + 0.15j]], [1.0], [[0.03]])
    hidden = simulate_record(modes, 1e-3, n=n, seed=seed, **names)
    noise = np.random.default_rng([seed, 1]).standard_normal((n, 1))
    return hidden.with_outputs(np.tanh(2.0 * hidden.outputs) + noise_sd * noise)


def wiener(**options):
    return dgp.Wiener(1, pairs=1, inducing=6, **options)


def same(a, b):
    """Whether two fits are equal to the last bit."""
    return (
        np.array_equal(a.history, b.history)
        and set(a.draws) == set(b.draws)
        and all(np.array_equal(a.draws[k].numpy(), b.draws[k].numpy()) for k in a.draws)
        and np.array_equal(a.start_energies, b.start_energies)
    )
