"""The protocol of nonlinearbenchmark.org: free runs of a test record from its inputs alone.

Of the outputs of a test only the first few may be seen, to find the state; the error counts after
them. Records are the package's, or what the package `nonlinear_benchmarks` returns
(`Input_output_data`), or arrays:

    python -m tests.benchmarks leaderboard

Silverbox is not part of the package: the variable PYRO_DYNOGP_SILVERBOX names its file
(SNLS80mV.csv, or compressed).
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import torch

import pyro_dynogp as dgp
from pyro_dynogp.prediction.scores import scores
from tests.benchmarks.markdown import table

SILVERBOX = "PYRO_DYNOGP_SILVERBOX"


@dataclass(frozen=True)
class Benchmark:
    """What is fitted and what it is tested on.

    Attributes:
        train: record to fit. tests: by name. first: outputs of each test that may be seen.
        published: best published RMSE of each test, and by what [unit of the output times `unit`].
        unit: number by which errors are multiplied, and its name.
    """

    train: dgp.Record
    tests: Mapping[str, dgp.Record]
    first: int
    published: Mapping[str, str]
    unit: tuple[float, str] = (1.0, "")


def record_of(data: Any, step: float | None = None) -> dgp.Record:
    """A record of one, of an object with `u`, `y` and `sampling_time`, or of (u, y) and a step."""
    if isinstance(data, dgp.Record):
        return data
    u, y = (data.u, data.y) if hasattr(data, "u") else data
    step = step if step is not None else getattr(data, "sampling_time", None)
    if step is None:
        raise ValueError("step: expected the sampling time, got none. Arrays do not know theirs.")
    return dgp.Record(time=float(step) * np.arange(len(u)), inputs=u, outputs=y)


def score(fit: dgp.Fit, test: Any, first: int, step: float | None = None) -> dict[str, float]:
    """RMSE as the site has it, CRPS [output] and coverage of the 95 % band after the first outputs.

    Args:
        fit: of the training record. test: see `record_of`. first: outputs that may be seen.
    """
    record = record_of(test, step)
    past, later = record[:first], record[first:]
    blind = dgp.Record(
        time=later.time,
        inputs=later.inputs,
        input_names=record.input_names,
        input_units=record.input_units,
    )
    found = scores(fit.forecast(past, blind), later)
    return {name: found[name] for name in ("rmse", "crps", "coverage_95")}


def silverbox(samples: int = 8000) -> Benchmark:
    """An electronic Duffing oscillator; the first `samples` of the training part are fitted."""
    both = pd.read_csv(os.environ[SILVERBOX], usecols=["V1", "V2"]).to_numpy()
    record = record_of((both[:, 0], both[:, 1]), 1.0 / 610.35)
    multisine = record[40650:127400]
    border = int(0.75 * len(multisine))
    tests = {
        "multisine": multisine[border:],
        "arrow": record[100:40575],
        "arrow within the data": record[100:32100],
    }
    published = {
        "multisine": "0.301 (GP-NARX)",
        "arrow": "0.26 (PNLSS)",
        "arrow within the data": "0.259 (GP-NARX)",
    }
    return Benchmark(multisine[:samples], tests, 50, published, (1e3, "mV"))


def drives(number: int) -> Benchmark:
    """Two electric drives and a pulley, whose sensor reads the absolute value of its speed."""
    data = dgp.datasets.load("coupled_drives", record=number)
    assert isinstance(data.train, dgp.Record)
    best = {1: "0.096 (RNN)", 2: "0.074 (CT-SUBNET)"}[number]
    return Benchmark(data.train, {f"record {number}": data.test}, 4, {f"record {number}": best})


def circuit() -> Benchmark:
    """Wiener-Hammerstein with process noise: one realisation is fitted."""
    tests = {}
    for name in ("multisine", "swept sine"):
        data = dgp.datasets.load("wh_process_noise", test=name)
        tests[name] = data.test
    assert isinstance(data.train, dgp.Record)
    return Benchmark(data.train, tests, 50, {})


def known_spring() -> dgp.Model:
    """Linear dynamics with the square and the cube of their output in feedback."""
    powers = dgp.Known(lambda y: torch.stack([y**2, y**3], -1), outputs=2, range=(-1.0, 1.0))
    layers = (dgp.Dynamic(pairs=1, feedback=("f",), process_noise=False), powers)
    return dgp.Cascade(1, layers, output="g")


ENTRIES: dict[str, tuple[Callable[[], Benchmark], Callable[[], dgp.Model], dict[str, Any]]] = {
    "coupled drives 1": (lambda: drives(1), lambda: dgp.Wiener(1, pairs=3), {}),
    "coupled drives 2": (lambda: drives(2), lambda: dgp.Wiener(1, pairs=3), {}),
    "Silverbox": (
        silverbox,
        lambda: dgp.NonlinearFeedback(1, parametric="cube", process_noise=False),
        {"restarts": 2},
    ),
    "Silverbox, Gaussian process": (
        silverbox,
        lambda: dgp.NonlinearFeedback(1, process_noise=False),
        {"restarts": 2},
    ),
    "Silverbox, known spring": (silverbox, known_spring, {"restarts": 2}),
    "Wiener-Hammerstein": (circuit, lambda: dgp.WienerHammerstein(1, pairs=3), {"restarts": 4}),
}


def enter(name: str) -> list[list[str]]:
    """Lines of the table for one entry."""
    load, model, options = ENTRIES[name]
    if name.startswith("Silverbox") and SILVERBOX not in os.environ:
        return [[name, f"not measured: {SILVERBOX} is not set", "", "", "", "", ""]]
    benchmark = load()
    begin = time.perf_counter()
    fit = dgp.fit(model(), benchmark.train, workers=1, progress=False, **options)
    seconds = time.perf_counter() - begin
    factor, unit = benchmark.unit
    lines = []
    for test, record in benchmark.tests.items():
        found = score(fit, record, benchmark.first)
        error, crps = (f"{factor * found[k]:.3g} {unit}".strip() for k in ("rmse", "crps"))
        best = benchmark.published.get(test, "")
        cover = f"{found['coverage_95']:.1%}"
        lines.append([name, test, error, crps, cover, best, f"{seconds:.0f}"])
    return lines


def run(folder: Path) -> str:
    """All entries, or those that the variable LEADERBOARD names, separated by commas."""
    del folder
    names = os.environ.get("LEADERBOARD", ",".join(ENTRIES)).split(",")
    lines = [line for name in names for line in enter(name)]
    head = ["record", "test", "RMSE", "CRPS", "95 % band", "best published RMSE", "seconds"]
    return table(head, lines)
