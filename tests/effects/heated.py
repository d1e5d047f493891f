"""A vessel whose flow carries heat, simulated."""

import numpy as np

import pyro_dynogp as dgp


def carried(seed, n=400, strength=0.8):
    """Heat, flow and temperature of x' = 1 + w - x + u (strength x + 0.2); noise of 2 %."""
    rng = np.random.default_rng(seed)
    w = np.repeat(rng.standard_normal(n // 5), 5)
    u = np.repeat(np.clip(0.5 * rng.standard_normal(n // 8), -0.9, 0.9), 8)
    x, y = 1.0, np.empty(n)
    for k in range(n):
        y[k] = x
        for _ in range(10):
            x += 0.01 * (1.0 + w[k] - x + u[k] * (strength * x + 0.2))
    y += 0.02 * y.std() * rng.standard_normal(n)
    return dgp.Record(0.1 * np.arange(n), np.column_stack([w, u]), y[:, None],
                      input_names=("heat", "flow"), time_unit="s")  # fmt: skip
