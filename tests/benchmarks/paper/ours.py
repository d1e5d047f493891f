"""This library's models as methods of the comparison."""

from __future__ import annotations

import time
from collections.abc import Sequence

import numpy as np

import pyro_dynogp as dgp
from pyro_dynogp.criticism.comparison import Stack
from pyro_dynogp.inference.density import Potential
from tests.benchmarks.paper.prediction import OURS, Outcome, Predicted, Task

SAMPLES = 400
STACK = f"{OURS}, stacked"
# A stack is made of fits from this many seeds.
STACKED = 3


def cascade(task: Task) -> Outcome:
    """The task's architecture with all defaults, restarts chosen by marginal likelihood."""
    return _fitted(cascade_model(task), task)


def linear(task: Task) -> Outcome:
    """The linear dynamic Gaussian process, exact, with all defaults."""
    pairs = next(part for part in task.architecture if isinstance(part, int))
    return _fitted(dgp.LinearDynamicGP(task.train.n_inputs, pairs=pairs), task)


def stacked(task: Task) -> Outcome:
    """Fits of the architecture from several seeds, weighted by their forecasts of training data."""
    begin = time.perf_counter()
    fits = {
        f"seed {seed}": dgp.fit(cascade_model(task), task.records, seed=seed, progress=False)
        for seed in range(STACKED * task.seed, STACKED * (task.seed + 1))
    }
    table = dgp.compare(fits, target="new record")
    stack = dgp.stack(fits, table)
    seconds = time.perf_counter() - begin
    weights = {f"weight {name}": float(w) for name, w in table.weights.items()}
    return Outcome(_predictions(stack, task), seconds, figures=weights)


def cascade_model(task: Task) -> dgp.Cascade:
    """The architecture: in the last layer one signal, in the others `width`."""
    last = len(task.architecture) - 1
    layers: list[dgp.Dynamic | dgp.Static] = []
    noisy = iter(task.noisy)
    for place, part in enumerate(task.architecture):
        outputs = 1 if place == last else task.width
        if isinstance(part, int):
            layers.append(dgp.Dynamic(outputs=outputs, pairs=part, process_noise=next(noisy)))
        else:
            layers.append(dgp.Static(outputs=outputs))
    return dgp.Cascade(task.train.n_inputs, tuple(layers))


def test_records(task: Task) -> list[dgp.Record]:
    """Times and inputs of the tests, without outputs."""
    train = task.train
    found = []
    for u in task.inputs:
        step = train.sampling_time
        begin = train.time[-1] + step if task.follows else 0.0
        found.append(
            dgp.Record(
                begin + step * np.arange(len(u)),
                u,
                input_names=train.input_names,
                input_units=train.input_units,
                time_unit=train.time_unit,
            )
        )
    return found


def step_seconds(fit: dgp.Fit, records: dgp.Record | tuple[dgp.Record, ...]) -> float:
    """Value and gradient of the log joint density on all of the data [s], best of three."""
    potential = Potential(getattr(fit.model, "collapsed", fit.model), (records,), fit.mode)
    z = potential.pack(potential.at).numpy()
    best = np.inf
    for _ in range(3):
        begin = time.perf_counter()
        potential.value_and_gradient(z)
        best = min(best, time.perf_counter() - begin)
    return float(best)


def _fitted(model: dgp.Cascade | dgp.LinearDynamicGP, task: Task) -> Outcome:
    begin = time.perf_counter()
    fit = dgp.fit(model, task.records, seed=task.seed, progress=False)
    seconds = time.perf_counter() - begin
    return Outcome(
        _predictions(fit, task),
        seconds,
        step_seconds=step_seconds(fit, task.records),
        figures={"noise_sd": float(fit.noise_sd[0])},
    )


def _predictions(fit: dgp.Fit | Stack, task: Task) -> Sequence[Predicted]:
    """Free runs: from the filtered state where the test follows, else from an unknown one."""
    found = []
    for test in test_records(task):
        options = {"process_noise": task.test_process_noise, "samples": SAMPLES}
        if task.follows:
            run = fit.forecast(task.train, test, **options)
        else:
            run = fit.simulate(test, **options)
        found.append(Predicted(run.mean[:, 0], np.asarray(run.samples)[:, :, 0]))
    return found
