"""The paper's electricity model: 22 inputs, layers of 3, 3 and 1 signals, 26 304 samples."""

from __future__ import annotations

import csv
import os
import resource
import time
from pathlib import Path

import numpy as np

import pyro_dynogp as dgp
from tests.benchmarks import cascade_cost

# Path of vic_elec.csv (columns Time, Demand, Temperature, Date, Holiday).
VARIABLE = "PYRO_DYNOGP_ELECTRICITY"
TRAINING, TEST = 26304, 8736
MINUTES = 20.0
# Harmonics: periods a year, and how many of each.
PERIODS = ((365.0, 4), (52.14, 4), (1.0, 2))


def load(path: Path) -> tuple[dgp.Record, dgp.Record]:
    """Training and test record with the paper's inputs; time in hours, demand in MW."""
    with path.open(newline="") as file:
        rows = list(csv.DictReader(file))[: TRAINING + TEST]
    year = np.arange(len(rows)) / (48.0 * 365.0)
    columns = {
        "temperature": np.array([float(r["Temperature"]) for r in rows]),
        "holiday": np.array([float(r["Holiday"] == "TRUE") for r in rows]),
    }
    for frequency, count in PERIODS:
        for k in range(1, count + 1):
            angle = 2.0 * np.pi * k * frequency * year
            columns[f"cos_{frequency:g}_{k}"] = np.cos(angle)
            columns[f"sin_{frequency:g}_{k}"] = np.sin(angle)
    record = dgp.Record(
        0.5 * np.arange(len(rows)),
        np.stack(list(columns.values()), 1),
        np.array([[float(r["Demand"])] for r in rows]),
        input_names=tuple(columns),
        output_names=("demand",),
    )
    return record.split(TRAINING)


def run(folder: Path) -> str:
    """Train for about twenty minutes from one start; scores on the next six months."""
    path = os.environ.get(VARIABLE)
    if path is None:
        return f"Skipped: set {VARIABLE} to the path of vic_elec.csv."
    train, test = load(Path(path))
    model = cascade_cost.models()["electricity"][0]
    step = cascade_cost.one("collapsed", "electricity", TRAINING)
    steps = max(20, int(60.0 * MINUTES / step))
    begin = time.perf_counter()
    fit = dgp.fit(model, train, method="map", restarts=1, steps=steps, progress=True)
    spent = time.perf_counter() - begin
    fit.save(folder / "electricity.safetensors")
    lines = [
        f"One start, {steps} steps of Adam at {step:.2f} s each and the linear fits before them: "
        f"{spent / 60:.1f} minutes; peak memory of this process "
        f"{resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6:.1f} GB.",
        "",
        "| | RMSE [MW] | MAE [MW] | CRPS [MW] | 95 % coverage |",
        "|---|---|---|---|---|",
    ]
    for name, found in (
        ("six months ahead", dgp.scores(fit.forecast(train, test), test)),
        ("training, free run", dgp.scores(fit.simulate(train), train)),
    ):
        lines.append(
            f"| {name} | {found['rmse']:.0f} | {found['mae']:.0f} | {found['crps']:.0f} | "
            f"{found['coverage_95']:.3f} |"
        )
    return "\n".join(lines)
