"""The closed loop on plants whose equations are in any textbook, from a linear model, by default.

Each is simulated by Runge-Kutta steps, measured with 2 % noise: 1200 samples, of which the first
half is fitted and the last quarter reported on. What the linear model lacks is in feedback
(pendulum, friction, radiation, Van der Pol, an input that multiplies the state, tanks), before the
dynamics (valve, with a dead time; a product of inputs) or behind them (titration). Errors are over
the noise, 1 being all that can be reached.

    python -m tests.benchmarks textbook

The variable TEXTBOOK_SEEDS names the seeds, by default 1 and 2; TEXTBOOK_PLANTS the plants,
separated by commas.
"""

from __future__ import annotations

import os
import time
import warnings
from collections.abc import Callable, Mapping
from pathlib import Path

import joblib
import numpy as np

import pyro_dynogp as dgp
from pyro_dynogp.examples.feedback import integrated
from tests.benchmarks.markdown import table

N, SUBSTEPS, NOISE = 1200, 5, 0.02
Generator = np.random.Generator
Rate = Callable[[np.ndarray, np.ndarray], list[float]]
# Step, inputs (N, n_u), and outputs (N, n_y) without noise.
Made = tuple[float, np.ndarray, np.ndarray]


def simulated(rate: Rate, start: list[float], inputs: np.ndarray, step: float) -> np.ndarray:
    """States (N, d) of x' = rate(x, u), inputs (N, n_u) held over each step."""

    def at(x: tuple[float, ...], k: float) -> tuple[float, ...]:
        return tuple(rate(np.array(x), inputs[int(k)]))

    return integrated(at, tuple(start), np.arange(N), step, SUBSTEPS)[:-1]


def steps(rng: Generator, held: int, sd: float = 1.0) -> np.ndarray:
    """Levels (N,) that are held for so many samples each."""
    return sd * np.repeat(rng.standard_normal(N // held + 1), held)[:N]


def waves(rng: Generator, step: float, fastest: float, sd: float = 1.0) -> np.ndarray:
    """Sum (N,) of 40 waves up to a frequency [cycles a time unit]."""
    frequency = np.linspace(fastest / 40, fastest, 40)[:, None]
    phase = rng.uniform(0.0, 2.0 * np.pi, 40)[:, None]
    u: np.ndarray = np.cos(2.0 * np.pi * frequency * step * np.arange(N) + phase).sum(0)
    return sd * u / u.std()


def pendulum(rng: Generator) -> Made:
    """A torque drives it; the angle is measured."""
    u = waves(rng, 0.05, 1.2, 3.0)[:, None]
    x = simulated(lambda x, u: [x[1], u[0] - 9.0 * np.sin(x[0]) - 0.6 * x[1]], [0, 0], u, 0.05)
    return 0.05, u, x[:, :1]


def friction(rng: Generator) -> Made:
    """A motor with viscous and Coulomb friction; the speed is measured."""
    u = waves(rng, 0.02, 3.0)[:, None]

    def rate(x: np.ndarray, u: np.ndarray) -> list[float]:
        return [(u[0] - 0.3 * x[0] - 0.45 * np.tanh(x[0] / 0.03)) / 0.15]

    return 0.02, u, simulated(rate, [0.0], u, 0.02)


def heater(rng: Generator) -> Made:
    """An element that radiates, and a sensor that lags behind it."""
    u = np.clip(steps(rng, 20) + 1.2, 0.0, None)[:, None]

    def rate(x: np.ndarray, u: np.ndarray) -> list[float]:
        radiation = 1.2e-10 * ((x[0] + 293.0) ** 4 - 293.0**4)
        return [2.4 * u[0] - 0.004 * x[0] - radiation, (x[0] - x[1]) / 20.0]

    return 5.0, u, simulated(rate, [50.0, 50.0], u, 5.0)[:, 1:]


def valve(rng: Generator) -> Made:
    """An equal-percentage valve, 4.5 s before a tank that is stirred."""
    u = np.clip(0.5 + 0.18 * steps(rng, 12), 0.05, 0.95)
    flow = 30.0 ** (np.concatenate([np.full(9, u[0]), u[:-9]]) - 1.0)[:, None]
    y = simulated(lambda x, q: [(10.0 * q[0] - x[0]) / 6.0], [10.0 * flow[0, 0]], flow, 0.5)
    return 0.5, u[:, None], y


def titration(rng: Generator) -> Made:
    """Two stirred tanks, and a pH electrode at the second."""
    u = waves(rng, 1.0, 0.05)[:, None]
    x = simulated(lambda x, u: [(u[0] - x[0]) / 8.0, (x[0] - x[1]) / 3.0], [0.0, 0.0], u, 1.0)
    return 1.0, u, 7.0 + 2.5 * np.arcsinh(6.0 * x[:, 1:])


def van_der_pol(rng: Generator) -> Made:
    """An oscillator that keeps itself going."""
    u = waves(rng, 0.1, 0.4, 1.5)[:, None]
    x = simulated(lambda x, u: [x[1], (1 - x[0] ** 2) * x[1] - x[0] + u[0]], [1.0, 0.0], u, 0.1)
    return 0.1, u, x[:, :1]


def bilinear(rng: Generator) -> Made:
    """A flow multiplies the temperature that it carries away."""
    u = np.column_stack([np.clip(steps(rng, 15, 0.5), -0.9, 0.9), steps(rng, 22)])
    y = simulated(lambda x, u: [1.0 + u[1] - x[0] + 0.8 * u[0] * x[0]], [1.0], u, 0.2)
    return 0.2, u, y


def tanks(rng: Generator) -> Made:
    """Four tanks (Johansson, IEEE Trans. Control Syst. Technol. 8:456, 2000), two are measured."""
    u = np.clip(np.column_stack([steps(rng, 25, 0.5), steps(rng, 31, 0.5)]) + 2.5, 0.0, None)

    def rate(x: np.ndarray, u: np.ndarray) -> list[float]:
        r = np.sqrt(np.maximum(x, 0.0))
        return [
            0.025 * r[2] - 0.045 * r[0] + 0.03 * u[0],
            0.020 * r[3] - 0.040 * r[1] + 0.03 * u[1],
            0.018 * u[1] - 0.030 * r[2],
            0.016 * u[0] - 0.028 * r[3],
        ]

    return 4.0, u, simulated(rate, [8.0, 8.0, 2.0, 2.0], u, 4.0)[:, :2]


def product(rng: Generator) -> Made:
    """Two inputs of which one multiplies the other."""
    u = np.column_stack([steps(rng, 14), steps(rng, 17)])
    drive = (0.5 * u[:, 0] * u[:, 1] + u[:, 0])[:, None]
    return 0.5, u, simulated(lambda x, v: [(v[0] - x[0]) / 3.0], [0.0], drive, 0.5)


# Each with the pairs of the linear model that the loop begins from.
PLANTS: Mapping[str, tuple[Callable[[Generator], Made], int]] = {
    "pendulum": (pendulum, 1),
    "friction": (friction, 1),
    "heater": (heater, 2),
    "valve": (valve, 1),
    "titration": (titration, 2),
    "Van der Pol": (van_der_pol, 1),
    "bilinear": (bilinear, 1),
    "tanks": (tanks, 2),
    "product": (product, 1),
}


def plant(kind: str, seed: int) -> tuple[dgp.Record, np.ndarray]:
    """A record, and the standard deviations (n_y,) of its noise."""
    rng = np.random.default_rng(seed)
    step, inputs, clean = PLANTS[kind][0](rng)
    sd = NOISE * clean.std(0)
    outputs = clean + sd * rng.standard_normal(clean.shape)
    return dgp.Record(step * np.arange(N), inputs, outputs, name=kind), sd


def one(kind: str, seed: int) -> list[str]:
    """A line of the table."""
    record, sd = plant(kind, seed)
    outputs = record.n_outputs
    linear = dgp.LinearDynamicGP(record.n_inputs, outputs=outputs, pairs=PLANTS[kind][1])
    quick = {"workers": 1, "progress": False, "seed": 0}
    with warnings.catch_warnings():
        # What fits of the wrong model warn of is what the loop is to find.
        warnings.simplefilter("ignore", UserWarning)
        fit = dgp.fit(linear, record[: N // 2], **quick)
        begin = time.perf_counter()
        report = dgp.close_loop(fit, record, **quick)
    before, after = (
        float(np.sqrt(np.mean(np.square(np.asarray(scores["rmse"]) / sd))))
        for scores in (report.before, report.after)
    )
    named = "; ".join(
        one.name + "".join(f" or {tie}" for tie in one.ties) + ("" if one.kept else " (left out)")
        for one in report.effects
    )
    cells = [kind, str(seed), named or "–", f"{before:.2f} → {after:.2f}"]
    covered = float(np.mean(report.after["coverage_95"]))
    return [*cells, f"{covered:.0%}", str(report.outcome), f"{time.perf_counter() - begin:.0f}"]


def run(folder: Path) -> str:
    """Markdown of all plants and seeds."""
    seeds = [int(s) for s in os.environ.get("TEXTBOOK_SEEDS", "1,2").split(",")]
    kinds = os.environ.get("TEXTBOOK_PLANTS", ",".join(PLANTS)).split(",")
    tasks = [joblib.delayed(one)(kind, seed) for kind in kinds for seed in seeds]
    rows = []
    for row in joblib.Parallel(n_jobs=-1, return_as="generator")(tasks):
        rows.append(row)
        print(" | ".join(row), flush=True)  # the next may take minutes
    head = ["plant", "seed", "named", "error over noise", "in 95 % bands", "outcome", "seconds"]
    return f"{(__doc__ or '').strip()}\n\n{table(head, rows)}\n"
