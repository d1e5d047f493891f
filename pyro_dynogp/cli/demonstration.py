"""The demonstration: identify the coupled electric drives, with scores and figures to look at."""

from __future__ import annotations

import json
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from pyro_dynogp import plotting
from pyro_dynogp.cli.tables import aligned
from pyro_dynogp.data.record import Record
from pyro_dynogp.examples import datasets
from pyro_dynogp.fitting import Fit, fit
from pyro_dynogp.models.architectures import LinearDynamicGP
from pyro_dynogp.prediction.prediction import Prediction
from pyro_dynogp.prediction.scores import scores
from pyro_dynogp.report.loop import close_loop
from pyro_dynogp.report.report import Report
from pyro_dynogp.support.writing import write_result, write_text

HONEST = (
    "The speed sensor of this machine reports the absolute value of the speed, which no linear "
    "model can follow: the simulation error is what a linear model can reach here, and one-step "
    "prediction, which is corrected by every measurement, is much better."
)
# What the figure of a forecast shows of the time before it, in lengths of the forecast.
SHOWN_PAST = 0.6


@dataclass(frozen=True)
class Result:
    """A prediction of test data and its scores.

    Attributes:
        prediction: of the test times. scores: as `pyro_dynogp.scores` gives them.
    """

    prediction: Prediction
    scores: Mapping[str, Any]


def evaluate(
    fit: Fit, test: Record, *, past: Record | None = None, skip: int = 0
) -> dict[str, Result]:
    """Predict test data in every way there is, and score it.

    Args:
        fit: the fit. test: with outputs.
        past: the record that ends right before the test; None where there is none, and no
            forecast then.
        skip: number of first test samples that are not scored.

    Returns:
        "simulation", "forecast" (with `past`) and "one-step" to their `Result`.
    """
    predictions = {"simulation": fit.simulate(test)}
    if past is not None:
        predictions["forecast"] = fit.forecast(past, test)
    predictions["one-step"] = fit.predict(test)
    return {name: Result(made, scores(made, test, skip)) for name, made in predictions.items()}


def score_table(results: Mapping[str, Result], test: Record) -> str:
    """Scores as lines of text, one for each prediction and output."""
    what = {
        "simulation": "simulation from the inputs alone",
        "forecast": "forecast from the end of training",
        "one-step": "one-step-ahead prediction",
    }
    rows = [("", "output", "rmse", "mae", "fit [%]", "CRPS", "95 % band holds [%]")]
    for name, result in results.items():
        for a, output in enumerate(test.output_names):
            unit = test.output_units[a]
            values = {key: float(np.atleast_1d(x)[a]) for key, x in result.scores.items()}
            numbers = (
                f"{values['rmse']:.4g}", f"{values['mae']:.4g}", f"{values['fit_percent']:.1f}",
                f"{values['crps']:.4g}", f"{100 * values['coverage_95']:.1f}",
            )  # fmt: skip
            rows.append((what[name], plotting.named(output, unit), *numbers))
    return aligned(rows, left=2)


def _draw(figure: Figure, path: Path) -> None:
    """Write a figure as PNG."""
    write_result(path, lambda part: figure.savefig(part, dpi=150, format="png"), "The fit")


def write_figures(
    fit: Fit,
    directory: Path,
    *,
    train: Record,
    test: Record | None = None,
    results: Mapping[str, Result] | None = None,
    skip: int = 0,
) -> list[Path]:
    """Write all figures of a fit as PNG files.

    Args:
        fit: the fit. directory: an existing folder; files of the same names are overwritten.
        train: the training record. test: the test record of the results.
        results: as `evaluate` gives them. skip: number of first test samples not scored.

    Returns:
        The files.
    """
    figures = {
        "record": plotting.record(train),
        "residuals": plotting.residuals(fit, train),
        "history": plotting.history(fit),
        "quantiles": plotting.quantiles(fit, train),
        "starts": plotting.starts(fit),
    }
    dynamic = [wire.name for wire, layer in fit.system.dynamic]
    for wire, made in fit.system.dynamic:
        suffix = "" if len(dynamic) == 1 else f"_{wire.name}"
        figures[f"poles{suffix}"] = plotting.pole_map(fit, layer=wire.name)
        if made.modes.inputs:
            figures[f"bode{suffix}"] = plotting.bode(fit, layer=wire.name)
            figures[f"impulse_response{suffix}"] = plotting.impulse_response(fit, layer=wire.name)
    for wire in fit.model.wires:
        if wire.name not in dynamic:
            figures[f"function_{wire.name}"] = plotting.static_function(fit, train, wire.name)
    if test is not None:
        shown = train[-max(2, int(SHOWN_PAST * len(test))) :]
        for name, result in (results or {}).items():
            past = shown if name == "forecast" else None
            figures[name.replace("-", "_")] = plotting.prediction(
                result.prediction, test, skip=skip, past=past
            )
    written = []
    for name, figure in figures.items():
        path = directory / f"{name}.png"
        _draw(figure, path)
        written.append(path)
    return written


def run_demo(
    output_directory: str | Path = "demo_output",
    progress: bool = True,
    *,
    pairs: int = 5,
    restarts: int = 4,
    steps: int = 600,
    rounds: int = 1,
    workers: int | None = None,
) -> dict[str, Any]:
    """Identify the coupled drives by variational inference; write the model, scores and figures.

    Then close the loop (`pyro_dynogp.close_loop`): the sensor reports the size of the speed alone,
    which a linear model cannot describe.

    Args:
        output_directory: made where it is missing; files of earlier runs are overwritten.
        progress: whether to show progress bars (on the standard error stream).
        pairs: number of pole pairs. restarts: number of starts. steps: most steps of SVI.
        rounds: most effects that are added to the linear model; 0 leaves this part out.
        workers: number of processes; None for all processors.

    Returns:
        "fit"; "scores" by kind of prediction; "report" of the loop, or None; "files"; "seconds"
        that it took.
    """
    begin = time.perf_counter()
    directory = Path(output_directory)
    directory.mkdir(parents=True, exist_ok=True)
    data = datasets.load("coupled_drives")
    if not isinstance(data.train, Record) or data.full is None:
        raise TypeError("The demonstration expects one training record.")
    print(f"Coupled electric drives, record 2. {data.protocol}")
    print(f"Source: {data.source}.")
    fitted = fit(
        LinearDynamicGP(inputs=1, pairs=pairs),
        data.train,
        method="svi",
        restarts=restarts,
        steps=steps,
        learning_rate=0.05,
        workers=workers,
        progress=progress,
    )
    print(f"\n{fitted.summary()}\n")
    results = evaluate(fitted, data.test, past=data.train, skip=data.skip)
    print(f"Scores on the {len(data.test)} test samples (the first {data.skip} are not counted):")
    print(score_table(results, data.test))
    files = write_figures(
        fitted, directory, train=data.train, test=data.test, results=results, skip=data.skip
    )
    # The record figure of a demonstration shows the test part as well.
    _draw(plotting.record(data.full), directory / "record.png")
    model_file, score_file = directory / "drives.safetensors", directory / "scores.json"
    fitted.save(model_file)
    numbers = {name: dict(result.scores) for name, result in results.items()}
    write_text(score_file, json.dumps(numbers, indent=2) + "\n", "The demonstration")
    print(f"\n{HONEST}\n")
    report = None
    if rounds:
        report = _closed_loop(data.full, rounds, workers, progress)
        print(f"{report}\n")
        page = directory / "report.html"
        report.to_html(page)
        print(f"Report:  {page}")
    seconds = time.perf_counter() - begin
    print(f"Figures: {directory}/*.png ({', '.join(path.stem for path in files)})")
    print(f"Model:   {model_file} (pyro_dynogp.load reads it)")
    print(f"Scores:  {score_file}")
    print(f"Done in {seconds:.0f} s.")
    return {
        "fit": fitted,
        "scores": numbers,
        "report": report,
        "files": [*files, model_file, score_file],
        "seconds": seconds,
    }


def _closed_loop(record: Record, rounds: int, workers: int | None, progress: bool) -> Report:
    """What a linear model of the first half of a record lacks."""
    print("Closing the loop: what does a linear model of the first 260 samples lack?")
    linear = fit(
        LinearDynamicGP(inputs=1, pairs=3), record[:260], workers=workers, progress=progress
    )
    return close_loop(linear, record, max_rounds=rounds, workers=workers, progress=progress)
