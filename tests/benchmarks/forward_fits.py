"""Fits of forward cascades to simulated plants: errors, bands and seconds, as functions bend.

Hammerstein, Wiener and Wiener-Hammerstein plants with one of six functions between or beside one
first-order lag or resonance, driven by filtered noise; measurement noise of 2, 5 and 10 % in turn.
500 samples to fit, 500 to forecast from them. Environment variables: FORWARD_PLANTS (12),
FORWARD_METHODS (svi,default), FORWARD_SAMPLES (500).
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from scipy.signal import lfilter

import pyro_dynogp as dgp

FUNCTIONS: tuple[Callable[[np.ndarray], np.ndarray], ...] = (
    np.tanh,
    lambda x: np.maximum(x, 0.0),
    lambda x: np.clip(x, -0.8, 1.2),
    lambda x: x + 0.3 * x**2,
    lambda x: np.sign(x) * np.maximum(np.abs(x) - 0.5, 0.0),
    lambda x: x / (1.0 + np.abs(x)),
)
NOISE = (0.02, 0.05, 0.1)
FIRST, STEP, AHEAD = 1000, 0.1, 500
MODELS: dict[str, Callable[[], dgp.Model]] = {
    "Hammerstein": lambda: dgp.Hammerstein(1, pairs=2),
    "Wiener": lambda: dgp.Wiener(1, pairs=2),
    "Wiener, no process noise": lambda: dgp.Wiener(1, pairs=2, process_noise=False),
    "Wiener-Hammerstein": lambda: dgp.WienerHammerstein(1, pairs=(2, 2)),
    "Wiener-Hammerstein, no process noise": lambda: dgp.WienerHammerstein(
        1, pairs=(2, 2), process_noise=False
    ),
}


def filtered(rng: np.random.Generator, u: np.ndarray) -> np.ndarray:
    """A signal behind a first-order lag or a resonance of unit gain."""
    if rng.random() < 0.5:
        p = np.exp(-rng.uniform(0.05, 0.4))
        return np.asarray(lfilter([0.0, 1.0 - p], [1.0, -p], u))
    r, w = np.exp(-rng.uniform(0.03, 0.2)), rng.uniform(0.1, 0.6)
    a = [1.0, -2.0 * r * np.cos(w), r * r]
    return np.asarray(lfilter([0.0, sum(a)], a, u))


def plant(kind: str, seed: int, samples: int) -> tuple[dgp.Record, dgp.Record, float]:
    """Training record, what follows it, and the sd of the noise."""
    rng = np.random.default_rng(FIRST + seed)
    n = samples + AHEAD
    u = lfilter([0.3], [1.0, -rng.uniform(0.0, 0.9)], rng.normal(size=n))
    u, f, size = u / u.std(), FUNCTIONS[seed % len(FUNCTIONS)], rng.uniform(0.7, 2.0)
    if kind == "Hammerstein":
        y = filtered(rng, f(size * u))
    else:
        x = filtered(rng, u)
        y = f(size * x / x.std())
        y = filtered(rng, y) if kind.startswith("Wiener-Hammerstein") else y
    noise = NOISE[seed % len(NOISE)]
    y = (y - y.mean()) / y.std() + noise * rng.normal(size=n)
    record = dgp.Record(np.arange(n) * STEP, u[:, None], y[:, None])
    return record[:samples], record[samples:], noise


def run(folder: Path) -> str:
    """A row for each structure and method: medians over plants, bands in means."""
    del folder  # nothing is drawn
    count = int(os.environ.get("FORWARD_PLANTS", "12"))
    samples = int(os.environ.get("FORWARD_SAMPLES", "500"))
    methods = os.environ.get("FORWARD_METHODS", "svi,default").split(",")
    lines = [
        "| structure | method | CPU seconds | RMSE / noise | CRPS / noise | 95 % bands | 50 % |",
        "|---|---|---|---|---|---|---|",
    ]
    for kind, make in MODELS.items():
        for method in methods:
            options: dict[str, Any] = {} if method == "default" else {"method": method}
            rows = []
            for seed in range(count):
                train, test, noise = plant(kind, seed, samples)
                begin = time.process_time()
                fit = dgp.fit(make(), train, workers=1, progress=False, **options)
                seconds = time.process_time() - begin
                found = dgp.scores(fit.forecast(train, test), test)
                errors = [found["rmse"] / noise, found["crps"] / noise]
                rows.append([seconds, *errors, found["coverage_95"], found["coverage_50"]])
            cpu, rmse, crps, *_ = np.median(rows, 0)
            wide, narrow = 100.0 * np.mean(rows, 0)[3:]
            lines.append(
                f"| {kind} | {method} | {cpu:.1f} | {rmse:.3f} | {crps:.3f} | {wide:.1f} | "
                f"{narrow:.1f} |"
            )
    return "\n".join(lines)
