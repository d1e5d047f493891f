"""Simulated plants with feedback: free runs beside those of the true plant.

Two models each: a linear one, and the feedback of its structure, both with defaults.

Duffing oscillators, tank chains (every second one overflows), friction and Bouc-Wen hysteresis,
from `pyro_dynogp.examples.feedback`: 600 samples are fitted, 400 forecast from their inputs alone.
Noise is 1, 2 and 5 % of the output in turn. The floor is what the plant itself with its true
parameters reaches: it leaves the measurement noise alone, an RMSE of its standard deviation and a
CRPS of that over the square root of pi.

    python -m tests.benchmarks feedback

The variable FEEDBACK_SEEDS names the seeds, by default 0-19 (0-5 for six); FEEDBACK_KINDS the
kinds, separated by commas. Rows of single fits go to feedback.csv in the folder of the results;
those that are there already are not fitted again.
"""

from __future__ import annotations

import os
import time
import warnings
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np
import pandas as pd
import torch

import pyro_dynogp as dgp
from pyro_dynogp.examples.feedback import (
    FeedbackSimulation,
    simulate_bouc_wen,
    simulate_duffing,
    simulate_friction,
    simulate_tanks,
)
from pyro_dynogp.prediction.scores import scores
from tests.benchmarks.markdown import table

NOISE = (0.01, 0.02, 0.05)
Simulator = Callable[[int, float], FeedbackSimulation]
Maker = Callable[[], dgp.Model]
LINEAR, FEEDBACK = "linear", "feedback"


def tanks(seed: int, noise: float) -> FeedbackSimulation:
    """Every second pair of tanks overflows."""
    return simulate_tanks(seed, overflow=seed % 2 == 1, noise_ratio=noise)


def hysteretic() -> dgp.Model:
    """Two pairs of poles, and a hysteresis of two hidden signals of theirs."""
    mass = dgp.Dynamic(pairs=2, hidden=2, feedback=("past",), substeps=3, name="mass")
    past = dgp.Form("hysteresis", sees=("mass_hidden",), name="past")
    return dgp.Cascade(1, (mass, past), output="mass")


# What is simulated, and the model of its structure.
KINDS: Mapping[str, tuple[Simulator, Maker]] = {
    "Duffing": (
        lambda seed, noise: simulate_duffing(seed, noise_ratio=noise),
        lambda: dgp.NonlinearFeedback(1),
    ),
    "tanks": (tanks, lambda: dgp.NonlinearFeedback(1, hidden=1)),
    "tanks with forms": (tanks, lambda: dgp.NonlinearFeedback(1, hidden=1, parametric=True)),
    "friction": (
        lambda seed, noise: simulate_friction(seed, noise_ratio=noise),
        lambda: dgp.NonlinearFeedback(1, hidden=1),
    ),
    "Bouc-Wen": (
        lambda seed, noise: simulate_bouc_wen(seed, noise_ratio=noise),
        hysteretic,
    ),
}


def noise_of(seed: int) -> float:
    """Levels in turn, each with and without overflow."""
    return NOISE[seed // 2 % len(NOISE)]


def relative(fit: dgp.Fit, plant: FeedbackSimulation) -> dict[str, float]:
    """Scores of a forecast of the test's measured outputs over those of the floor."""
    found = scores(fit.forecast(plant.train, plant.test, seed=0), plant.test)
    sd = plant.noise_sd
    return {
        "rmse": found["rmse"] / sd,
        "crps": float(found["crps"] / (sd / np.sqrt(np.pi))),
        "coverage_50": found["coverage_50"],
        "coverage_95": found["coverage_95"],
    }


def one(kind: str, seed: int, which: str) -> dict[str, object]:
    """One fit and its scores."""
    simulate, make = KINDS[kind]
    plant = simulate(seed, noise_of(seed))
    model = dgp.LinearDynamicGP(1, pairs=2) if which == LINEAR else make()
    begin = time.process_time()
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always", UserWarning)
        fit = dgp.fit(model, plant.train, workers=1, progress=False, seed=0)
        seconds = time.process_time() - begin
        found = relative(fit, plant)
    return {
        "kind": kind,
        "seed": seed,
        "model": which,
        "noise": noise_of(seed),
        **found,
        "seconds": seconds,
        "warnings": "; ".join(sorted({str(w.message)[:60] for w in said})),
    }


def row(kind: str, which: str, own: pd.DataFrame) -> list[str]:
    """A line of the table."""
    rmse = own["rmse"]
    return [
        kind,
        which,
        str(len(own)),
        f"{rmse.median():.2f}",
        f"{rmse.quantile(0.9):.2f}",
        f"{own['crps'].median():.2f}",
        f"{own['coverage_95'].mean():.1%}",
        f"{own['coverage_50'].mean():.1%}",
        f"{own['seconds'].median():.0f}",
    ]


def seeds() -> list[int]:
    """Those that FEEDBACK_SEEDS names."""
    first, last = os.environ.get("FEEDBACK_SEEDS", "0-19").split("-")
    return list(range(int(first), int(last) + 1))


def run(folder: Path) -> str:
    """A row for each kind and model."""
    torch.set_num_threads(1)
    path = folder / "feedback.csv"
    found = pd.read_csv(path).to_dict("records") if path.exists() else []
    kinds = os.environ.get("FEEDBACK_KINDS", ",".join(KINDS)).split(",")
    there = {(r["kind"], r["seed"], r["model"]) for r in found}
    for seed in seeds():
        for kind in kinds:
            for which in (LINEAR, FEEDBACK):
                if (kind, seed, which) not in there:
                    found.append(one(kind, seed, which))
                    pd.DataFrame(found).to_csv(path, index=False)
                    print(found[-1], flush=True)
    frame = pd.DataFrame(found)
    lines = [
        row(kind, which, own)
        for kind in kinds
        for which in (FEEDBACK, LINEAR)
        if len(own := frame[(frame["kind"] == kind) & (frame["model"] == which)])
    ]
    head = [
        "plant", "model", "seeds", "RMSE, median", "90th percentile", "CRPS, median",
        "95 % bands hold", "50 % bands hold", "CPU seconds",
    ]  # fmt: skip
    return (
        "Forecasts of 400 measured outputs from their inputs alone, over the floor: the noise's "
        "standard deviation (RMSE) and that over the square root of pi (CRPS), which is what the "
        "plant with its true parameters reaches. Noise 1, 2 and 5 % in turn.\n\n"
        f"{table(head, lines)}"
    )
