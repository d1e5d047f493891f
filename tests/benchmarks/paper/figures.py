"""Pictures of the comparison."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from tests.benchmarks.paper.experiments import Experiment
from tests.benchmarks.paper.prediction import OURS, folder_name

Row = Mapping[str, Any]
# A long test record is shown in part.
SHOWN = 1500
# Samples over which errors of the simulated study are averaged along time.
SMOOTHED = 25
COLOURS = ("#1b6ca8", "#d1495b", "#3a7d44", "#8a5a9e", "#b08900", "#5c5c5c", "#2a9d8f")


def predictions_file(folder: Path, row: Row) -> Path:
    """Where a job of the experiment has left what it predicted."""
    return folder / folder_name(row["method"]) / f"{row['seed']}.npz"


def complete_seeds(rows: Sequence[Row], folder: Path) -> list[int]:
    """Seeds of which the predictions of all methods are there."""
    there = {(r["method"], r["seed"]) for r in rows if predictions_file(folder, r).exists()}
    methods = {row["method"] for row in rows}
    seeds = sorted({row["seed"] for row in rows})
    return [seed for seed in seeds if all((method, seed) in there for method in methods)]


def _arrays(folder: Path, row: Row) -> Mapping[str, np.ndarray]:
    with np.load(predictions_file(folder, row)) as file:
        return {key: file[key] for key in file.files}


def experiment_figure(experiment: Experiment, rows: Sequence[Row], folder: Path, to: Path) -> None:
    """The first test record with our band and the means of the peers; RMSE of all methods.

    Of the first seed whose predictions are all there.
    """
    seed = complete_seeds(rows, folder)[0]
    tests = experiment.load(seed)[1]
    name, record = next(iter(tests.items()))
    first = {row["method"]: row for row in rows if row["seed"] == seed}
    begin = max(0, (len(record) - SHOWN) // 2)
    here = slice(begin, min(len(record), begin + SHOWN))
    figure = Figure(figsize=(10.0, 6.4), layout="constrained")
    top, below = figure.subplots(2, 1, height_ratios=(2, 1))
    time = record.time[here]
    top.plot(time, record.outputs[here, 0], color="black", lw=1.0, label="measured")
    for colour, (method, row) in zip(COLOURS, first.items(), strict=False):
        arrays = _arrays(folder, row)
        if method == OURS:
            top.fill_between(
                time, arrays[f"{name}/low"][here], arrays[f"{name}/high"][here],
                color=colour, alpha=0.25, lw=0, label=f"95 %, {OURS}",
            )  # fmt: skip
        if method in (OURS, "dynoNet", "GP-NARX"):
            top.plot(time, arrays[f"{name}/mean"][here], color=colour, lw=1.0, label=method)
    spread = record.outputs[here, 0]
    room = 0.3 * np.nanstd(spread) + 1e-12
    top.set_ylim(np.nanmin(spread) - room, np.nanmax(spread) + room)
    top.set_xlabel(f"time [{record.time_unit}]")
    top.set_ylabel(f"{record.output_names[0]} [{experiment.unit}]")
    top.set_title(f"{experiment.name}: {name}, free run")
    top.legend(loc="upper right", fontsize=8, ncols=2)
    methods = list(first)
    for place, (method, colour) in enumerate(zip(methods, COLOURS, strict=False)):
        values = [r["scores"][name]["rmse"] for r in rows if r["method"] == method]
        below.plot(values, [place] * len(values), "o", color=colour)
    below.set_yticks(range(len(methods)), methods)
    below.set_xscale("log")
    below.set_xlabel(f"RMSE [{experiment.unit}]")
    below.grid(axis="x", which="both", alpha=0.3)
    below.invert_yaxis()
    figure.savefig(to, dpi=110)


def study_figure(experiment: Experiment, rows: Sequence[Row], folder: Path, to: Path) -> None:
    """Absolute error and CRPS along the test, medians over systems in units of the noise floor."""
    figure = Figure(figsize=(10.0, 6.4), layout="constrained")
    panels = figure.subplots(2, 1, sharex=True)
    known = {seed: experiment.load(seed)[1]["test"] for seed in {row["seed"] for row in rows}}
    methods = list(dict.fromkeys(row["method"] for row in rows))
    for method, colour in zip(methods, COLOURS, strict=False):
        errors, crps = [], []
        for row in (r for r in rows if r["method"] == method):
            record = known[row["seed"]]
            y, floor = record.outputs[:, 0], row["scores"]["test"]["floor"]
            arrays = _arrays(folder, row)
            errors.append(_smooth(np.abs(arrays["test/mean"] - y)) / floor)
            if "test/crps" in arrays:
                crps.append(_smooth(arrays["test/crps"]) / floor)
        time = _smooth(record.time)
        label = method if len(errors) == len(known) else f"{method} ({len(errors)} systems)"
        panels[0].plot(time, np.median(errors, 0), color=colour, label=label)
        if crps:
            panels[1].plot(time, np.median(crps, 0), color=colour, label=label)
    panels[0].set_ylabel("|error| / noise floor")
    panels[1].set_ylabel("CRPS / noise floor")
    panels[1].set_xlabel("time [s]")
    panels[0].set_title(f"{experiment.name}: medians over {len(known)} systems")
    for panel in panels:
        panel.legend(fontsize=8)
        panel.grid(alpha=0.3)
        panel.set_yscale("log")
    figure.savefig(to, dpi=110)


def _smooth(values: np.ndarray) -> np.ndarray:
    """Means of neighbouring samples."""
    count = len(values) // SMOOTHED
    return values[: count * SMOOTHED].reshape(count, SMOOTHED).mean(1)
