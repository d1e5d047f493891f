"""Which guide is the default of an architecture: held-out scores of each, on simulated machines."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

import pyro_dynogp as dgp
from pyro_dynogp.lti.response import mean_response

Signal = Callable[[np.ndarray], np.ndarray]
GUIDES = ("collapsed", "gauss-markov", "inducing times")
TRAINING, TOTAL, STEP = 400, 1000, 0.05
NOISE = 0.05  # of the output's standard deviation


def _linear(poles: complex, gain: complex) -> Signal:
    modes = dgp.Modes([poles], [[gain]], [1.0])

    def apply(x: np.ndarray) -> np.ndarray:
        time_ = np.arange(len(x)) * STEP
        out = mean_response(modes, time_, x[:, None]).output.numpy().reshape(-1)
        return out / out.std()

    return apply


FIRST = _linear(-0.6 + 2.0j, 0.3 - 0.8j)
SECOND = _linear(-1.5 + 0.7j, 0.6 - 0.9j)


def bend(x: np.ndarray) -> np.ndarray:
    """A saturation that is not symmetric."""
    return np.tanh(1.3 * x) + 0.3 * np.tanh(1.3 * x) ** 2


def clip(x: np.ndarray) -> np.ndarray:
    """A sensor's limits."""
    return np.tanh(0.8 * x)


MACHINES: dict[str, tuple[Signal, dgp.Cascade]] = {
    "Wiener": (lambda u: bend(FIRST(u)), dgp.Wiener(1, pairs=2)),
    "Hammerstein": (lambda u: FIRST(bend(u)), dgp.Hammerstein(1, pairs=2)),
    "WienerHammerstein": (lambda u: SECOND(bend(FIRST(u))), dgp.WienerHammerstein(1, pairs=2)),
    "HammersteinWiener": (lambda u: clip(FIRST(bend(u))), dgp.HammersteinWiener(1, pairs=2)),
}


def records(machine: Signal, seed: int) -> tuple[dgp.Record, dgp.Record]:
    """Training and test record of one machine under a coloured input."""
    rng = np.random.default_rng(seed)
    u = np.convolve(rng.standard_normal(TOTAL + 40), np.exp(-np.arange(40) / 6.0), "valid")[:TOTAL]
    u = u / u.std()
    y = machine(u)
    y = y + NOISE * y.std() * rng.standard_normal(TOTAL)
    whole = dgp.Record(np.arange(TOTAL) * STEP, u[:, None], y[:, None])
    return whole.split(TRAINING)


def run(folder: Path) -> str:
    """Held-out scores of every guide on every architecture."""
    del folder
    lines = [
        f"Free run on {TOTAL - TRAINING} samples after {TRAINING} of training; RMSE over the "
        "noise's standard deviation (1 is perfect), CRPS over that of the true predictive, 95 % "
        "coverage, seconds. Default settings.",
        "",
        "| architecture | guide | RMSE | CRPS | coverage | seconds |",
        "|---" * 6 + "|",
    ]
    for name, (machine, model) in MACHINES.items():
        train, test = records(machine, seed=len(name))
        noise = NOISE * float(train.outputs.std())
        for guide in GUIDES:
            begin = time.perf_counter()
            fit = dgp.fit(model, train, guide=guide, progress=False)
            spent = time.perf_counter() - begin
            found = dgp.scores(fit.forecast(train, test), test)
            lines.append(
                f"| {name} | {guide} | {found['rmse'] / noise:.3f} | "
                f"{found['crps'] / (noise / np.sqrt(np.pi)):.3f} | {found['coverage_95']:.3f} | "
                f"{spent:.0f} |"
            )
            print(lines[-1], flush=True)
    return "\n".join(lines)
