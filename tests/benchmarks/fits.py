"""Linear fits of random systems: log posterior, seconds, forecasts, from two sets of defaults."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import numpy as np
import torch

import pyro_dynogp as dgp

# Samples, pairs and random systems; pairs that a system really has; samples that are forecast.
CELLS = [(n, pairs) for n in (500, 4000) for pairs in (2, 5, 10)]
SYSTEMS, TRUE_PAIRS, AHEAD = 10, 4, 100
CLIMBS: dict[str, dict[str, Any]] = {
    "default": {},
    "lbfgs": {"optimizer": "lbfgs"},
}


def plant(seed: int, n: int) -> tuple[dgp.Record, dgp.Record]:
    """A record of a random system with process noise, and what follows it."""
    rng = np.random.default_rng([seed, 5])
    rate = np.exp(rng.uniform(np.log(0.03), np.log(1.5), TRUE_PAIRS))
    damping = rng.uniform(0.05, 0.9, TRUE_PAIRS)
    poles = rate * (-damping + 1j * np.sqrt(1.0 - damping**2))
    shape = (TRUE_PAIRS, 1)
    B, L = (rng.standard_normal(shape) + 1j * rng.standard_normal(shape) for _ in range(2))
    modes = dgp.Modes(
        poles, 0.3 * rate[:, None] * B, np.ones(TRUE_PAIRS), 0.05 * np.sqrt(rate)[:, None] * L
    )
    total = n + AHEAD
    inputs = np.repeat(rng.standard_normal((total // 4 + 1, 1)), 4, axis=0)[:total]
    t = np.arange(float(total))
    with torch.random.fork_rng():
        torch.manual_seed(seed)
        outputs = dgp.LTIProcess(modes, t, inputs).observed(0.1).sample().numpy()
    record = dgp.Record(time=t, inputs=inputs, outputs=outputs)
    return record[:n], record[n:]


def fitted(seed: int, n: int, pairs: int, **options: Any) -> tuple[float, float, float]:
    """Energy [nats], processor seconds and forecast RMSE of one fit."""
    train, future = plant(seed, n)
    begin = time.process_time()
    model = dgp.LinearDynamicGP(1, pairs=pairs)
    fit = dgp.fit(model, train, workers=1, progress=False, seed=0, **options)
    seconds = time.process_time() - begin
    errors = fit.forecast(train, future, seed=0).mean - future.outputs
    return float(fit.start_energies[0]), seconds, float(np.sqrt(np.mean(errors**2)))


def run(folder: Path) -> str:
    """A row for each cell: medians over systems, and how often the default is as high."""
    torch.set_num_threads(1)
    fitted(0, 120, 1, restarts=1, steps=2)  # compiles
    lines = [
        "Posterior modes of linear models of random systems with four pairs; medians over "
        f"{SYSTEMS} systems. As high: log posterior at least that of L-BFGS less 0.1 nats.",
        "",
        "| samples | pairs | climb | energy [nats] | seconds | forecast RMSE | as high |",
        "|---|---|---|---|---|---|---|",
    ]
    for n, pairs in CELLS:
        found = {
            name: np.array([fitted(seed, n, pairs, **options) for seed in range(SYSTEMS)])
            for name, options in CLIMBS.items()
        }
        for name, rows in found.items():
            high = int((rows[:, 0] <= found["lbfgs"][:, 0] + 0.1).sum())
            energy, seconds, rmse = np.median(rows, axis=0)
            lines.append(
                f"| {n} | {pairs} | {name} | {energy:.2f} | {seconds:.2f} | {rmse:.4f} "
                f"| {high} of {SYSTEMS} |"
            )
            print(lines[-1], flush=True)
    return "\n".join(lines)
