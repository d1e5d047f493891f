"""How many outputs to come lie within the bands of a default fit, on systems drawn at random.

Linear systems of one or two modes, real or oscillating, time constants of 2 to 25 samples, driven
by white noise, steps or a multisine; half of them have a feedthrough, half have process noise;
noise of 5 to 20 % of the output. Forecasts of the 100 samples after a training record of n.
Environment variables make a run shorter: COVERAGE_SYSTEMS (40), COVERAGE_SAMPLES
(12,30,60,100,200,500), COVERAGE_MODELS (linear,wiener,feedback).
"""

from __future__ import annotations

import os
import time
import warnings
from pathlib import Path

import numpy as np
from scipy.linalg import block_diag
from scipy.signal import cont2discrete

import pyro_dynogp as dgp

INPUTS = ("white noise", "steps", "multisine")
FUTURE, RUN_IN = 100, 300
# Seeds of systems: those that priors and methods were chosen on are 1000 to 1999.
FIRST = 5000
LEAST = {"linear": 0, "wiener": 100, "feedback": 100}


def input_signal(kind: str, n: int, rng: np.random.Generator) -> np.ndarray:
    """(n,) of unit size."""
    if kind == "white noise":
        return rng.standard_normal(n)
    if kind == "steps":
        lengths = rng.integers(2, 10, n)
        return np.repeat(rng.standard_normal(n), lengths)[:n]
    frequency = np.exp(rng.uniform(np.log(0.005), np.log(0.4), 8))
    phase = rng.uniform(0.0, 2.0 * np.pi, 8)
    return np.cos(2.0 * np.pi * frequency[:, None] * np.arange(n) + phase[:, None]).sum(0) / 2.0


def linear_record(
    seed: int, n: int, bend: float = 0.0, feedback: float = 0.0
) -> tuple[dgp.Record, dgp.Record]:
    """Training record of n samples, and the 100 after it.

    Args:
        seed: of the system; its remainder by three says which input. n: samples.
        bend: of a saturating function after the dynamics. feedback: of a cubic one around them.
    """
    kind = INPUTS[seed % 3]
    rng = np.random.default_rng([seed, INPUTS.index(kind)])
    blocks = []
    for _ in range(int(rng.integers(1, 3))):
        decay = np.exp(-rng.uniform(np.log(2.0), np.log(25.0)))
        w = np.exp(rng.uniform(np.log(0.02), np.log(1.0)))
        real = rng.random() < 0.5
        blocks.append([[-decay]] if real else [[-decay, w], [-w, -decay]])
    A = block_diag(*blocks)
    d, total = len(A), RUN_IN + n + FUTURE
    B, C = rng.standard_normal((d, 1)), rng.standard_normal((1, d))
    D = 0.2 * rng.standard_normal((1, 1)) * float(rng.random() < 0.5)
    Ad, Bd, *_ = cont2discrete((A, B, C, D), 1.0)
    u = input_signal(kind, total, rng)

    def response(drive: np.ndarray, back: float = 0.0) -> np.ndarray:
        x, y = np.zeros(d), np.empty(total)
        for k in range(total):
            y[k] = C[0] @ x
            x = Ad @ x + drive[k] - back * Bd[:, 0] * np.clip(y[k], -3.0, 3.0) ** 3
        return y

    clean = response(u[:, None] * Bd[:, 0], feedback) + D[0, 0] * u
    clean = clean / clean[RUN_IN:].std()
    if bend:
        clean = np.tanh(bend * clean) / np.tanh(bend)
    noise = response(rng.standard_normal((total, d)))
    share = rng.uniform(0.05, 0.3) * float(rng.random() < 0.5)
    y = clean + share * noise / noise[RUN_IN:].std()
    y = y + rng.uniform(0.05, 0.2) * rng.standard_normal(total) + rng.standard_normal()
    record = dgp.Record(np.arange(n + FUTURE, dtype=float), u[RUN_IN:], y[RUN_IN:])
    train, test = record.split(n)
    return train, test


CASES = {
    "linear": (lambda: dgp.LinearDynamicGP(1, pairs=2), {}),
    "wiener": (lambda: dgp.Wiener(1, pairs=2), {"bend": 1.0}),
    "feedback": (lambda: dgp.NonlinearFeedback(1), {"feedback": 0.05}),
}


def one(model: str, seed: int, n: int, **options: object) -> dict[str, float]:
    """Scores of a default fit, and of its mode."""
    make, bent = CASES[model]
    train, test = linear_record(seed, n, **bent)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        begin = time.process_time()
        fit = dgp.fit(make(), train, workers=1, progress=False, **options)
        cost = time.process_time() - begin
        own = dgp.scores(fit.forecast(train, test), test)
        mode = dgp.scores(fit.at_mode().forecast(train, test), test)
    return {
        "95": own["coverage_95"], "50": own["coverage_50"], "map 95": mode["coverage_95"],
        "crps": own["crps"] / mode["crps"], "cpu": cost,
        "k": fit.diagnostics.get("pareto_k", np.nan),
    }  # fmt: skip


def run(folder: Path) -> str:
    """The table; single results go to a file beside it."""
    systems = int(os.environ.get("COVERAGE_SYSTEMS", "40"))
    samples = [
        int(n) for n in os.environ.get("COVERAGE_SAMPLES", "12,30,60,100,200,500").split(",")
    ]
    models = os.environ.get("COVERAGE_MODELS", "linear,wiener,feedback").split(",")
    lines = [
        "| model | n | systems | 95 % | 50 % | below 80 % | least | mode's 95 % | "
        "CRPS / mode's | processor s |",
        "|---|---|---|---|---|---|---|---|---|---|",
    ]
    single = folder / "coverage_single.csv"
    single.write_text("model,n,seed,95,50,map 95,crps,cpu,k\n")
    for model in models:
        for n in samples:
            if n < LEAST[model]:
                continue
            rows = []
            for seed in range(FIRST, FIRST + systems):
                rows.append(one(model, seed, n))
                with single.open("a") as file:
                    numbers = ",".join(f"{value:.4g}" for value in rows[-1].values())
                    file.write(f"{model},{n},{seed},{numbers}\n")
            table = {name: np.array([row[name] for row in rows]) for name in rows[0]}
            lines.append(
                f"| {model} | {n} | {systems} | {100 * table['95'].mean():.1f} | "
                f"{100 * table['50'].mean():.1f} | {(table['95'] < 0.8).sum()} | "
                f"{100 * table['95'].min():.0f} | {100 * table['map 95'].mean():.1f} | "
                f"{np.median(table['crps']):.3f} | {table['cpu'].mean():.1f} |"
            )
    return "\n".join(lines)
