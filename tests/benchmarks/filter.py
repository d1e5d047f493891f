"""Log densities of the moment filter against a particle filter, for functions in feedback."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from tests.benchmarks.markdown import table
from tests.moments.particles import PLANTS, filtered, make_loop, particle_filter

SAMPLES, PARTICLES, RUNS = 1000, 20_000, 3
NOISES = (0.3, 0.1, 0.03)


def run(folder: Path) -> str:
    """Nats per 1000 samples by which the moment filter is off."""
    del folder
    lines = []
    for name, plant in PLANTS.items():
        line = [name]
        for noise in NOISES:
            model, values, loop, function, y, record = make_loop(plant, noise, SAMPLES, 0)
            each = [
                particle_filter(loop, function, y, PARTICLES, np.random.default_rng(seed))
                for seed in range(RUNS)
            ]
            off = filtered(model, values, record, y) - np.mean(each)
            line.append(f"{off:+.2f} \u00b1 {np.std(each, ddof=1) / RUNS**0.5:.2f}")
        lines.append(line)
    head = ["function in feedback", *(f"{noise:.0%} noise" for noise in NOISES)]
    return (
        f"Nats per {SAMPLES} samples: moment filter less the mean of {RUNS} bootstrap filters of "
        f"{PARTICLES} particles, and its standard error. Noise: standard deviation of measurement "
        "noise, and of what process noise makes of the linear part, over that of the output.\n\n"
        + table(head, lines)
    )
