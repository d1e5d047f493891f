"""The paper's simulated Wiener study: train on 15 s, forecast 10 s without process noise."""

from __future__ import annotations

import json
import math
import os
import time
from pathlib import Path
from typing import Any

import numpy as np

import pyro_dynogp as dgp

# Folder with the published records seed_0.npz ... seed_9.npz; without it our own simulator serves.
VARIABLE = "PYRO_DYNOGP_WIENER_STUDY"
# Optional JSON file {"seed": {"rmse", "noise_floor_rmse", "rmse_against_clean"}} of a peer.
PEER = "PYRO_DYNOGP_WIENER_PEER"
TRAINING = 1500


def load(seed: int) -> tuple[dgp.Record, dgp.Record, np.ndarray]:
    """Training record, test record and the noise-free test output.

    In the published arrays y[k] is the output one step after t[k]; here it is at its own time.
    """
    folder = os.environ.get(VARIABLE)
    if folder is None:
        return simulated(seed)
    arrays = np.load(Path(folder) / f"seed_{seed}.npz")
    t, y, clean = (arrays[name].ravel() for name in ("t", "y", "y_clean"))
    u = arrays["u"].reshape(len(t), -1)
    train, test = dgp.Record(t[1:], u[1:], y[:-1, None]).split(TRAINING)
    return train, test, clean[:-1][TRAINING:]


def simulated(seed: int) -> tuple[dgp.Record, dgp.Record, np.ndarray]:
    """The same of our own simulator."""
    data = dgp.datasets.load("wiener", seed=seed)
    assert data.truth is not None
    assert isinstance(data.train, dgp.Record)
    return data.train, data.test, np.ravel(data.truth.clean_test)


def identify(seed: int, **options: Any) -> dict[str, float]:
    """Fit and forecast one system; scores as the study states them."""
    train, test, clean = load(seed)
    begin = time.perf_counter()
    fit = dgp.fit(dgp.Wiener(inputs=train.n_inputs, pairs=5), train, progress=False, **options)
    spent = time.perf_counter() - begin
    forecast = fit.forecast(train, test, process_noise=False)
    y, mean = test.outputs[:, 0], forecast.mean[:, 0]
    noise = y - clean
    floor = math.sqrt(float(np.mean(noise**2)))
    score = dgp.scores(forecast, test)
    error = np.abs(mean - y)
    return {
        "ratio": math.sqrt(float(np.mean((mean - y) ** 2))) / floor,
        "clean": math.sqrt(float(np.mean((mean - clean) ** 2))),
        "crps": score["crps"] / (floor / math.sqrt(math.pi)),
        "coverage": score["coverage_95"],
        "first": float(error[:150].mean() / error[150:].mean()),
        "noise": float(fit.noise_sd[0]) / floor,
        "seconds": spent,
    }


def run(folder: Path) -> str:
    """Ten systems with default settings."""
    del folder
    peer: dict[str, Any] = {}
    if PEER in os.environ:
        peer = json.loads(Path(os.environ[PEER]).read_text())
    source = "the published records" if VARIABLE in os.environ else "our own simulator"
    lines = [
        f"Forecast from the filtered state, {source}, default settings. RMSE and CRPS over those "
        "of the true predictive distribution; MAE of the first 150 samples over that of the rest.",
        "",
        "| seed | RMSE ratio | peer's | clean RMSE | over peer's | CRPS | coverage | first | "
        "noise sd | seconds |",
        "|---" * 10 + "|",
    ]
    rows = []
    for seed in range(10):
        row = identify(seed)
        other = peer.get(str(seed))
        row["peer"] = other["rmse"] / other["noise_floor_rmse"] if other else math.nan
        row["over"] = row["clean"] / other["rmse_against_clean"] if other else math.nan
        rows.append(row)
        lines.append(_line(str(seed), row))
        print(lines[-1], flush=True)
    lines.append(_line("median", {k: float(np.median([r[k] for r in rows])) for k in rows[0]}))
    return "\n".join(lines)


def _line(name: str, row: dict[str, float]) -> str:
    return (
        f"| {name} | {row['ratio']:.4f} | {row['peer']:.4f} | {row['clean']:.4f} | "
        f"{row['over']:.2f} | {row['crps']:.3f} | {row['coverage']:.3f} | {row['first']:.2f} | "
        f"{row['noise']:.3f} | {row['seconds']:.0f} |"
    )
