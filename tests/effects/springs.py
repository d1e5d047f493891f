"""Masses on springs, simulated by small steps, and the record of one."""

import numpy as np

import pyro_dynogp as dgp

STEP, DAMPING, STIFFNESS = 0.05, 0.6, 4.0
POLE = complex(-0.5 * DAMPING, np.sqrt(STIFFNESS - 0.25 * DAMPING**2))


def sprung(u, cubic):
    """Displacement (n,) under x'' + 0.6 x' + 4 x + cubic x^3 = u, held, by small steps."""
    x = v = 0.0
    out = np.empty(len(u))
    for k, force in enumerate(u):
        out[k] = x
        for _ in range(20):
            v += STEP / 20 * (force - DAMPING * v - STIFFNESS * x - cubic * x**3)
            x += STEP / 20 * v
    return out


def pushed(seed, n, size=5.0):
    """Forces (n,), each held for four samples."""
    return np.repeat(size * np.random.default_rng(seed).standard_normal(n // 4), 4)


# A force pushes a mass, and a spring between this and another one that: positions and velocities.
COUPLED = np.array([
    [0.0, 1.0, 0.0, 0.0], [-7.5, -0.4, 6.0, 0.0], [0.0, 0.0, 0.0, 1.0], [7.5, 0.0, -10.0, -0.6],
])  # fmt: skip


def coupled(u, cubic):
    """Position (n,) of the second mass, with cubic d^3 of the spring's length d, by small steps."""
    x = np.zeros(4)
    out = np.empty(len(u))
    for k, force in enumerate(u):
        out[k] = x[2]
        for _ in range(20):
            more = cubic * (x[0] - x[2]) ** 3
            x = x + STEP / 20 * (COUPLED @ x + np.array([0.0, force - more, 0.0, more / 0.8]))
    return out


def spring_record():
    """Force and position of the spring that hardens, 600 samples with noise of 2 %."""
    u = pushed(0, 600)
    y = sprung(u, 4.0)
    noise = 0.02 * y.std() * np.random.default_rng(1).standard_normal(len(u))
    return dgp.Record(time=STEP * np.arange(len(u)), inputs=u, outputs=y + noise,
                      input_names=("force",), output_names=("x",), input_units=("N",),
                      output_units=("mm",), time_unit="s")  # fmt: skip
